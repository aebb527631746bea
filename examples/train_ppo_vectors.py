"""Train PPO on vectors for some minutes, and see how it drives where it has never been."""

from collections.abc import Callable

import numpy as np
import torch
from gymnasium import spaces
from stable_baselines3 import PPO
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.vec_env import VecMonitor, VecNormalize

import asp_env

PARTS = ("vectors", "state", "route")
AGENT_SCALE = (20, 20, 1, 1, 10, 5, 2, 1, 1, 1, 1, 1)
"""Of x, y, cosine, sine, speed, length, width and five classes."""

Policy = Callable[[dict[str, np.ndarray]], np.ndarray]


class Features(BaseFeaturesExtractor):
    """State and route as they are, and of all other agents the most of each feature."""

    def __init__(self, space: spaces.Dict, width: int = 64) -> None:
        """Agents are seen as they are now and were 0.6 s ago."""
        flat = sum(int(np.prod(space[name].shape or ())) for name in ("state", "route"))
        super().__init__(space, flat + width)
        scale = torch.tensor(AGENT_SCALE, dtype=torch.float32)
        self.register_buffer("scale", scale)
        layers = [torch.nn.Linear(2 * len(scale), width), torch.nn.ReLU()]
        self.each = torch.nn.Sequential(*layers, torch.nn.Linear(width, width), torch.nn.ReLU())

    def forward(self, seen: dict[str, torch.Tensor]) -> torch.Tensor:
        """(B, features)."""
        agents = seen["agents"][:, 1:, [-1, -4]] / self.scale
        there = seen["agents_valid"][:, 1:, -1, None]
        most = (self.each(agents.flatten(2)) * there).amax(dim=1)
        return torch.cat([seen["state"], seen["route"].flatten(1), most], dim=1)


def score(policy: Policy, data: str, count: int, **options) -> dict[str, float]:
    """Drives that many scenarios of DATA, evenly chosen, and averages over them."""
    envs = asp_env.sb3_vec_env(count, data, **options)
    chosen = np.linspace(0, len(envs.get_attr("scenarios", 0)[0]) - 1, count).astype(int)
    envs.set_options([{"scenario": int(number)} for number in chosen])
    seen, running = envs.reset(), np.ones(count, dtype=bool)
    reward, progress, at_fault = np.zeros((3, count))
    while running.any():
        seen, gained, over, infos = envs.step(policy(seen))
        reward += gained * running
        for b in np.flatnonzero(over & running):
            progress[b], at_fault[b] = infos[b]["progress"], infos[b]["at_fault"]
        running &= ~over
    means = {"reward": reward, "progress": progress, "at fault": at_fault}
    return {name: round(float(each.mean()), 3) for name, each in means.items()}


def main(
    train_on: str = "synthetic:intersection",
    held_out: str = "sample:intersection",
    *,
    steps: int = 800_000,
    num_envs: int = 64,
    count: int = 46,
) -> dict[str, dict[str, float]]:
    """Returns the scores of PPO, of coasting and of random actions on held-out scenarios."""
    made = asp_env.sb3_vec_env(num_envs, train_on, observations=PARTS)
    envs = VecNormalize(VecMonitor(made), norm_obs_keys=["state", "route"], gamma=0.98)
    policy = {"features_extractor_class": Features, "log_std_init": -2.0, "net_arch": [128, 128]}
    model = PPO(
        "MultiInputPolicy", envs, n_steps=64, batch_size=1024, n_epochs=6, learning_rate=5e-4,
        gamma=0.98, policy_kwargs=policy, seed=0, device="cpu", verbose=1,
    )  # fmt: skip
    model.learn(steps)
    rng = np.random.default_rng(0)
    policies: dict[str, Policy] = {
        "PPO": lambda seen: model.predict(envs.normalize_obs(seen), deterministic=True)[0],
        "zero actions": lambda seen: np.zeros((len(seen["state"]), 2)),
        "random actions": lambda seen: rng.uniform(-1, 1, (len(seen["state"]), 2)),
    }
    return {
        name: score(each, held_out, count, observations=PARTS) for name, each in policies.items()
    }
