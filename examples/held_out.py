"""Training of PPO and its comparison on held-out scenarios, for the examples of PPO."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from stable_baselines3 import PPO
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.vec_env import VecMonitor, VecNormalize

import asp_env

Policy = Callable[[Any], np.ndarray]
"""A function from observations to actions."""
Scores = dict[tuple[str, str], dict[str, float]]
"""Means by policy and data."""

GAMMA = 0.99


def train_and_compare(
    features: type[BaseFeaturesExtractor],
    train_on: str,
    held_out: Sequence[str],
    *,
    steps: int,
    num_envs: int,
    count: int,
    settings: dict[str, Any],
    **options: Any,
) -> Scores:
    """Trains PPO and scores it, zero actions and random actions on up to `count` scenarios."""
    if train_on.startswith("runs/") and not Path(train_on).exists():
        from scenarios.sumo import synthesize

        places = {"recordings": 8, "locations": 8, "minutes": 3.0, "seed": 11}
        synthesize(Path(train_on), site="intersection", **places)
    envs = VecNormalize(
        VecMonitor(asp_env.sb3_vec_env(num_envs, train_on, **options)),
        norm_obs_keys=["state", "route"],
        gamma=GAMMA,
    )
    # With the default initial deviation, steering of up to 45 degrees leaves every road.
    policy = {"features_extractor_class": features, "log_std_init": -2.0, "net_arch": [128, 128]}
    model = PPO(
        "MultiInputPolicy", envs, gamma=GAMMA, policy_kwargs=policy, seed=0, device="cpu",
        verbose=1, **settings,
    )  # fmt: skip
    model.learn(steps)
    rng = np.random.default_rng(0)
    policies: dict[str, Policy] = {
        "PPO": lambda obs: model.predict(envs.normalize_obs(obs), deterministic=True)[0],
        "zero actions": lambda obs: np.zeros((len(obs["state"]), 2)),
        "random actions": lambda obs: rng.uniform(-1, 1, (len(obs["state"]), 2)),
    }
    return {
        (name, data): score(policy, data, count, **options)
        for data in held_out
        for name, policy in policies.items()
    }


def score(policy: Policy, data: str, count: int, **options: Any) -> dict[str, float]:
    """Drives up to `count` evenly spaced scenarios and returns the means over them."""
    envs = asp_env.sb3_vec_env(count, data, **options)
    last = len(envs.get_attr("scenarios", 0)[0]) - 1
    scenarios = np.unique(np.linspace(0, last, count).astype(int)).tolist()
    envs.set_options([{"scenario": scenarios[b % len(scenarios)]} for b in range(count)])
    obs, running = envs.reset(), np.arange(count) < len(scenarios)
    reward, progress, at_fault = np.zeros((3, count))
    while running.any():
        obs, step_reward, done, infos = envs.step(policy(obs))
        reward += step_reward * running
        for b in np.flatnonzero(done & running):
            progress[b], at_fault[b] = infos[b]["progress"], infos[b]["at_fault"]
        running &= ~done
    columns = {"reward": reward, "progress": progress, "at fault": at_fault}
    return {name: round(float(each[: len(scenarios)].mean()), 3) for name, each in columns.items()}
