"""PPO of stable-baselines3 learns to drive at the roundabout of the sample.

`python -m examples.train_a_policy` trains for 100,000 steps, some seconds, and prints what becomes
of the training scenarios with the most probable actions.
"""

import sys
from collections import Counter
from typing import Any

import numpy as np
import torch
import tyro
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import VecEnv, VecMonitor, VecNormalize

import asp_env

REWARD_WEIGHTS = {"goal": 1.0, "collision": 2.0, "route": 0.1, "comfort": 0.02}


def main(
    data: str = "sample:roundabout", *, steps: int = 100_000, num_envs: int = 64
) -> dict[str, float]:
    """Trains on all scenarios of the data, and returns the share of each ending."""
    envs: VecEnv = asp_env.sb3_vec_env(
        num_envs,
        data,
        observations=("state", "route", "nearest"),
        flatten=True,
        action_type="route",
        action_repeat=3,
        reward_weights=REWARD_WEIGHTS,
    )
    envs = VecNormalize(VecMonitor(envs), gamma=0.9)
    model = PPO(
        "MlpPolicy",
        envs,
        n_steps=32,
        batch_size=1024,
        gamma=0.9,
        learning_rate=6e-4,
        policy_kwargs={"log_std_init": -1.0},
        seed=0,
        device="cpu",
    )
    model.learn(steps)
    return endings(model, envs, steps=100)


def endings(model: PPO, envs: VecNormalize, *, steps: int) -> dict[str, float]:
    """Drives for some steps of all environments, and returns the share of each ending."""
    envs.training = False
    counts: Counter[str] = Counter()
    observations: Any = envs.reset()
    for _ in range(steps):
        actions, _ = model.predict(observations, deterministic=True)
        observations, _, over, infos = envs.step(actions)
        counts.update(infos[b]["ending"] for b in np.flatnonzero(over))
    return {name: count / counts.total() for name, count in counts.most_common()}


if __name__ == "__main__":
    torch.set_num_threads(1)
    for ending, share in tyro.cli(main).items():
        sys.stdout.write(f"{ending:12} {share:.2f}\n")
