"""PPO on small rasters, 12 channels of 90 by 60 pixels, with the ego's state and route.

`python -m examples.train_ppo_raster` generates traffic of eight locations, trains there for
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

OBSERVATIONS = ("raster", "state", "route")

SETTINGS = {"n_steps": 32, "batch_size": 64, "n_epochs": 4, "learning_rate": 2e-4}
"""Hyperparameters of PPO, chosen by hand."""


class RasterFeatures(BaseFeaturesExtractor):
    """Unchanged state and route, and an encoding of the raster by three convolutions."""

    def __init__(self, space: spaces.Dict, width: int = 64) -> None:
        """The first convolution has blocks of 4 by 4 pixels, 3.2 m by 3.2 m."""
        flat = sum(int(np.prod(space[name].shape or ())) for name in ("state", "route"))
        super().__init__(space, flat + width)
        channels, height, width_px = space["raster"].shape or (0, 0, 0)
        cells = -(-(height // 4) // 4) * -(-(width_px // 4) // 4)
        self.raster = torch.nn.Sequential(
            torch.nn.Conv2d(channels, 16, 4, stride=4),
            torch.nn.ReLU(),
            torch.nn.Conv2d(16, 32, 3, stride=2, padding=1),
            torch.nn.ReLU(),
            torch.nn.Conv2d(32, 32, 3, stride=2, padding=1),
            torch.nn.ReLU(),
            torch.nn.Flatten(),
            torch.nn.Linear(32 * cells, width),
            torch.nn.ReLU(),
        )

    def forward(self, obs: dict[str, torch.Tensor]) -> torch.Tensor:
        """Returns features (B, width of state, route and encoding)."""
        return torch.cat([obs["state"], obs["route"].flatten(1), self.raster(obs["raster"])], dim=1)


def main(
    train_on: str = "runs/eight-places",
    held_out: Sequence[str] = ("sample:intersection", "synthetic:intersection"),
    *,
    steps: int = 150_000,
    num_envs: int = 64,
    count: int = 200,
) -> Scores:
    """Trains, and returns the scores on up to `count` scenarios of each of `held_out`."""
    return train_and_compare(
        RasterFeatures, train_on, held_out, steps=steps, num_envs=num_envs, count=count,
        settings=SETTINGS, observations=OBSERVATIONS, raster_px=(90, 60),
    )  # fmt: skip


if __name__ == "__main__":
    torch.set_num_threads(1)
    for (policy, data), means in tyro.cli(main).items():
        sys.stdout.write(f"{policy:15} {data:25} {means}\n")
