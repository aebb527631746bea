"""The ids with light observations, flattening, and the hint at large observations."""

import logging
import warnings
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode
from gymnasium.wrappers import FlattenObservation

import asp_env
from asp_env.envs import hints
from asp_env.envs.replay import ReplayEnv
from asp_env.sim.observation import NEAREST_AGENTS, NEAREST_FIELDS
from tests.envs.same import same, same_through_ends

LIGHT = ("Vectors", "State")
ACTIONS = np.random.default_rng(1).uniform((-0.5, -0.3), (1.0, 0.3), (60, 3, 2))


@pytest.mark.parametrize("world", ["Replay", "HighwayIntersection", "HighwayRoundabout"])
@pytest.mark.parametrize("suffix", LIGHT)
def test_every_world_has_light_ids(world, suffix):
    """Both entry points; the highway twins differ in their data only."""
    spec, replay = (gymnasium.spec(f"asp_env/{name}{suffix}-v0") for name in (world, "Replay"))
    assert (spec.entry_point, spec.vector_entry_point) == (
        replay.entry_point,
        replay.vector_entry_point,
    )
    assert {k: v for k, v in spec.kwargs.items() if k != "data"} == replay.kwargs
    data = gymnasium.spec(f"asp_env/{world}-v0").kwargs.get("data")
    assert spec.kwargs.get("data") == data


@pytest.mark.parametrize("suffix", LIGHT)
@pytest.mark.parametrize("mode", ["NextStep", "SameStep", "Disabled"])
def test_vector_twins_return_the_bits_of_single_environments(crossing, suffix, mode):
    modes: list[tuple[str, dict[str, Any]]] = [
        ("vector_entry_point", {"autoreset_mode": mode}),
        ("sync", {"vector_kwargs": {"autoreset_mode": mode}}),
    ]
    made: list[Any] = [
        gymnasium.make_vec(
            f"asp_env/Replay{suffix}-v0",
            num_envs=3,
            vectorization_mode=vectorization,
            data=crossing,
            max_episode_steps=12,
            **options,
        )
        for vectorization, options in modes
    ]
    assert made[0].observation_space == made[1].observation_space
    one, other = made
    assert same_through_ends(one, other, AutoresetMode(mode), list(ACTIONS)) > 6


def test_one_vector_is_what_gymnasium_flattens(crossing):
    """`ReplayState` is `FlattenObservation` of state, route and nearest agents: 9 + 60 + 8 · 13."""
    env = gymnasium.make("asp_env/ReplayState-v0", data=crossing)
    other = FlattenObservation(ReplayEnv(crossing, observations=("state", "route", "nearest")))
    assert env.observation_space == other.observation_space
    assert env.observation_space.shape == (9 + 60 + 8 * 13,)
    same(env.reset(seed=4)[0], other.reset(seed=4)[0])
    for action in ACTIONS[:8, 0]:
        same(env.step(action)[:4], other.step(action)[:4])


def test_parts_are_those_of_the_wrapper(crossing):
    """Vectors of the same numbers; rasters stay images."""
    options: dict[str, Any] = {"observations": ("raster", "actions", "route"), "raster_px": 24}
    env = ReplayEnv(crossing, flatten="parts", **options)
    other = asp_env.FlatParts(ReplayEnv(crossing, **options))
    assert env.observation_space == other.observation_space
    seen = env.reset(seed=4)[0]
    same(seen, other.reset(seed=4)[0])
    assert {name: part.shape for name, part in seen.items()} == {
        "raster": (12, 24, 24),
        "actions": (30,),
        "route": (60,),
    }


