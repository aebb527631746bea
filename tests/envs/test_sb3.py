"""The stable-baselines3 adapter compared with `DummyVecEnv` over single environments."""

import copy
import subprocess
import sys
from typing import Any

import gymnasium
import numpy as np
import pytest
from stable_baselines3 import PPO
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, VecMonitor, VecNormalize

import asp_env
from asp_env.envs.replay import ReplayEnv
from asp_env.envs.sb3 import ReplayVecEnv
from tests.envs.same import same

COUNT = 4
OPTIONS: dict[str, Any] = {"observations": ("raster", "state", "route"), "raster_px": (60, 40)}


def _adapter(crossing: str, mode: str = "SameStep", **options: Any) -> VecEnv:
    return ReplayVecEnv(
        gymnasium.make_vec(
            "asp_env/Replay-v0",
            num_envs=COUNT,
            vectorization_mode="vector_entry_point",
            autoreset_mode=mode,
            data=crossing,
            **(OPTIONS | options),
        )
    )


def _dummy(crossing: str, **options: Any) -> VecEnv:
    return DummyVecEnv([lambda: ReplayEnv(crossing, **(OPTIONS | options))] * COUNT)


def _as_dict(seen: Any) -> dict[str, np.ndarray]:
    """Converts the ordered dictionary of `DummyVecEnv`."""
    return dict(seen)


@pytest.mark.parametrize(("mode", "traffic"), [("SameStep", "log"), ("Disabled", "idm")])
def test_returns_the_bits_of_single_environments(crossing, mode, traffic):
    """Observations, rewards, endings, infos with `terminal_observation`, and infos of resets."""
    one, other = _adapter(crossing, mode, traffic=traffic), _dummy(crossing, traffic=traffic)
    assert (one.observation_space, one.action_space) == (
        other.observation_space,
        other.action_space,
    )
    assert one.seed(3) == other.seed(3)
    same(one.reset(), _as_dict(other.reset()))
    rng, ends, limits = np.random.default_rng(0), 0, 0
    for _ in range(100):
        same(one.reset_infos, other.reset_infos)
        actions = rng.uniform((-0.5, -0.3), (1.0, 0.3), (COUNT, 2)).astype(np.float32)
        actions[0] = -1.0, 0.0  # This ego stands until the data end.
        returned, (seen, *rest) = one.step(actions), other.step(actions)
        for info, over in zip(returned[3], returned[2], strict=True):
            statistics = {"r": info["episode_return"], "l": info["episode_length"]}
            assert info.pop("episode", None) == (statistics if over else None)
        same(list(returned), [_as_dict(seen), *rest])
        ends += int(returned[2].sum())
        limits += sum(info["TimeLimit.truncated"] for info in returned[3])
        assert all(("terminal_observation" in info) == over for info, over in zip(
            returned[3], returned[2], strict=True
        ))  # fmt: skip
    assert ends > 2 * COUNT
    assert limits


def test_seeds_and_options_apply_to_one_reset(crossing):
    """One value for all environments or one for each, as in `DummyVecEnv`."""
    one, other = _adapter(crossing), _dummy(crossing)
    for options in (
        {"scenario": 4},
        [{"scenario": b} for b in range(COUNT)],
        [{}, {}, {"scenario": 1}, {}],
    ):
        for envs in (one, other):
            envs.seed(8)
            envs.set_options(options)
        for _ in range(2):
            same(one.reset(), _as_dict(other.reset()))
            same(one.reset_infos, other.reset_infos)


def test_attributes_and_methods_of_each_environment(crossing):
    """Most attributes are shared by all environments."""
    one, other = _adapter(crossing, render_mode=None), _dummy(crossing)
    for envs in (one, other):
        envs.seed(5)
        envs.reset()
    for name in ("render_mode", "np_random_seed", "observation_space", "action_space", "dt_s"):
        same(one.get_attr(name), other.get_attr(name))
        same(one.get_attr(name, [2, 0]), other.get_attr(name, [2, 0]))
    same(one.get_attr("np_random", 1)[0].random(3), other.get_attr("np_random", 1)[0].random(3))
    assert len(one.get_attr("scenarios", 0)[0]) == len(other.get_attr("scenarios", 0)[0])
    assert one.has_attr("recordings")
    assert not one.has_attr("colour")
    scenes = one.env_method("scene")
    for batched, single in zip(scenes, other.env_method("scene"), strict=True):
        agents, expected = (np.flatnonzero(scene.ids[0] >= 0) for scene in (batched, single))
        same(batched.states[:, agents], single.states[:, expected])
    assert one.env_is_wrapped(gymnasium.Wrapper) == [False] * COUNT
    for call in (lambda: one.env_method("snapshot", indices=0), lambda: one.get_attr("scene")):
        with pytest.raises(AttributeError, match=r"expected one of scene|scene is a method"):
            call()
    one.set_attr("label", "first")
    assert one.get_attr("label") == ["first"] * COUNT
    with pytest.raises(asp_env.AspEnvError, match="all environments share it"):
        one.set_attr("label", "second", indices=[1])


