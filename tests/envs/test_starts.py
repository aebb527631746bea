"""Starts of episodes: scenarios by number, name and filter, and any vehicle at any tick."""

import gymnasium
import numpy as np
import pytest

from asp_env.data.scenarios.scenario import ScenarioFilter
from asp_env.data.scenarios.tags import TAGS
from asp_env.envs.replay import ReplayEnv
from asp_env.errors import AspEnvError
from tests.crossing_files import ON_ROAD, write_crossing
from tests.envs.same import same


def _make(data: str, **options) -> ReplayEnv:
    return ReplayEnv(data, **{"observations": ("state",), **options})


def test_a_scenario_by_number_and_by_name(crossing):
    """For any seed."""
    env = _make(crossing)
    for number, scenario in enumerate(env.scenarios):
        by_number = env.reset(seed=number, options={"scenario": number})
        by_name = env.reset(seed=0, options={"scenario": scenario.name})
        same(by_number[1], by_name[1])
        assert by_number[0]["state"].tobytes() == by_name[0]["state"].tobytes()
        assert by_name[1]["scenario"] == scenario.name


def test_a_seed_is_not_the_number_of_a_scenario(crossing):
    env = _make(crossing)
    drawn = [env.reset(seed=seed)[1]["scenario"] for seed in range(100, 140)]
    assert len(set(drawn)) == len(env.scenarios)
    assert drawn[: len(env.scenarios)] != [scenario.name for scenario in env.scenarios]


def test_any_vehicle_at_any_tick(crossing):
    """The motorcycle (id 6) is present from 4 s to 14 s and starts at ticks 20 + 15 to 69."""
    env = _make(crossing)
    obs, info = env.reset(options={"ego": 6, "start_tick": 41})
    assert obs in env.observation_space
    assert info["scenario"] == "00-6-41"
    scene = env.scene()
    assert (scene.ids[0, 0], scene.tick[0]) == (6, 41)
    row = (41 - 20) * 5
    assert np.array_equal(scene.states[0, 0, -1], env.recordings[0].track(5)[row])
    assert env.reset(options={"ego": 6})[1]["scenario"] == "00-6-35"
    env.reset(options={"ego": 6, "start_tick": 69})
    assert env.step(np.zeros(2))[2]
    with pytest.raises(
        AspEnvError, match="start tick 70: ego 6 of recording 00 can start at ticks 35 to 69"
    ):
        env.reset(options={"ego": 6, "start_tick": 70})


def test_a_scenario_from_another_tick_or_with_another_ego(crossing):
    env = _make(crossing)
    first = env.scenarios[0]
    info = env.reset(options={"scenario": 0, "start_tick": first.start_tick + 7})[1]
    assert info["scenario"] == f"{first.recording_name}-{first.ego_id}-{first.start_tick + 7}"
    info = env.reset(options={"scenario": 0, "ego": 2})[1]
    assert info["scenario"].startswith(f"{first.recording_name}-2-")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"ego": 99}, "ego 99: recording 00 has no such track"),
        ({"ego": "2"}, "ego '2': expected a whole number"),
        ({"ego": True}, "ego True: expected a whole number"),
        ({"ego": 1, "start_tick": 3}, "start tick 3: ego 1 of recording 00 can start"),
        ({"ego": 1, "start_tick": -1}, "start tick -1: ego 1 .* at ticks 15 to 99"),
        ({"ego": 1, "start_tick": 100}, "start tick 100: ego 1 .* at ticks 15 to 99"),
        ({"ego": 1, "start_tick": 20.5}, "start_tick 20.5: expected a whole number"),
        ({"start_tick": 20}, "start_tick 20 alone: name the scenario or the ego"),
        ({"scenario": 0, "start_tick": 0}, "start tick 0: ego 1 of recording 00 can start"),
    ],
    ids=str,
)
def test_starts_that_do_not_exist_are_rejected(crossing, options, message):
    """The environment can be reset afterwards."""
    env = _make(crossing)
    with pytest.raises(AspEnvError, match=message) as caught:
        env.reset(options=options)
    assert "\n" not in str(caught.value)
    env.reset(seed=0)


def test_a_pedestrian_cannot_be_the_ego(crossing):
    env = _make(crossing)
    recorded = env.recordings[0]
    pedestrian = int(recorded.track_ids[np.flatnonzero(recorded.classes == 8)[0]])
    with pytest.raises(AspEnvError, match="is of class pedestrian, which cannot be driven"):
        env.reset(options={"ego": pedestrian})


def test_an_ego_of_several_recordings_needs_a_scenario(tmp_path):
    """Track ids are unique only within a recording."""
    env = _make(str(write_crossing(tmp_path, drives=(ON_ROAD, ON_ROAD[:3]))))
    with pytest.raises(AspEnvError, match="has 2 recordings; name a scenario"):
        env.reset(options={"ego": 1})
    of_second = next(each for each in env.scenarios if each.recording == 1)
    info = env.reset(options={"scenario": of_second.name, "ego": 2})[1]
    assert info["scenario"].startswith("01-2-")


def test_recordings_shorter_than_the_history_are_rejected(tmp_path):
    data = str(write_crossing(tmp_path, drives=(ON_ROAD[:3],), seconds=2.0))
    with pytest.raises(AspEnvError, match="after 3 s of history"):
        _make(data)


def test_scenarios_of_a_filter(crossing):
    """As text, which can be part of a JSON spec, or as an object."""
    everything = _make(crossing).scenarios
    for wanted in ("left", ScenarioFilter.parse("left")):
        env = _make(crossing, scenarios=wanted)
        assert 0 < len(env.scenarios) < len(everything)
        for seed in range(10):
            assert env.reset(seed=seed)[1]["tags"][TAGS.index("left")]
    spec = gymnasium.make(
        "asp_env/Replay-v0", data=crossing, observations=("state",), scenarios="left"
    ).spec
    assert spec is not None
    assert "left" in spec.to_json()


def test_scenarios_of_a_set(crossing):
    """In the order of the set."""
    chosen = _make(crossing).scenarios.select(np.array([4, 3, 2]))
    env = _make(crossing, scenarios=chosen)
    for number, scenario in enumerate(chosen):
        assert env.reset(options={"scenario": number})[1]["scenario"] == scenario.name


def test_invalid_scenarios_are_rejected(crossing, tmp_path):
    """Unknown tags, no match, an empty set, and sets of other data or another time step."""
    everything = _make(crossing).scenarios
    with pytest.raises(AspEnvError, match=r"'lefts' \(did you mean 'left'"):
        _make(crossing, scenarios="lefts")
    with pytest.raises(AspEnvError, match=r"none of the 6 of .* fits"):
        _make(crossing, scenarios="left,right")
    with pytest.raises(AspEnvError, match="the set is empty"):
        _make(crossing, scenarios=everything.select(np.zeros(0, dtype=np.int64)))
    with pytest.raises(AspEnvError, match=r"15 past ticks of 0.2 s: expected 25 of 0.12 s"):
        _make(crossing, scenarios=everything, dt_s=0.12)
    other = _make(str(write_crossing(tmp_path, drives=(ON_ROAD, ON_ROAD)))).scenarios
    with pytest.raises(AspEnvError, match=r"expected some of .* whose recordings are 00"):
        _make(crossing, scenarios=other)
