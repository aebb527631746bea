"""The environments in highway-env's traffic keep all promises of the others."""

import copy
import pickle
import subprocess
import sys
import warnings
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode
from stable_baselines3 import PPO
from stable_baselines3.common.env_checker import check_env as check_env_sb3
from stable_baselines3.common.vec_env import DummyVecEnv

import asp_env
from asp_env.envs.replay import ReplayEnv
from tests.envs.same import same, same_alone, same_through_ends
from tests.envs.traces import PARTS, make, trace, trace_vector
from tests.highway_folders import SITE_NAMES, highway_data

with warnings.catch_warnings():  # PettingZoo's tests import its games by a way it calls old
    warnings.simplefilter("ignore")
    from pettingzoo.test import parallel_api_test, parallel_seed_test

IDS = {site: f"asp_env/Highway{site.capitalize()}-v0" for site in SITE_NAMES}
LITTLE: dict[str, Any] = {"observations": ("state", "actions")}

every_site = pytest.mark.parametrize("site", SITE_NAMES)


@every_site
def test_passes_the_checkers_without_a_warning(site):
    """Gymnasium's with its renderings, and stable-baselines3's; warnings are errors."""
    assert gymnasium.spec(IDS[site]).kwargs == {"data": f"highway:{site}"}
    options = {"data": highway_data(site), "raster_px": (90, 60), "render_mode": "rgb_array"}
    check_env(gymnasium.make(IDS[site], **options).unwrapped, skip_close_check=True)
    few = {**options, "observations": ("raster", "state")}
    check_env_sb3(gymnasium.make(IDS[site], **few).unwrapped, skip_render_check=True)
    flat = asp_env.FlatParts(gymnasium.make(IDS[site], **options).unwrapped)
    check_env_sb3(flat, skip_render_check=True)


@pytest.mark.parametrize(
    ("site", "mode"),
    [
        ("intersection", AutoresetMode.SAME_STEP),
        ("roundabout", AutoresetMode.NEXT_STEP),
        ("roundabout", AutoresetMode.DISABLED),
    ],
)
def test_equals_single_environments_bit_for_bit(site, mode):
    """Observations, rewards, endings and infos through autoresets."""
    given: dict[str, Any] = {"num_envs": 3, "data": highway_data(site), "raster_px": (45, 30)}
    given["observations"] = PARTS
    one = gymnasium.make_vec(
        IDS[site], vectorization_mode="vector_entry_point", autoreset_mode=mode, **given
    )
    other = gymnasium.make_vec(
        IDS[site], vectorization_mode="sync", vector_kwargs={"autoreset_mode": mode}, **given
    )
    rng = np.random.default_rng(0)
    drawn = [rng.uniform((0.0, -0.5), (1.0, 0.5), size=(3, 2)) for _ in range(18)]
    assert same_through_ends(one, other, mode, [each.astype(np.float32) for each in drawn]) > 3


def test_the_same_bits_in_another_process_and_beside_other_worlds():
    """Hashes of all that is returned, alone and batched, whatever was made and driven before."""
    script = (
        "import sys; from tests.envs.traces import make, trace, trace_vector\n"
        "for data in sys.argv[1:]:\n"
        "    print(trace(make(data), steps=25)); print(trace_vector(data, steps=8))"
    )
    data = [highway_data(site) for site in SITE_NAMES]
    done = subprocess.run(
        [sys.executable, "-c", script, *data], capture_output=True, text=True, check=True
    )
    expected = done.stdout.split()
    others = [make(each, traffic="idm") for each in data[::-1]]
    told = []
    for each in data:
        env = make(each)
        for other in others:
            trace(other, seed=77, steps=5)
        told += [trace(env, steps=25), trace_vector(each, steps=8)]
    assert told == expected
    assert len(set(expected)) == 4


def _drive(env: ReplayEnv, steps: int = 12) -> list[Any]:
    rng, seen = np.random.default_rng(1), []
    for _ in range(steps):
        told = env.step(rng.uniform((0.0, -0.2), (0.6, 0.2)))
        seen.append(told)
        if told[2] or told[3]:
            seen.append(env.reset())
    return seen


