"""What `asp-env bench` steps: crowds, the plain NumPy beside them, and the command."""

from pathlib import Path

import numpy as np
import pytest

from asp_env.cli import main
from asp_env.data.classes import AgentClass
from asp_env.data.source import Recordings
from asp_env.errors import AspEnvError
from asp_env.evaluation.bench import bench, stepping, timing
from asp_env.evaluation.bench.stepping import crowd, crowd_scenarios
from asp_env.geometry import box_corners
from asp_env.metrics.boxes import ego_contacts
from tests.builders import Drive, make_recording


def test_a_crowd_is_as_many_at_every_frame(recordings: Recordings) -> None:
    """7 vehicles at each of 300 frames, on tracks of the recording."""
    dense = crowd(recordings[0], agents=7, duration_s=300 / recordings[0].frame_rate_hz)
    starts, _ = dense.frame_index
    assert np.diff(starts).tolist() == [7] * 300
    known = {tuple(state) for state in recordings[0].states.tolist()}
    assert {tuple(state) for state in dense.states.tolist()} <= known


def test_a_crowds_egos_last_as_long_as_their_scenarios(recordings: Recordings) -> None:
    """Each scenario's ego is there from the first frame to the scenario's last one."""
    dense = crowd(recordings[0], agents=7, duration_s=12.0)
    for scenario in crowd_scenarios(dense, count=9, start_tick=15, length=10, stride=5):
        ego = dense.track_ids.tolist().index(scenario.ego_id)
        assert dense.first_frames[ego] == 0
        assert dense.last_frames[ego] >= 125


def test_nobody_to_make_a_crowd_of() -> None:
    """A recording of 2 s has no vehicle seen for 4 s."""
    recording = make_recording(
        drives=(Drive(kind=AgentClass.CAR, start=(0.0, 0.0, 0.0, 5.0)),), duration_s=2.0
    )
    with pytest.raises(AspEnvError, match="no vehicle seen for 4 s"):
        crowd(recording, agents=2, duration_s=2.0)


def test_plain_numpy_finds_the_contacts_that_the_world_finds() -> None:
    """On random boxes both say the same of every pair."""
    rng = np.random.default_rng(0)
    states = rng.uniform(-5, 5, (50, 8, 4)).astype(np.float32)
    sizes = rng.uniform(1, 5, (50, 8, 2)).astype(np.float32)
    found = stepping.touching(states, box_corners(states, sizes))
    expected = ego_contacts(states, sizes, np.ones((50, 8), dtype=bool)) > 0
    assert 0.2 < expected[:, 1:].mean() < 0.9
    np.testing.assert_array_equal(found[:, 1:], expected[:, 1:])


def test_bench_prints_every_section(
    crossings: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each kind of traffic, environments, and a line for each size."""
    monkeypatch.setattr(timing, "COPY_BYTES", 2**20)
    monkeypatch.setattr(timing, "REPEATS", 1)
    monkeypatch.setattr(bench, "SIZES_PX", ((90, 60),))
    monkeypatch.setattr(bench, "MANY_EPISODES", (1, 2))
    monkeypatch.setattr(bench, "MANY_AGENTS", (2, 3))
    args = ["bench", str(crossings), "--episodes", "2", "--agents", "3", "--envs", "2"]
    assert main(args) == 0
    told = capsys.readouterr().out
    for expected in ("raster 12x90x60", "plain NumPy, 2", "gym.make_vec of 2, vectors"):
        assert expected in told
    assert told.count("crowd of 3") == len(stepping.TRAFFIC)


@pytest.mark.parametrize(
    ("args", "message"),
    [
        (["--episodes", "0"], "--episodes 0: expected at least 1"),
        (["--agents", "-1"], "--agents -1: expected at least 1"),
        (["--sections", "drawings"], "did you mean 'drawing'"),
    ],
)
def test_bench_refuses(
    args: list[str], message: str, crossings: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """One line, before anything is measured."""
    assert main(["bench", str(crossings), *args]) == 2
    told = capsys.readouterr()
    assert message in told.err
    assert told.out == ""
