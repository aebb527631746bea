"""The environment checkers of Gymnasium and stable-baselines3, and the spaces."""

import itertools

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from stable_baselines3.common.env_checker import check_env as check_env_sb3

import asp_env
from asp_env.envs.replay import ReplayEnv
from asp_env.sim.observation import observation_names

COMPONENTS = ("raster", "vectors", "actions", "state", "route")
SUBSETS = [names for n in range(1, 6) for names in itertools.combinations(COMPONENTS, n)]
TABLES = {"vectors", "actions", "route"}
SMALL = (90, 60)


@pytest.mark.parametrize("names", SUBSETS, ids="-".join)
def test_checkers_pass_without_warnings(crossing, names):
    """stable-baselines3 warns only of tables such as the action history; warnings are errors."""
    made = gymnasium.make("asp_env/Replay-v0", data=crossing, observations=names, raster_px=SMALL)
    env = made.unwrapped
    check_env(env, skip_render_check=True, skip_close_check=True)
    check_env_sb3(asp_env.FlatParts(env), skip_render_check=True)
    if not TABLES & set(names):
        check_env_sb3(env, skip_render_check=True)


def test_checks_of_rendering_pass(crossing):
    """Gymnasium's checker makes the environment in every render mode of the metadata."""
    made = gymnasium.make(
        "asp_env/Replay-v0", data=crossing, observations=("state",), render_mode="rgb_array"
    )
    check_env(made.unwrapped, skip_close_check=True)


def test_default_spaces(crossing):
    env = gymnasium.make("asp_env/Replay-v0", data=crossing)
    space = env.observation_space
    assert isinstance(space, gymnasium.spaces.Dict)
    assert set(space) == {"raster", "actions", "state"}
    assert (space["raster"].shape, space["raster"].dtype) == ((12, 360, 240), np.uint8)
    assert (space["actions"].shape, space["actions"].dtype) == ((15, 2), np.float32)
    assert env.action_space == gymnasium.spaces.Box(-1, 1, (2,), np.float32)
    obs, _ = env.reset(seed=0)
    assert obs in space
    assert set(np.unique(obs["raster"])) == {0, 255}


@pytest.mark.parametrize("name", observation_names())
def test_observations_are_finite_and_within_finite_bounds(crossing, name):
    """Also far off the road."""
    env = ReplayEnv(crossing, observations=(name,))
    assert isinstance(env.observation_space, gymnasium.spaces.Dict)
    for box in env.observation_space.values():
        assert isinstance(box, gymnasium.spaces.Box)
        assert box.is_bounded()
        assert np.isfinite(box.low).all()
        assert np.isfinite(box.high).all()
    obs, _ = env.reset(seed=0)
    assert obs in env.observation_space
    for turn in (1.0, -1.0, 0.3):
        env.reset()
        over = False
        while not over:
            obs, _, terminated, truncated, _ = env.step(np.array([1.0, turn]))
            over = terminated or truncated
            assert obs in env.observation_space
            assert all(np.isfinite(part).all() for part in obs.values())


def test_rasters_of_several_views(crossing):
    """`raster` is drawn by `view` in the given pixels; the others have their usual size."""
    env = ReplayEnv(
        crossing, observations=("raster", "mtp", "chauffeurnet"), view="mtp", raster_px=(60, 60)
    )
    obs, _ = env.reset(seed=0)
    assert {name: part.shape for name, part in obs.items()} == {
        "raster": (3, 60, 60),
        "mtp": (3, 360, 360),
        "chauffeurnet": (12, 360, 240),
    }
    alone = ReplayEnv(crossing, observations=("mtp",)).reset(seed=0)[0]
    assert alone["mtp"].tobytes() == obs["mtp"].tobytes()
