"""MTP: multiple trajectory prediction (Cui et al. 2019), the state-to-position baseline.

The observation and the present speed, acceleration and yaw rate are mapped to positions without a
motion model, so forecasts need not be kinematically feasible. Headings and speeds are derived from
the positions. The loss is L_FFW (equation 10 of Janjoš et al. 2021).

Dimensions: n targets, m modes, t ticks ahead, z features.
"""

from dataclasses import dataclass
from typing import final

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from predictors.models.batch import Batch
from predictors.models.encoders import make_encoder
from predictors.models.heads import ConnectedHead
from predictors.models.network import AbstractNetwork, Modes, NetworkConfig, NetworkShape

POSITION_SCALE_M = 10.0
"""Scale of the outputs. Chosen by hand: positions lie some ten metres ahead."""

MIN_STEP_M = 0.1
"""A shorter step between two ticks has no heading of its own; it takes that of the step before.
Chosen by hand."""


@dataclass(frozen=True, slots=True, kw_only=True)
class MTPConfig(NetworkConfig):
    """Options of MTP."""

    hidden: int = 4096
    """Width of the layer between the encoder and the output."""

    def __post_init__(self) -> None:
        """Checks the sizes.

        Raises:
            AspEnvError: A size is not positive.
        """
        self.check_positive("features", "modes", "hidden")


@final
class MTPNetwork(AbstractNetwork):
    """Encoder and fully connected head.

    The head reads [z, speed, acceleration, yaw rate], (n, z + 3), and returns positions
    (n, m, t, 2) and logits (n, m).
    """

    def __init__(self, config: MTPConfig, shape: NetworkShape) -> None:
        """Initialises the weights at random."""
        super().__init__(config, shape)
        self.encoder = make_encoder(config.encoder, shape, config.features)
        self.norm = nn.LayerNorm(config.features)
        self.head = ConnectedHead(
            config.features + 3, config.hidden, modes=config.modes, ticks=shape.horizon
        )

    def forward(self, batch: Batch) -> Modes:
        """Returns states (n, m, t, 4) and logits (n, m)."""
        z = self.norm(self.encoder(batch.observation).float())
        with torch.autocast(z.device.type, enabled=False):
            outputs, logits = self.head(torch.cat([z, self.scaled_motion(batch)], dim=-1))
            positions = outputs * POSITION_SCALE_M
            states = states_along(positions, batch.motion[:, 0] < 0, self.shape.dt_s)
            standing = self.standing_logit(z, batch)
        return Modes(states, logits, features=z, standing=standing)


def states_along(
    positions: Float[Tensor, "n m t 2"], backwards_now: Bool[Tensor, " n"], dt_s: float
) -> Float[Tensor, "n m t 4"]:
    """Derives states from positions of a target that is now at (0, 0) with heading 0.

    The heading is that of the last step of at least 0.1 m, and the speed is the length of the last
    step over the time step. Steps to the rear of a target that drives backwards now are driven
    backwards: their heading is opposite to the step, and their speed is negative. Gradients pass
    through the positions only.

    Args:
        positions: Positions at each tick, metres.
        backwards_now: Whether the present speed is negative.
        dt_s: Time step.
    """
    with torch.no_grad():
        start = torch.zeros_like(positions[..., :1, :])
        steps = torch.diff(torch.cat([start, positions], dim=-2), dim=-2)
        length = torch.linalg.vector_norm(steps, dim=-1)
        ticks = torch.arange(1, length.shape[-1] + 1, device=length.device)
        # The last tick with a heading of its own; 0 stands for the heading now.
        last = torch.where(length >= MIN_STEP_M, ticks, 0).cummax(dim=-1).values
        backwards = backwards_now[:, None, None] & (steps[..., 0] < 0)
        sign = 1.0 - 2.0 * backwards.to(steps.dtype)
        headings = torch.atan2(sign * steps[..., 1], sign * steps[..., 0])
        headings = torch.cat([torch.zeros_like(headings[..., :1]), headings], dim=-1)
        motion = torch.stack([headings.gather(-1, last), sign * length / dt_s], dim=-1)
    return torch.cat([positions, motion], dim=-1)
