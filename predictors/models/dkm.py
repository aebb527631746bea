"""DKM: the deep kinematic model (Cui et al. 2019), as Janjoš et al. (2021) compare with it.

A state-to-action mapping: the observation and the present speed, acceleration and yaw rate are
mapped to actions, and the bicycle model (equation 4 of Janjoš et al. 2021) turns actions into
states. The loss is L_FFW (equation 10).

Neither paper specifies the layers behind the encoder. Here the features pass a LayerNorm, and one
hidden layer and a linear layer follow.

Dimensions: n targets, m modes, t ticks ahead, z features.
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
    Modes,
    NetworkConfig,
    NetworkShape,
    rollout_from_now,
)


@dataclass(frozen=True, slots=True, kw_only=True)
class DKMConfig(NetworkConfig):
    """Options of DKM; the defaults are those of Janjoš et al. (2021)."""

    hidden: int = 4096
    """Width of the layer between the encoder and the output."""
    integrator: Integrator = "euler"

    def __post_init__(self) -> None:
        """Checks the sizes.

        Raises:
            AspEnvError: A size is not positive.
        """
        self.check_positive("features", "modes", "hidden")


@final
class DKMNetwork(AbstractNetwork):
    """Encoder, fully connected head and the bicycle model.

    The head reads [z, speed, acceleration, yaw rate], (n, z + 3), and returns actions (n, m, t, 2)
    and logits (n, m).
    """

    def __init__(self, config: DKMConfig, shape: NetworkShape) -> None:
        """Initialises the weights at random."""
        super().__init__(config, shape)
        self._integrator: Integrator = config.integrator
        self.encoder = make_encoder(config.encoder, shape, config.features)
        self.norm = nn.LayerNorm(config.features)
        self.head = ConnectedHead(
            config.features + 3, config.hidden, modes=config.modes, ticks=shape.horizon
        )

    def forward(self, batch: Batch) -> Modes:
        """Returns states (n, m, t, 4), logits (n, m) and actions (n, m, t, 2)."""
        z = self.norm(self.encoder(batch.observation).float())
        with torch.autocast(z.device.type, enabled=False):
            outputs, logits = self.head(torch.cat([z, self.scaled_motion(batch)], dim=-1))
            actions = self.bounded_actions(outputs)
            states = rollout_from_now(actions, batch, self.shape.dt_s, self._integrator)
            standing = self.standing_logit(z, batch)
        return Modes(states, logits, actions, features=z, standing=standing)
