"""PPO on vectors: the nearest agents, the ego's state and its route.

`python -m examples.train_ppo_vectors` makes traffic of eight places, drives in it for some minutes
and then where it has never been, beside coasting and random actions.
"""

from collections.abc import Sequence

import numpy as np
import torch
from gymnasium import spaces
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor

from examples.held_out import Scores, train_and_compare

PARTS = ("vectors", "state", "route")
AGENT_SCALE = (20.0, 20.0, 1.0, 1.0, 10.0, 5.0, 2.0, 1.0, 1.0, 1.0, 1.0, 1.0)
"""Of x, y, cosine, sine, speed, length, width and five classes."""

SETTINGS = {"n_steps": 64, "batch_size": 1024, "n_epochs": 6, "learning_rate": 5e-4}
"""Of PPO."""


class VectorFeatures(BaseFeaturesExtractor):
    """State and route as they are; of what a small network says of each other agent, the most."""

    def __init__(self, space: spaces.Dict, width: int = 64) -> None:
        """Agents are shown as they are now and were 0.6 s ago."""
        flat = sum(int(np.prod(space[name].shape or ())) for name in ("state", "route"))
        super().__init__(space, flat + width)
        self.scale = torch.nn.Parameter(torch.tensor(AGENT_SCALE), requires_grad=False)
        self.each = torch.nn.Sequential(
            torch.nn.Linear(2 * len(AGENT_SCALE), width),
            torch.nn.ReLU(),
            torch.nn.Linear(width, width),
            torch.nn.ReLU(),
        )

    def forward(self, seen: dict[str, torch.Tensor]) -> torch.Tensor:
        """(B, features)."""
        agents = seen["agents"][:, 1:, [-1, -4]] / self.scale
        there = seen["agents_valid"][:, 1:, -1, None]
        most = (self.each(agents.flatten(2)) * there).amax(dim=1)
        return torch.cat([seen["state"], seen["route"].flatten(1), most], dim=1)


def main(
    train_on: str = "runs/eight-places",
    held_out: Sequence[str] = ("sample:intersection", "synthetic:intersection"),
    *,
    steps: int = 200_000,
    num_envs: int = 64,
    count: int = 200,
) -> Scores:
    """Trains, and returns the scores on up to `count` scenarios of each held-out DATA."""
    return train_and_compare(
        VectorFeatures, train_on, held_out, steps=steps, num_envs=num_envs, count=count,
        settings=SETTINGS, observations=PARTS,
    )  # fmt: skip


if __name__ == "__main__":
    import sys

    import tyro

    torch.set_num_threads(1)
    for (policy, data), means in tyro.cli(main).items():
        sys.stdout.write(f"{policy:15} {data:25} {means}\n")
