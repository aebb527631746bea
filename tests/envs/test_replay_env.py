"""`asp_env/Replay-v0`: rewards, endings, infos and rendering."""

import subprocess
import sys
from typing import Any

import gymnasium
import numpy as np
import pytest

from asp_env.envs.replay import ReplayEnv

SMALL = (90, 60)


def _make(crossing: str, **options: Any) -> ReplayEnv:
    return ReplayEnv(crossing, **{"raster_px": SMALL, **options})


def test_reward_of_full_braking(crossing):
    """From 8 m/s the ego loses 1 m/s per tick and stops after 1.6 s and 6.4 m of 120 m."""
    env = _make(crossing, observations=("state",))
    env.reset(options={"scenario": 0})
    total, info = 0.0, {}
    for step in range(1, 11):
        obs, reward, terminated, truncated, info = env.step(np.array([-1.0, 0.0]))
        assert obs["state"][0] == pytest.approx(max(8 - step, 0), abs=1e-3)
        assert not terminated
        assert not truncated
        total += reward
    assert info["progress"] == pytest.approx(6.4 / 120, abs=1e-3)
    assert info["ending"] == "RUNNING"
    # Eight ticks of 5 m/s² cost 0.01·½ each.
    assert total == pytest.approx(6.4 / 120 - 8 * 0.005, abs=1e-3)


def test_constant_speed_reaches_the_goal(crossing):
    """The motorcycle of scenario 5 keeps its speed for 35 ticks; the rewards sum to 1."""
    env = _make(crossing, observations=("state",))
    env.reset(options={"scenario": 5})
    rewards = []
    while True:
        _, reward, terminated, truncated, info = env.step(np.zeros(2))
        rewards.append(reward)
        if terminated or truncated:
            break
    assert (terminated, truncated, info["ending"]) == (True, False, "GOAL")
    assert len(rewards) == 35
    assert sum(rewards) == pytest.approx(1.0, abs=1e-4)
    with pytest.raises(gymnasium.error.ResetNeeded):
        env.step(np.zeros(2))


def test_the_end_of_the_data_truncates(crossing):
    """A standing ego without collisions is truncated at tick 75, the length of the scenario."""
    env = _make(crossing, observations=("state",))
    env.reset(options={"scenario": 1})
    info = {}
    for step in range(1, 76):
        _, _, terminated, truncated, info = env.step(np.array([-1.0, 0.0]))
        assert not terminated
        assert truncated == (step == 75)
    assert info["ending"] == "OUT_OF_DATA"


def test_leaving_the_road_terminates(crossing):
    """At more than 2 m off the drivable area, with a cost before."""
    env = _make(crossing, observations=("state",))
    env.reset(options={"scenario": 1})
    costs = 0.0
    while True:
        _, _, terminated, truncated, info = env.step(np.array([0.0, -0.6]))
        costs += info["reward_terms"]["off_road"]
        if terminated or truncated:
            break
    assert info["ending"] == "OFF_ROAD"
    assert info["off_road_m"] > 2.0
    assert costs <= -0.2


def test_actions_out_of_range_are_clipped(crossing):
    envs = [_make(crossing, observations=("state",)) for _ in range(2)]
    for env, scale in zip(envs, (1.0, 10.0), strict=True):
        env.reset(options={"scenario": 0})
        obs = env.step(np.array([1.0, -1.0]) * scale)[0]
        assert obs["state"][0] == pytest.approx(8 + 1, abs=1e-3)
    assert envs[0].scene().states.tobytes() == envs[1].scene().states.tobytes()


def test_unseeded_resets_continue_the_draws_of_the_seed(crossing):
    env = _make(crossing, observations=("state",))
    names = [scenario.name for scenario in env.scenarios]
    drawn = [env.reset(seed=1)[1]["scenario"], *(env.reset()[1]["scenario"] for _ in range(30))]
    again = [env.reset(seed=1)[1]["scenario"], *(env.reset()[1]["scenario"] for _ in range(30))]
    assert drawn == again
    assert set(drawn) == set(names)


def test_scene_behind_wrappers(crossing):
    """One situation, the ego in slot 0, at the present tick."""
    env = gymnasium.make("asp_env/Replay-v0", data=crossing, observations=("state",))
    env.reset(options={"scenario": 2})
    env.step(np.zeros(2, dtype=np.float32))
    inner = env.unwrapped
    assert isinstance(inner, ReplayEnv)
    scene = inner.scene()
    assert scene.states.shape[0] == 1
    assert scene.ids[0, 0] == inner.scenarios[2].ego_id
    assert scene.tick.tolist() == [inner.scenarios[2].start_tick + 1]


def test_renders_an_rgb_array(crossing):
    """The same state gives the same image; without a render mode there is none."""
    env = _make(crossing, render_mode="rgb_array")
    env.reset(seed=0)
    picture = env.render()
    assert picture.dtype == np.uint8
    assert picture.ndim == 3
    assert picture.shape[2] == 3
    assert len(np.unique(picture.reshape(-1, 3), axis=0)) > 3
    assert np.array_equal(picture, env.render())
    silent = _make(crossing)
    silent.reset(seed=0)
    assert silent.render() is None


def test_close_may_be_called_twice(crossing):
    env = gymnasium.make("asp_env/Replay-v0", data=crossing)
    env.reset(seed=0)
    env.close()
    env.close()


def test_the_default_environment_imports_no_torch():
    script = (
        "import sys, gymnasium as gym, asp_env;"
        "env = gym.make('asp_env/Replay-v0'); env.reset(seed=0);"
        "env.step(env.action_space.sample());"
        "assert not {'torch', 'lightning', 'sumolib', 'predictors', 'scenarios'} & set(sys.modules)"
    )
    subprocess.run([sys.executable, "-W", "error", "-c", script], check=True)
