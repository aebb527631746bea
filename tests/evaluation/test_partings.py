"""Where two methods part, and the pictures of it."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from asp_env.data.recording import Recording
from asp_env.data.rollout import Rollout
from asp_env.evaluation.report.episodes import Episode
from asp_env.evaluation.report.partings import parting_figures, parting_tick
from asp_env.evaluation.report.payload import MapTable
from asp_env.evaluation.report.scenario_values import ListedDrive
from tests.builders import make_recording
from tests.evaluation.runs import make_rollout

METHODS = (("pdm", "constant-velocity"), ("pdm", "ffw-asp"))


@pytest.fixture(scope="module")
def recording() -> Recording:
    return make_recording(duration_s=30.0)


@pytest.fixture(scope="module")
def rollout(recording: Recording) -> Rollout:
    return make_rollout(recording, track=0, start_tick=0, length=20, lag=0.0)


def moved(rollout: Rollout, step_m: float) -> Rollout:
    """The same, but the ego is `step_m` further in x at every tick than at the one before."""
    states = rollout.states.copy()
    states[:, 0, 0] += step_m * np.arange(len(states))
    return dataclasses.replace(rollout, states=states)


def test_egos_part_at_more_than_half_a_metre(rollout: Rollout, recording: Recording) -> None:
    """At 0.11 m per tick they are 0.44 m apart at tick 4 and 0.55 m at tick 5."""
    assert parting_tick(rollout, moved(rollout, 0.11)) == 5
    assert parting_tick(rollout, moved(rollout, -0.11)) == 5
    assert parting_tick(rollout, moved(rollout, 0.6)) == 1
    assert parting_tick(rollout, moved(rollout, 0.02)) is None
    short = make_rollout(recording, track=0, start_tick=0, length=4, lag=0.0)
    assert parting_tick(short, moved(rollout, 0.11)) is None


def test_a_picture_has_both_paths_and_the_agents_when_they_part(
    rollout: Rollout, recording: Recording, tmp_path: Path
) -> None:
    """Drives that do not part, or of which one is not saved, have none."""
    episodes = {}
    for method, step_m in zip(METHODS, (0.0, 0.11), strict=True):
        path = tmp_path / method[1] / "s.npz"
        path.parent.mkdir()
        moved(rollout, step_m).save(path)
        episodes["s", method] = Episode(path=path, label=f"pdm + {method[1]}")
    first, second = METHODS
    drives = [
        ListedDrive(name=name, tags="", first=a, second=b, scores=(0.25, 0.5))
        for name, a, b in (("s", first, second), ("s", first, first), ("other", first, second))
    ]
    maps = {recording.name: recording.road_map}
    (figure,) = parting_figures(drives, episodes, maps, MapTable(), condition=3, most=2)
    twice = [drives[0], drives[0]]
    assert len(parting_figures(twice, episodes, maps, MapTable(), condition=3, most=1)) == 1
    assert figure["title"] == "s: the methods part after 1.0 s"
    labels = [(each["label"], each["score"]) for each in figure["methods"]]
    assert labels == [("pdm + constant-velocity", 0.25), ("pdm + ffw-asp", 0.5)]
    ends = [np.cumsum(np.reshape(each["path"], (-1, 2)), axis=0) for each in figure["methods"]]
    assert (ends[1] - ends[0])[[0, 5, 20]].tolist() == [[0, 0], [55, 0], [220, 0]]
    expected = np.cumsum(np.full(20, 11))
    assert np.abs((ends[1] - ends[0])[1:, 0] - expected).max() <= 1  # rounded to centimetres
    egos = [agent for agent in figure["agents"] if agent[0] < 0]
    assert [agent[0] for agent in egos] == [-1, -2]
    assert egos[1][3] - egos[0][3] == pytest.approx(55, abs=1)
    assert len(figure["agents"]) == rollout.valid[5].sum() + 1
    assert len(figure["methods"][0]["forecasts"]) == (rollout.forecast_ticks == 5).sum()
    left, bottom, width, height = figure["window"]
    for x, y in np.concatenate(ends) / 100:
        assert left < x < left + width
        assert bottom < y < bottom + height
    assert figure["open"] == {
        "drive": "s", "a": "pdm + constant-velocity", "b": "pdm + ffw-asp", "tick": 5,
        "condition": 3,
    }  # fmt: skip
