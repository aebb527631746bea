"""PPO on small pictures, 12 channels of 90 by 60 pixels, with the ego's state and its route.

`python -m examples.train_ppo_raster` makes traffic of eight places, drives in it for some minutes
and then where it has never been, beside coasting and random actions.
"""

from collections.abc import Sequence

import numpy as np
import torch
from gymnasium import spaces
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor

from examples.held_out import Scores, train_and_compare

PARTS = ("raster", "state", "route")

SETTINGS = {"n_steps": 32, "batch_size": 64, "n_epochs": 4, "learning_rate": 2e-4}
"""Of PPO."""


class PictureFeatures(BaseFeaturesExtractor):
    """State and route as they are, and what three cheap convolutions see in the picture."""

    def __init__(self, space: spaces.Dict, width: int = 64) -> None:
        """The first convolution looks at blocks of 4 by 4 pixels, 3.2 m by 3.2 m."""
        flat = sum(int(np.prod(space[name].shape or ())) for name in ("state", "route"))
        super().__init__(space, flat + width)
        channels, height, width_px = space["raster"].shape or (0, 0, 0)
        cells = -(-(height // 4) // 4) * -(-(width_px // 4) // 4)
        self.picture = torch.nn.Sequential(
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

    def forward(self, seen: dict[str, torch.Tensor]) -> torch.Tensor:
        """(B, features)."""
        return torch.cat(
            [seen["state"], seen["route"].flatten(1), self.picture(seen["raster"])], dim=1
        )


def main(
    train_on: str = "runs/eight-places",
    held_out: Sequence[str] = ("sample:intersection", "synthetic:intersection"),
    *,
    steps: int = 150_000,
    num_envs: int = 64,
    count: int = 200,
) -> Scores:
    """Trains, and returns the scores on up to `count` scenarios of each held-out DATA."""
    return train_and_compare(
        PictureFeatures, train_on, held_out, steps=steps, num_envs=num_envs, count=count,
        settings=SETTINGS, observations=PARTS, raster_px=(90, 60),
    )  # fmt: skip


if __name__ == "__main__":
    import sys

    import tyro

    torch.set_num_threads(1)
    for (policy, data), means in tyro.cli(main).items():
        sys.stdout.write(f"{policy:15} {data:25} {means}\n")
