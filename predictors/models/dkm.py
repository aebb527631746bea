"""DKM: the deep kinematic model (Cui et al. 2019), as Janjoš et al. (2021) compare with it.

From the raster and the present speed, acceleration and yaw rate to actions, and through the
bicycle model to states: a state-to-action mapping. Which layers lie behind the encoder is read
into the paper: one hidden layer, then a linear one.
"""

from dataclasses import dataclass
from typing import final

import torch
from torch import nn

from asp_env.dynamics.bicycle import Integrator
from predictors.models.batch import Batch
from predictors.models.encoders import make_encoder
from predictors.models.heads import ConnectedHead
from predictors.models.network import (
    AbstractNetwork,
    LearnedPlug,
    Modes,
    NetworkConfig,
    NetworkShape,
    drive,
)


@dataclass(frozen=True, slots=True, kw_only=True)
class DKMConfig(NetworkConfig):
    """What decides the network and its loss."""

    hidden: int = 4096
    """Width of the layer between the encoder and the output."""
    integrator: Integrator = "euler"

    def __post_init__(self) -> None:
        """Checks the sizes.

        Raises:
            AspEnvError: one is not positive.
        """
        self.check_positive("features", "modes", "hidden")


@final
class DKMNetwork(AbstractNetwork):
    """Encoder, fully connected head and the bicycle model."""

    def __init__(self, config: DKMConfig, shape: NetworkShape) -> None:
        """With random weights."""
        super().__init__(config, shape)
        self._integrator: Integrator = config.integrator
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
            actions = self.actions_from(raw)
            states = drive(actions, batch, self.shape.dt_s, self._integrator)
        return Modes(states, logits, actions)


DKM = LearnedPlug(name="dkm", config=DKMConfig, network=DKMNetwork)
"""What the registry holds under `dkm`."""
