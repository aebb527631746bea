"""PPO on vectors: the nearest agents, the ego's state and its route.

`python -m examples.train_ppo_vectors` generates traffic of eight locations, trains there for
some minutes, and scores PPO, zero actions and random actions at other locations.
"""

import sys
from collections.abc import Sequence

import numpy as np
import torch
import tyro
from gymnasium import spaces
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor

from examples.held_out import Scores, train_and_compare

OBSERVATIONS = ("vectors", "state", "route")
AGENT_SCALE = (20.0, 20.0, 1.0, 1.0, 10.0, 5.0, 2.0, 1.0, 1.0, 1.0, 1.0, 1.0)
"""Divisors of x, y, cosine, sine, speed, length, width and five classes."""

SETTINGS = {"n_steps": 64, "batch_size": 1024, "n_epochs": 6, "learning_rate": 5e-4}
"""Hyperparameters of PPO, chosen by hand."""


class VectorFeatures(BaseFeaturesExtractor):
    """Unchanged state and route, and the maximum of a small network over the other agents."""

    def __init__(self, space: spaces.Dict, width: int = 64) -> None:
        """The network sees each agent now and 0.6 s ago."""
        flat = sum(int(np.prod(space[name].shape or ())) for name in ("state", "route"))
        super().__init__(space, flat + width)
        self.scale = torch.nn.Parameter(torch.tensor(AGENT_SCALE), requires_grad=False)
        self.agent = torch.nn.Sequential(
            torch.nn.Linear(2 * len(AGENT_SCALE), width),
            torch.nn.ReLU(),
            torch.nn.Linear(width, width),
            torch.nn.ReLU(),
        )

    def forward(self, obs: dict[str, torch.Tensor]) -> torch.Tensor:
        """Returns features (B, width of state, route and encoding)."""
        agents = obs["agents"][:, 1:, [-1, -4]] / self.scale
        present = obs["agents_valid"][:, 1:, -1, None]
        traffic = (self.agent(agents.flatten(2)) * present).amax(dim=1)
        return torch.cat([obs["state"], obs["route"].flatten(1), traffic], dim=1)


def main(
    train_on: str = "runs/eight-places",
    held_out: Sequence[str] = ("sample:intersection", "synthetic:intersection"),
    *,
    steps: int = 200_000,
    num_envs: int = 64,
    count: int = 200,
) -> Scores:
    """Trains, and returns the scores on up to `count` scenarios of each of `held_out`."""
    return train_and_compare(
        VectorFeatures, train_on, held_out, steps=steps, num_envs=num_envs, count=count,
        settings=SETTINGS, observations=OBSERVATIONS,
    )  # fmt: skip


if __name__ == "__main__":
    torch.set_num_threads(1)
    for (policy, data), means in tyro.cli(main).items():
        sys.stdout.write(f"{policy:15} {data:25} {means}\n")
