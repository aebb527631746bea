"""Infos of constant keys and shapes, success, and statistics of episodes."""

from collections.abc import Iterator
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.wrappers import RecordEpisodeStatistics
from gymnasium.wrappers.vector import RecordEpisodeStatistics as VectorStatistics

import asp_env
from asp_env.data.scenarios.tags import TAGS
from asp_env.envs.replay import ReplayEnv
from tests.envs.same import same

RNG_SEED = 2
OPTIONS: dict[str, Any] = {"observations": ("state",)}


def _shape(info: Any) -> Any:
    """The keys, types and shapes of an info."""
    if isinstance(info, dict):
        return {name: _shape(value) for name, value in sorted(info.items())}
    return (info.dtype, info.shape) if isinstance(info, np.ndarray) else type(info)


def _episode(env: Any, **reset: Any) -> Iterator[tuple[float, dict[str, Any]]]:
    """The rewards and infos of one episode; the first is that of `reset`."""
    rng, over = np.random.default_rng(RNG_SEED), False
    yield 0.0, env.reset(**reset)[1]
    while not over:
        _, reward, terminated, truncated, info = env.step(rng.uniform((0.0, -0.1), (1.0, 0.1)))
        over = terminated or truncated
        yield reward, info


def test_infos_of_resets_and_steps_have_the_same_keys_types_and_shapes(crossing):
    """In the single and the parallel environment."""
    env = ReplayEnv(crossing, **OPTIONS)
    shapes = [_shape(info) for seed in range(3) for _, info in _episode(env, seed=seed)]
    assert all(shape == shapes[0] for shape in shapes)
    assert shapes[0]["tags"] == (np.dtype(bool), (len(TAGS),))
    parallel = asp_env.parallel_env(crossing, **OPTIONS)
    infos = parallel.reset(seed=0)[1]
    while parallel.agents:
        assert all(_shape(info) == shapes[0] for info in infos.values())
        actions = {agent: np.zeros(2) for agent in parallel.agents}
        infos = parallel.step(actions)[4]


def test_infos_of_vector_environments_have_the_same_keys_types_and_shapes(crossing):
    """Gymnasium's, and those of the adapter for stable-baselines3 between the ends of episodes."""
    envs = asp_env.ReplayVectorEnv(2, crossing, **OPTIONS)
    shape = _shape(envs.reset(seed=0)[1])
    for _ in range(60):
        assert _shape(envs.step(np.full((2, 2), (0.5, 0.0)))[4]) == shape
    pytest.importorskip("stable_baselines3")
    adapter = asp_env.sb3_vec_env(2, crossing, **OPTIONS)
    adapter.seed(0)
    adapter.reset()
    added = {"TimeLimit.truncated", "episode", "terminal_observation"}
    for _ in range(60):
        for info in adapter.step(np.full((2, 2), (0.5, 0.0), dtype=np.float32))[3]:
            assert set(info) - added == set(adapter.reset_infos[0])


def test_tags_are_bits_in_the_order_of_their_names(crossing):
    env = ReplayEnv(crossing, **OPTIONS)
    for number, scenario in enumerate(env.scenarios):
        tags = env.reset(options={"scenario": number})[1]["tags"]
        assert tuple(np.array(TAGS)[tags]) == scenario.tags
    assert any(scenario.tags for scenario in env.scenarios)


def test_the_info_of_a_reset_describes_an_episode_without_a_step(crossing):
    info = ReplayEnv(crossing, **OPTIONS).reset(seed=0)[1]
    assert (info["ending"], info["is_success"]) == ("RUNNING", False)
    assert (info["episode_return"], info["episode_length"]) == (0.0, 0)
    assert set(info["reward_terms"].values()) == {0.0}


def test_success_is_the_end_at_the_goal(crossing):
    """Only there, and only in the last info; a standing ego runs out of data."""
    env = ReplayEnv(crossing, **OPTIONS)
    endings = set()
    for number in range(len(env.scenarios)):
        for action in ((0.3, 0.0), (-1.0, 0.0), (1.0, 0.8)):
            info = env.reset(options={"scenario": number})[1]
            over = False
            while not over:
                assert not info["is_success"]
                _, _, terminated, truncated, info = env.step(np.array(action))
                over = terminated or truncated
            assert info["is_success"] == (info["ending"] == "GOAL")
            endings.add(info["ending"])
    assert {"GOAL", "OUT_OF_DATA"} < endings


