"""Snapshots in memory and as pickles, and deep copies."""

import copy
import pickle
from typing import Any

import gymnasium
import numpy as np
import pytest

from asp_env.data.recording import Recording
from asp_env.data.road_map import RoadMap
from asp_env.envs.replay import ReplayEnv
from asp_env.envs.vector import ReplayVectorEnv
from asp_env.errors import AspEnvError
from tests.crossing_files import write_crossing
from tests.envs.same import same

ALL = ("raster", "vectors", "actions", "state", "route")
TRAFFIC = ("log", "log-actions", "idm")


def _make(crossing: str, **options: Any) -> ReplayEnv:
    return ReplayEnv(crossing, **{"raster_px": (45, 30), "observations": ALL, **options})


def _drive(env: ReplayEnv, steps: int = 25) -> list[Any]:
    """Everything that an environment returns, through resets without a seed."""
    rng, seen = np.random.default_rng(1), []
    for _ in range(steps):
        returned = env.step(rng.uniform((0.0, -0.5), (1.0, 0.5)))
        seen.append(returned)
        if returned[2] or returned[3]:
            seen.append(env.reset())
    return seen


@pytest.mark.parametrize("traffic", TRAFFIC)
def test_a_snapshot_restores_every_bit(crossing, traffic):
    """Including the draws of resets, after other episodes and in another environment."""
    env = _make(crossing, traffic=traffic)
    env.reset(seed=2)
    for _ in range(4):
        env.step(np.array([0.5, 0.05]))
    start = env.snapshot()
    expected = _drive(env)
    env.reset(seed=99)
    env.restore(start)
    same(_drive(env), expected)
    other = _make(crossing, traffic=traffic)
    other.restore(start)
    same(_drive(other), expected)
    env.restore(start)
    same(_drive(env), expected)


@pytest.mark.parametrize("traffic", TRAFFIC)
def test_a_pickled_snapshot_is_small_and_restores_every_bit(crossing, traffic):
    """It holds no recording, no raster and no state of the drivers: less than 10 kB."""
    env = _make(crossing, traffic=traffic)
    env.reset(seed=2)
    for _ in range(4):
        env.step(np.array([0.5, 0.05]))
    pickled = pickle.dumps(env.snapshot())
    assert len(pickled) < 10_000
    expected = _drive(env)
    other = _make(crossing, traffic=traffic)
    other.restore(pickle.loads(pickled))
    same(_drive(other), expected)


def test_a_restored_finished_episode_is_finished(crossing):
    env = _make(crossing, observations=("state",))
    env.reset(options={"scenario": 5})
    while not any(env.step(np.zeros(2))[2:4]):
        pass
    for snapshot in (env.snapshot(), pickle.loads(pickle.dumps(env.snapshot()))):
        env.reset()
        env.restore(snapshot)
        with pytest.raises(Exception, match="the episode is over"):
            env.step(np.zeros(2))


def test_counterfactuals_share_their_past(crossing):
    """Two continuations of one snapshot agree up to it and differ afterwards."""
    env = _make(crossing, observations=("state",))
    env.reset(seed=0)
    for _ in range(5):
        env.step(np.array([0.2, 0.0]))
    fork, scenes = env.snapshot(), []
    for throttle in (1.0, -1.0):
        env.restore(fork)
        for _ in range(5):
            env.step(np.array([throttle, 0.0]))
        scenes.append(env.scene())
    ego = [scene.states[0, 0] for scene in scenes]
    assert ego[0][:-5].tobytes() == ego[1][:-5].tobytes()
    assert (ego[0][-5:, 3] > ego[1][-5:, 3]).all()


@pytest.mark.parametrize("traffic", TRAFFIC)
def test_a_deep_copy_continues_in_the_same_way(crossing, traffic):
    """Recordings and maps are shared, not copied."""
    env = _make(crossing, traffic=traffic, observations=(*ALL, "mtp"))
    env.reset(seed=3, options={"scenario": 1})
    for _ in range(5):
        env.step(np.zeros(2))
    copied: dict[int, Any] = {}
    twin = copy.deepcopy(env, copied)
    assert twin.recordings is env.recordings
    assert not [each for each in copied.values() if isinstance(each, Recording | RoadMap)]
    same(_drive(twin), _drive(env))


@pytest.mark.parametrize("traffic", TRAFFIC)
def test_snapshots_of_vector_environments(crossing, traffic):
    """With episodes at different ticks, through autoresets, in memory and pickled."""
    envs = ReplayVectorEnv(3, crossing, traffic=traffic, observations=("state", "vectors"))
    envs.reset(seed=[5, 6, 7])
    rng = np.random.default_rng(0)
    actions = rng.uniform((0.0, -0.5), (1.0, 0.5), size=(80, 3, 2))
    for each in actions[:30]:
        envs.step(each)
    start = envs.snapshot()
    expected = [envs.step(each) for each in actions[30:]]
    assert any((returned[2] | returned[3]).any() for returned in expected)
    for snapshot in (start, pickle.loads(pickle.dumps(start))):
        envs.restore(snapshot)
        same([envs.step(each) for each in actions[30:]], expected)


@pytest.mark.parametrize("pickled", [False, True], ids=["in-memory", "pickled"])
def test_a_snapshot_of_another_environment_is_refused(crossing, tmp_path, pickled):
    """Other data, time step, traffic, meaning or length of actions, or number of episodes."""
    other_data = str(write_crossing(tmp_path / "other", seconds=16.0))
    env = ReplayEnv(crossing, observations=("state",))
    env.reset(seed=0)
    snapshot = env.snapshot()
    others = [
        (crossing, {"dt_s": 0.1}, r"time step 0\.2 s, expected 0\.1 s"),
        (crossing, {"traffic": "idm"}, "traffic log, expected idm"),
        (crossing, {"action_repeat": 2}, "action_repeat 1, expected 2"),
        (other_data, {}, "data of content"),
    ]
    for data, options, message in others:
        other = ReplayEnv(data, observations=("state",), **options)
        given = pickle.loads(pickle.dumps(snapshot)) if pickled else snapshot
        with pytest.raises(AspEnvError, match=message) as caught:
            other.restore(given)
        assert "\n" not in str(caught.value)
        with pytest.raises(gymnasium.error.ResetNeeded):
            other.step(np.zeros(2))
    envs = [ReplayVectorEnv(count, crossing, observations=("state",)) for count in (2, 3)]
    envs[0].reset(seed=0)
    with pytest.raises(AspEnvError, match="number of episodes 2, expected 3"):
        envs[1].restore(envs[0].snapshot())
    envs[1].reset(seed=0)
    env.restore(snapshot)
