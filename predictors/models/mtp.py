"""MTP: multiple trajectory prediction (Cui et al. 2019), the state-to-position baseline.

From the raster and the present speed, acceleration and yaw rate to positions, without a motion
model: nothing keeps a forecast drivable. Headings and speeds are read off the positions.
"""

from dataclasses import dataclass
from typing import final

import torch
from jaxtyping import Float
from torch import Tensor, nn

from predictors.models.batch import Batch
from predictors.models.encoders import make_encoder
from predictors.models.heads import ConnectedHead
from predictors.models.network import (
    AbstractNetwork,
    LearnedPlug,
    Modes,
    NetworkConfig,
    NetworkShape,
)

POSITION_SCALE_M = 10.0
"""What the outputs are multiplied by: positions lie some ten metres away."""

MIN_STEP_M = 0.1
"""A shorter step between two ticks tells no heading; the one before goes on."""


@dataclass(frozen=True, slots=True, kw_only=True)
class MTPConfig(NetworkConfig):
    """What decides the network and its loss."""

    hidden: int = 4096
    """Width of the layer between the encoder and the output."""

    def __post_init__(self) -> None:
        """Checks the sizes.

        Raises:
            AspEnvError: one is not positive.
        """
        self.check_positive("features", "modes", "hidden")


@final
class MTPNetwork(AbstractNetwork):
    """Encoder and fully connected head."""

    def __init__(self, config: MTPConfig, shape: NetworkShape) -> None:
        """With random weights."""
        super().__init__(config, shape)
        self.encoder = make_encoder(config.encoder, shape, config.features)
        self.norm = nn.LayerNorm(config.features)
        self.head = ConnectedHead(
            config.features + 3, config.hidden, modes=config.modes, ticks=shape.horizon
        )

    def forward(self, batch: Batch) -> Modes:
        """The modes of every target."""
        z = self.norm(self.encoder(batch.seen).float())
        with torch.autocast(z.device.type, enabled=False):
            raw, logits = self.head(torch.cat([z, self.scaled_motion(batch)], dim=-1))
            states = states_along(raw * POSITION_SCALE_M, self.shape.dt_s)
        return Modes(states, logits)


def states_along(positions: Float[Tensor, "n m t 2"], dt_s: float) -> Float[Tensor, "n m t 4"]:
    """States of someone now at (0, 0) with heading 0 who passes these positions tick by tick.

    The heading is that of the step to a position, where it is at least 0.1 m long, and the speed is
    the step's length over the time step. Neither is differentiated.
    """
    with torch.no_grad():
        start = torch.zeros_like(positions[..., :1, :])
        steps = torch.diff(torch.cat([start, positions], dim=-2), dim=-2)
        length = torch.linalg.vector_norm(steps, dim=-1)
        ticks = torch.arange(1, length.shape[-1] + 1, device=length.device)
        # The last tick that told a heading, 0 for none: the heading now.
        last = torch.where(length >= MIN_STEP_M, ticks, 0).cummax(dim=-1).values
        headings = torch.atan2(steps[..., 1], steps[..., 0])
        headings = torch.cat([torch.zeros_like(headings[..., :1]), headings], dim=-1)
        motion = torch.stack([headings.gather(-1, last), length / dt_s], dim=-1)
    return torch.cat([positions, motion], dim=-1)


MTP = LearnedPlug(name="mtp", config=MTPConfig, network=MTPNetwork)
"""What the registry holds under `mtp`."""