def test_statistics_are_the_sum_of_rewards_and_the_number_of_steps(crossing):
    """After every step, and in a restored episode; a repeated action counts as one step."""
    env = ReplayEnv(crossing, action_repeat=2, **OPTIONS)
    total, snapshot = 0.0, None
    for steps, (reward, info) in enumerate(_episode(env, seed=1)):
        total += reward
        assert (info["episode_return"], info["episode_length"]) == (total, steps)
        if steps == 3:
            snapshot, at_3 = env.snapshot(), env.step(np.zeros(2))[4]
            env.restore(snapshot)
            same(env.step(np.zeros(2))[4], at_3)
            env.restore(snapshot)
    assert snapshot is not None


def test_gymnasiums_statistics_on_top_are_the_same(crossing):
    """`RecordEpisodeStatistics` of single and of vector environments adds its own `episode`."""
    env = RecordEpisodeStatistics(ReplayEnv(crossing, **OPTIONS))
    *_, (_, info) = _episode(env, seed=1)
    assert info["episode"]["r"] == pytest.approx(info["episode_return"])
    assert info["episode"]["l"] == info["episode_length"]
    envs = VectorStatistics(asp_env.ReplayVectorEnv(3, crossing, **OPTIONS))
    envs.reset(seed=1)
    ended = 0
    while ended < 4:
        *_, infos = envs.step(np.full((3, 2), (0.5, 0.0)))
        for b in np.flatnonzero(infos.get("_episode", np.zeros(3, dtype=bool))):
            assert infos["episode"]["r"][b] == pytest.approx(infos["episode_return"][b], abs=1e-5)
            assert infos["episode"]["l"][b] == infos["episode_length"][b]
            ended += 1


def test_stable_baselines3_reads_success_and_statistics(crossing):
    """`EvalCallback` and PPO's log, with and without `VecMonitor`, whose numbers are the same."""
    pytest.importorskip("stable_baselines3")
    from stable_baselines3 import PPO
    from stable_baselines3.common.callbacks import EvalCallback
    from stable_baselines3.common.vec_env import VecMonitor

    envs, watched = (VecMonitor(asp_env.sb3_vec_env(2, crossing, **OPTIONS)) for _ in range(2))
    callback = EvalCallback(watched, n_eval_episodes=4, eval_freq=64, verbose=0)
    model = PPO("MultiInputPolicy", envs, n_steps=64, batch_size=64, n_epochs=1, seed=0)
    model.learn(128, callback=callback)
    assert len(callback._is_success_buffer) == 4
    model = PPO("MultiInputPolicy", envs.venv, n_steps=64, batch_size=64, n_epochs=1, seed=0)
    model.learn(128)
    assert model.ep_info_buffer
    assert np.isfinite([each["r"] for each in model.ep_info_buffer]).all()
    alone, monitored = (asp_env.sb3_vec_env(2, crossing, **OPTIONS) for _ in range(2))
    pairs = []
    for each in (alone, VecMonitor(monitored)):
        each.seed(1)
        each.reset()
        ended = []
        while len(ended) < 4:
            infos = each.step(np.full((2, 2), (0.5, 0.0), dtype=np.float32))[3]
            ended += [info["episode"] for info in infos if "episode" in info]
        pairs.append([(each["r"], each["l"]) for each in ended])
    np.testing.assert_allclose(*pairs, atol=2e-6)


def test_max_episode_steps_truncates_as_a_time_limit(crossing):
    """`gymnasium.make_vec(max_episode_steps=3)`, whose episodes have 3 steps."""
    envs = gymnasium.make_vec(
        "asp_env/Replay-v0",
        num_envs=2,
        vectorization_mode="vector_entry_point",
        max_episode_steps=3,
        data=crossing,
        **OPTIONS,
    )
    envs.reset(seed=0)
    limits = [envs.step(np.zeros((2, 2)))[3].tolist() for _ in range(8)]
    assert limits == [[False] * 2, [False] * 2, [True] * 2, [False] * 2] * 2
    with pytest.raises(
        asp_env.AspEnvError, match="max_episode_steps 0: expected a whole number of at least 1"
    ):
        asp_env.ReplayVectorEnv(2, crossing, max_episode_steps=0, **OPTIONS)