def test_images_are_those_of_single_environments(crossing):
    one, other = (make(crossing, render_mode="rgb_array") for make in (_adapter, _dummy))
    for envs in (one, other):
        envs.seed(5)
        envs.reset()
    same(list(one.get_images()), list(other.get_images()))
    same(one.render(), other.render())
    same(one.env_method("render", indices=[3]), other.env_method("render", indices=[3]))
    silent = _adapter(crossing)
    silent.reset()
    with pytest.warns(UserWarning, match="render_mode='rgb_array'"):
        assert list(silent.get_images()) == [None] * COUNT


def test_ppo_trains_and_is_evaluated(crossing):
    """With `MultiInputPolicy` behind `VecMonitor` and `VecNormalize`."""
    envs = VecNormalize(VecMonitor(_adapter(crossing)), norm_obs_keys=["state", "route"])
    model = PPO("MultiInputPolicy", envs, n_steps=16, batch_size=32, n_epochs=1, seed=0)
    model.learn(160)
    assert len(model.ep_info_buffer or ())
    envs.training, envs.norm_reward = False, False
    scores = evaluate_policy(model, envs, n_eval_episodes=6, return_episode_rewards=True)
    assert np.shape(scores) == (2, 6)
    assert np.isfinite(scores).all()
    envs.close()


def test_adapter_over_prediction_features(crossing):
    """The forecasts are also part of `terminal_observation`."""
    made = gymnasium.make_vec(
        "asp_env/Replay-v0",
        num_envs=COUNT,
        vectorization_mode="vector_entry_point",
        autoreset_mode="Disabled",
        data=crossing,
        observations=("state",),
    )
    envs = ReplayVecEnv(asp_env.VectorPredictionFeatures(made, "constant-velocity", agents=2))
    envs.seed(0)
    seen = envs.reset()
    assert set(seen) == {"state", "forecast", "forecast_probabilities", "forecast_valid"}
    last, over = None, np.zeros(COUNT, dtype=bool)
    while last is None:
        seen, _, over, infos = envs.step(np.full((COUNT, 2), (1.0, 0.2), dtype=np.float32))
        last = next((i["terminal_observation"] for i in infos if "terminal_observation" in i), None)
    assert last in envs.observation_space
    assert over.any()
    assert envs.get_attr("dt_s", 0) == [0.2]
    assert len(envs.env_method("scene", indices=0)) == 1


def test_a_copy_continues_in_the_same_way(crossing):
    """Through the ends of episodes."""
    envs = _adapter(crossing)
    envs.seed(2)
    envs.reset()
    twin = copy.deepcopy(envs)
    for _ in range(20):
        actions = np.full((COUNT, 2), (1.0, 0.3), dtype=np.float32)
        same(envs.step(actions), twin.step(actions))
    same(envs.get_attr("np_random_seed"), twin.get_attr("np_random_seed"))


def test_the_autoreset_mode_next_step_is_rejected(crossing):
    with pytest.raises(asp_env.AspEnvError, match="needs autoreset_mode='SameStep'"):
        _adapter(crossing, "NextStep")


@pytest.mark.parametrize(
    ("package", "call"),
    [("stable_baselines3", "sb3_vec_env(2)"), ("pettingzoo", "parallel_env()")],
)
def test_a_missing_extra_is_named(package, call):
    """`import asp_env` works without the package."""
    script = (
        f"import sys; sys.modules[{package!r}] = None\n"
        "import asp_env\n"
        f"try: asp_env.{call}\n"
        "except asp_env.AspEnvError as error: print(error)"
    )
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=True
    )
    assert package in done.stdout
    assert "pip install 'asp-env[rl]'" in done.stdout
