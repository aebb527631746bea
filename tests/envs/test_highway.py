"""The environments in highway-env's traffic pass the same checks as in replayed traffic."""

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
from tests.envs.traces import COMPONENTS, make, trace, trace_vector
from tests.highway_folders import SITE_NAMES, highway_data

with warnings.catch_warnings():  # PettingZoo's tests import its games in a deprecated way
    warnings.simplefilter("ignore")
    from pettingzoo.test import parallel_api_test, parallel_seed_test

IDS = {site: f"asp_env/Highway{site.capitalize()}-v0" for site in SITE_NAMES}
SMALL: dict[str, Any] = {"observations": ("state", "actions")}

every_site = pytest.mark.parametrize("site", SITE_NAMES)


@every_site
def test_checkers_pass_without_warnings(site):
    """Those of Gymnasium, with rendering, and of stable-baselines3; warnings are errors."""
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
def test_returns_the_bits_of_single_environments(site, mode):
    """Observations, rewards, endings and infos through autoresets."""
    given: dict[str, Any] = {"num_envs": 3, "data": highway_data(site), "raster_px": (45, 30)}
    given["observations"] = COMPONENTS
    one = gymnasium.make_vec(
        IDS[site], vectorization_mode="vector_entry_point", autoreset_mode=mode, **given
    )
    other = gymnasium.make_vec(
        IDS[site], vectorization_mode="sync", vector_kwargs={"autoreset_mode": mode}, **given
    )
    rng = np.random.default_rng(0)
    drawn = [rng.uniform((0.0, -0.5), (1.0, 0.5), size=(3, 2)) for _ in range(18)]
    assert same_through_ends(one, other, mode, [each.astype(np.float32) for each in drawn]) > 3


def test_returns_the_same_bits_in_another_process_and_after_other_worlds():
    """Single and vector environments, whichever worlds were made and stepped before."""
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
    traces = []
    for each in data:
        env = make(each)
        for other in others:
            trace(other, seed=77, steps=5)
        traces += [trace(env, steps=25), trace_vector(each, steps=8)]
    assert traces == expected
    assert len(set(expected)) == 4


def _drive(env: ReplayEnv, steps: int = 12) -> list[Any]:
    rng, seen = np.random.default_rng(1), []
    for _ in range(steps):
        returned = env.step(rng.uniform((0.0, -0.2), (0.6, 0.2)))
        seen.append(returned)
        if returned[2] or returned[3]:
            seen.append(env.reset())
    return seen


@every_site
def test_snapshots_and_copies_continue_in_the_same_way(site):
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


@pytest.mark.filterwarnings("ignore:No agents present but not all possible_agents")
@every_site
def test_pettingzoo_tests_pass_without_warnings(site):
    data = highway_data(site)
    parallel_api_test(asp_env.parallel_env(data, **SMALL), num_cycles=20)
    parallel_seed_test(lambda: asp_env.parallel_env(data, **SMALL), num_cycles=3)


@every_site
def test_one_agent_equals_the_single_environment(site):
    one = asp_env.parallel_env(highway_data(site), max_agents=1, **SMALL)
    other = ReplayEnv(highway_data(site), **SMALL)
    for seed in range(2):
        same_alone(one, other, seed)


@every_site
def test_all_agents_share_one_world_with_the_traffic(site):
    """Every agent's scene has the same vehicles in the same states; agents never return."""
    env = asp_env.parallel_env(highway_data(site), **SMALL)
    env.reset(options={"scenario": 3})
    assert len(env.agents) > 1
    rng, gone = np.random.default_rng(0), set()
    for _ in range(15):
        before = set(env.agents)
        env.step({agent: rng.uniform((-0.2, -0.1), (0.6, 0.1)) for agent in env.agents})
        states = [
            {
                int(scene.ids[0, slot]): scene.states[0, slot, -1].tobytes()
                for slot in np.flatnonzero(scene.valid[0, :, -1])
            }
            for scene in (env.scene(agent) for agent in env.agents)
        ]
        assert all(each == states[0] for each in states)
        assert not gone & set(env.agents)
        gone |= before - set(env.agents)


def _as_dict(seen: Any) -> dict[str, np.ndarray]:
    """Converts the ordered dictionary of `DummyVecEnv`."""
    return dict(seen)


def test_stable_baselines3_trains():
    """Its adapter returns the bits of `DummyVecEnv` over single environments; PPO runs."""
    data = highway_data("intersection")
    options: dict[str, Any] = {"observations": ("state", "route")}
    one = asp_env.sb3_vec_env(2, data, **options)
    other = DummyVecEnv([lambda: ReplayEnv(data, **options)] * 2)
    one.seed(3)
    other.seed(3)
    same(one.reset(), _as_dict(other.reset()))
    rng = np.random.default_rng(0)
    for _ in range(10):
        actions = rng.uniform((-0.5, -0.3), (1.0, 0.3), (2, 2)).astype(np.float32)
        returned, (seen, *rest) = one.step(actions), other.step(actions)
        for info in returned[3]:
            info.pop("episode", None)
        same(list(returned), [_as_dict(seen), *rest])
    model = PPO("MultiInputPolicy", one, n_steps=8, batch_size=8, n_epochs=1, device="cpu")
    model.learn(16)
    assert model.num_timesteps == 16


@every_site
def test_a_pickle_continues_in_the_same_way(site):
    """Of the environment itself, in the middle of an episode and through its end."""
    env = make(highway_data(site), observations=("state",))
    env.reset(seed=3)
    for _ in range(5):
        env.step(np.array([0.2, 0.0]))
    twins = [pickle.loads(pickle.dumps(env)), copy.deepcopy(env)]
    over = False
    while not over:
        returned = env.step(np.array([0.2, 0.0]))
        for twin in twins:
            same(list(returned), list(twin.step(np.array([0.2, 0.0]))))
        over = returned[2] or returned[3]
    first = list(env.reset())
    for twin in twins:
        same(first, list(twin.reset()))


@every_site
def test_vector_forecasts_equal_those_of_single_environments(site):
    given: dict[str, Any] = {"data": highway_data(site), **SMALL}
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
