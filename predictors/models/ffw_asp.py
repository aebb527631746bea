"""FFW-ASP: feed-forward prediction in action space (Janjoš, Dolgov, Zöllner 2021).

An encoder turns the target's surroundings into features z. A recurrent decoder reads [z, a] at
every step of the past actions a; its last state gives, for each mode, future actions and a logit.
The bicycle model turns actions into states, on which the loss is taken.

Read into the paper: z passes a LayerNorm before the decoder; actions are tanh times the symmetric
99.9th percentile of the training data's actions, within the limits of actions. Changed, as options
that the `paper` recipe leaves off: `skip` leads z, the present speed and the past actions around
the recurrent layers to the output, without which accuracy is lost; `hidden` puts a hidden layer
there; `head="connected"` puts the fully connected head of DKM in the recurrent one's place (the
paper's ablation).

Dimensions: n targets, m modes, t ticks ahead, z features.
"""

from dataclasses import dataclass
from typing import Literal, final

import torch
from torch import nn

from asp_env.dynamics.bicycle import Integrator
from asp_env.errors import AspEnvError
from predictors.models.batch import Batch
from predictors.models.encoders import make_encoder
from predictors.models.heads import ConnectedHead, RecurrentReader
from predictors.models.network import (
    AbstractNetwork,
    LearnedPlug,
    Modes,
    NetworkConfig,
    NetworkShape,
    drive,
)


@dataclass(frozen=True, slots=True, kw_only=True)
class FFWASPConfig(NetworkConfig):
    """What decides the network and its loss; the defaults are the paper's."""

    head: Literal["recurrent", "connected"] = "recurrent"
    """What reads features and past actions: a GRU in turn, or a layer all at once."""
    gru_width: int = 512
    gru_layers: int = 2
    skip: bool = False
    """Whether z, the present speed and the past actions also reach the output directly."""
    hidden: int = 0
    """Width of a hidden layer before the output; 0 for none, as in the paper's recurrent head."""
    integrator: Integrator = "euler"

    def __post_init__(self) -> None:
        """Checks the sizes.

        Raises:
            AspEnvError: one is not positive.
        """
        self.check_positive("features", "modes", "gru_width", "gru_layers")
        if self.hidden < 0:
            raise AspEnvError(f"network: hidden is {self.hidden}, expected 0 or more")


@final
class FFWASPNetwork(AbstractNetwork):
    """Encoder, decoder and the bicycle model."""

    def __init__(self, config: FFWASPConfig, shape: NetworkShape) -> None:
        """With random weights."""
        super().__init__(config, shape)
        self._integrator: Integrator = config.integrator
        self._skip = config.skip
        self.encoder = make_encoder(config.encoder, shape, config.features)
        self.norm = nn.LayerNorm(config.features)
        self.reader: RecurrentReader | None = None
        width = 0
        if config.head == "recurrent":
            self.reader = RecurrentReader(config.features, config.gru_width, config.gru_layers)
            width = config.gru_width
        if config.skip or self.reader is None:
            width += config.features + 2 * shape.history
        width += config.skip
        self.head = ConnectedHead(width, config.hidden, modes=config.modes, ticks=shape.horizon)

    def forward(self, batch: Batch) -> Modes:
        """The modes of every target."""
        z = self.norm(self.encoder(batch.seen).float())
        with torch.autocast(z.device.type, enabled=False):
            past = self.scaled_actions(batch.actions)
            inputs = [] if self.reader is None else [self.reader(z, past)]
            if self._skip or self.reader is None:
                inputs += [z, past.flatten(1)]
            if self._skip:
                inputs.append(self.scaled_motion(batch)[:, :1])
            raw, logits = self.head(torch.cat(inputs, dim=-1))
            actions = self.actions_from(raw)
            states = drive(actions, batch, self.shape.dt_s, self._integrator)
        return Modes(states, logits, actions)


FFWASP = LearnedPlug(name="ffw-asp", config=FFWASPConfig, network=FFWASPNetwork)
"""What the registry holds under `ffw-asp`."""