@every_site
def test_snapshots_and_copies_go_on_alike(site):
    """In memory, through a small pickle in another environment, and as a deep copy."""
    env = make(highway_data(site))
    env.reset(seed=2)
    for _ in range(4):
        env.step(np.array([0.4, 0.02]))
    snapshot, twin = env.snapshot(), copy.deepcopy(env)
    pickled = pickle.dumps(snapshot)
    expected = _drive(env)
    env.reset(seed=99)
    env.restore(snapshot)
    same(_drive(env), expected)
    same(_drive(twin), expected)
    other = make(highway_data(site))
    other.restore(pickle.loads(pickled))
    same(_drive(other), expected)
    assert len(pickled) < 10_000


@every_site
def test_passes_the_tests_of_pettingzoo(site):
    """Every vehicle an agent; warnings are errors."""
    data = highway_data(site)
    parallel_api_test(asp_env.parallel_env(data, **LITTLE), num_cycles=20)
    parallel_seed_test(lambda: asp_env.parallel_env(data, **LITTLE), num_cycles=3)


@every_site
def test_a_lone_agent_is_the_ego_of_the_single_environment(site):
    """With one agent everything that is returned is the same, bit for bit."""
    one = asp_env.parallel_env(highway_data(site), max_agents=1, **LITTLE)
    other = ReplayEnv(highway_data(site), **LITTLE)
    for seed in range(2):
        same_alone(one, other, seed)


@every_site
def test_all_agents_live_in_one_world_with_the_traffic(site):
    """Whoever looks, everybody is in the same place; crashed ones are gone for good."""
    env = asp_env.parallel_env(highway_data(site), **LITTLE)
    env.reset(options={"scenario": 3})
    assert len(env.agents) > 1
    rng, gone = np.random.default_rng(0), set()
    for _ in range(15):
        before = set(env.agents)
        env.step({agent: rng.uniform((-0.2, -0.1), (0.6, 0.1)) for agent in env.agents})
        seen = [env.scene(agent) for agent in env.agents]
        there = [
            {
                int(scene.ids[0, slot]): scene.states[0, slot, -1].tobytes()
                for slot in np.flatnonzero(scene.valid[0, :, -1])
            }
            for scene in seen
        ]
        assert all(each == there[0] for each in there)
        assert not gone & set(env.agents)
        gone |= before - set(env.agents)


def _parts(seen: Any) -> dict[str, np.ndarray]:
    """`DummyVecEnv` returns an ordered dictionary."""
    return dict(seen)


def test_stable_baselines_trains_in_it():
    """Its adapter returns what `DummyVecEnv` over single environments does; PPO runs."""
    data = highway_data("intersection")
    options: dict[str, Any] = {"observations": ("state", "route")}
    one = asp_env.sb3_vec_env(2, data, **options)
    other = DummyVecEnv([lambda: ReplayEnv(data, **options)] * 2)
    one.seed(3)
    other.seed(3)
    same(one.reset(), _parts(other.reset()))
    rng = np.random.default_rng(0)
    for _ in range(10):
        actions = rng.uniform((-0.5, -0.3), (1.0, 0.3), (2, 2)).astype(np.float32)
        told, (seen, *rest) = one.step(actions), other.step(actions)
        same(list(told), [_parts(seen), *rest])
    model = PPO("MultiInputPolicy", one, n_steps=8, batch_size=8, n_epochs=1, device="cpu")
    model.learn(16)
    assert model.num_timesteps == 16


@every_site
def test_forecasts_are_parts_of_the_observation(site):
    """Side by side as alone."""
    given: dict[str, Any] = {"data": highway_data(site), **LITTLE}
    single = asp_env.PredictionFeatures(gymnasium.make(IDS[site], **given), "constant-turn-rate")
    envs = asp_env.VectorPredictionFeatures(
        gymnasium.make_vec(IDS[site], num_envs=2, vectorization_mode="vector_entry_point", **given),
        "constant-turn-rate",
    )
    (seen, _), (expected, _) = envs.reset(seed=4), single.reset(seed=4)
    for _ in range(5):
        same({name: part[0] for name, part in seen.items()}, expected)
        assert expected["forecast_valid"].any()
        seen, _, over, *_ = envs.step(np.zeros((2, 2)))
        if over[0]:
            break
        expected, *_ = single.step(np.zeros(2))
