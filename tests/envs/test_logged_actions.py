"""Following the logged driver: it reaches the goal, and all environments return the same bits."""

from typing import Any

import numpy as np
import pytest

from asp_env.envs import ReplayEnv, ReplayVectorEnv
from tests.envs.same import same
from tests.real_data import real_data


def follow(data: str) -> tuple[np.ndarray, np.ndarray, int]:
    """Follows the logged drivers of all scenarios.

    Returns:
        The endings, the largest distance to the log in metres, and the number of clipped actions.
    """
    number = len(ReplayEnv(data, observations=("state",)).scenarios)
    envs = ReplayVectorEnv(number, data, observations=("state",), autoreset_mode="NextStep")
    envs.reset(seed=0, options={"scenario": list(range(number))})
    world, rows = envs._episodes.simulation.world, np.arange(number)
    endings, distances_m, clipped = np.full(number, "", object), np.zeros(number), 0
    while (runs := endings == "").any():
        episodes = world.episodes
        logged = episodes.log_states[rows, world.now, 0, :2]
        offset_m = np.linalg.norm(logged - world.ego_states()[:, :2], axis=1)
        distances_m = np.where(runs, np.maximum(distances_m, offset_m), distances_m)
        clipped += int(envs.logged_actions_clipped()[runs].sum())
        _, _, terminated, truncated, infos = envs.step(envs.logged_actions())
        ended = (terminated | truncated) & runs
        endings[ended] = infos["ending"][ended]
    return endings, distances_m, clipped


@pytest.mark.parametrize("data", ["sample:intersection", "sample:roundabout"])
def test_logged_drivers_reach_the_goal(data: str) -> None:
    """All of 46 and 72, never more than 0.15 m from the log."""
    endings, distances_m, clipped = follow(data)
    assert set(endings) == {"GOAL"}
    assert distances_m.max() < 0.15
    assert clipped <= 5


@pytest.mark.data
def test_logged_drivers_of_real_recordings_reach_the_goal() -> None:
    """Of 46 at least 35. Tracks with accelerations beyond the limits cannot be followed."""
    endings, distances_m, clipped = follow(str(real_data("taf_bw")))
    assert (endings == "GOAL").sum() >= 35
    assert np.median(distances_m) < 0.5
    assert clipped > 100


def test_vector_and_single_environments_return_the_same_bits(crossing: str) -> None:
    """On the log and off it, step by step."""
    options: dict[str, Any] = {"scenario": 2}
    envs = ReplayVectorEnv(3, crossing, observations=("state",), autoreset_mode="Disabled")
    env = ReplayEnv(crossing, observations=("state",))
    envs.reset(seed=1, options=options)
    env.reset(seed=1, options=options)
    for tick in range(12):
        action = env.logged_action()
        assert env.action_space.contains(action)
        same(envs.logged_actions()[0], action)
        assert envs.logged_actions_clipped().tolist() == [env.logged_action_clipped()] * 3
        if tick in (3, 4):
            action = np.array([0.5, 0.2], dtype=np.float32)
        env.step(action)
        envs.step(np.tile(action, (3, 1)))


def test_stable_baselines3_calls_it_by_name(crossing: str) -> None:
    """As with its own vector environment over single ones."""
    pytest.importorskip("stable_baselines3")
    from stable_baselines3.common.vec_env import DummyVecEnv

    from asp_env.envs import sb3_vec_env

    one = sb3_vec_env(2, crossing, observations=("state",))
    other = DummyVecEnv([lambda: ReplayEnv(crossing, observations=("state",)) for _ in range(2)])
    for envs in (one, other):
        envs.seed(4)
        envs.reset()
    for name in ("logged_action", "logged_action_clipped"):
        batched, single = (list(envs.env_method(name, indices=[1, 0])) for envs in (one, other))
        np.testing.assert_array_equal(batched, single)
    with pytest.raises(AttributeError, match="logged_action, logged_action_clipped, without"):
        one.env_method("snapshot")