def test_nearest_agents_are_the_present_tick_of_the_vectors(crossing):
    """The rows after the ego, and then whether there is an agent."""
    env = ReplayEnv(crossing, observations=("vectors", "nearest"))
    seen = env.reset(seed=1)[0]
    for action in ACTIONS[:10, 0]:
        assert seen["nearest"].shape == (NEAREST_AGENTS, len(NEAREST_FIELDS))
        same(seen["nearest"][:, :-1], seen["agents"][1 : NEAREST_AGENTS + 1, -1])
        present = seen["agents_valid"][1 : NEAREST_AGENTS + 1, -1].astype(np.float32)
        same(seen["nearest"][:, -1], present)
        assert present.any()
        seen, _, over, limit, _ = env.step(action)
        if over or limit:
            break


@pytest.mark.parametrize("suffix", LIGHT)
def test_the_checker_passes(crossing, suffix):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.filterwarnings("ignore", message=".*alternative render modes")
        check_env(gymnasium.make(f"asp_env/Replay{suffix}-v0", data=crossing).unwrapped)


def test_stable_baselines3_learns_on_both_ids_by_their_names(crossing):
    """PPO with its default policies, on single environments and on the batch."""
    pytest.importorskip("stable_baselines3")
    from stable_baselines3 import PPO
    from stable_baselines3.common.env_util import make_vec_env

    for suffix, policy in (("State", "MlpPolicy"), ("Vectors", "MultiInputPolicy")):
        envs = make_vec_env(f"asp_env/Replay{suffix}-v0", 2, env_kwargs={"data": crossing})
        PPO(policy, envs, n_steps=8, batch_size=8, n_epochs=1).learn(16)
    batch = asp_env.sb3_vec_env(
        2, crossing, observations=("state", "route", "nearest"), flatten=True, max_episode_steps=5
    )
    PPO("MlpPolicy", batch, n_steps=8, batch_size=8, n_epochs=1).learn(16)


def test_torchrl_makes_the_environment(crossing):
    """`GymEnv` asks for `frameskip` and goes on after the `TypeError` of an unknown argument."""
    envs = pytest.importorskip("torchrl.envs")
    env = envs.GymEnv("asp_env/ReplayState-v0", data=crossing, frame_skip=2)
    assert env.wrapper_frame_skip == 2
    assert env.rollout(1)["observation"].shape == (1, 173)


@pytest.mark.parametrize(
    "make", [asp_env.ReplayEnv, lambda **options: asp_env.ReplayVectorEnv(2, **options)]
)
def test_frameskip_is_an_unexpected_keyword_argument(make):
    """The text that TorchRL's `GymEnv` looks for."""
    with pytest.raises(TypeError, match="unexpected keyword argument 'frameskip'"):
        make(frameskip=1)
    with pytest.raises(TypeError, match="unexpected keyword argument 'frameskip'"):
        gymnasium.make("asp_env/Replay-v0", frameskip=1)


@pytest.fixture
def hinted(caplog: pytest.LogCaptureFixture):
    """The log, with a hint that has not been given."""
    hints._warn_once.cache_clear()
    caplog.set_level(logging.WARNING, logger="asp_env")
    yield caplog
    hints._warn_once.cache_clear()


def test_a_batch_of_large_rasters_is_hinted_at_once(hinted, crossing):
    """12 · 360 · 240 bytes of raster, 120 of actions and 36 of state: 1.04 MB."""
    for _ in range(2):
        asp_env.ReplayVectorEnv(2, crossing)
    assert [record.levelname for record in hinted.records] == ["WARNING"]
    assert "1.04 MB" in hinted.text
    assert "asp_env/ReplayState-v0" in hinted.text


def test_a_single_environment_is_hinted_at_only_for_a_learner(hinted, crossing, monkeypatch):
    monkeypatch.setattr(hints, "LEARNERS", ("no_learner",))
    asp_env.ReplayEnv(crossing)
    assert not hinted.records
    monkeypatch.setattr(hints, "LEARNERS", ("gymnasium",))
    asp_env.ReplayEnv(crossing, observations=("vectors", "state"))
    assert not hinted.records
    asp_env.ReplayEnv(crossing)
    assert len(hinted.records) == 1
