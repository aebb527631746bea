"""FFW-ASP: feed-forward prediction in action space (Janjoš, Dolgov, Zöllner 2021).

An action-to-action mapping (equations 6 to 8). The encoder φ maps the observation of the target's
surroundings to features z. The decoder γ, a GRU, reads [z, a] at every tick of the past actions a;
its last state gives future actions and a logit for each mode. The bicycle model f (equation 4)
turns actions into states, on which the loss L_FFW (equation 10) is taken.

The paper leaves open how the GRU makes the actions: with `decoder="read"`, the default, one linear
layer maps its last state to the actions of all ticks; with `decoder="unrolled"` it goes on over the
ticks ahead, and the state after each of them gives the actions of that tick
(`predictors.models.heads`). It leaves open as well: here z passes a LayerNorm before γ, and outputs
are scaled by tanh times the 99.9th percentile of the absolute actions in the training data, within
the limits of actions.

Options that differ from the paper; the recipe `paper` leaves them off: `skip` leads z, the present
speed and the past actions around the GRU to the output (the GRU alone loses accuracy); `hidden`
inserts a hidden layer before the output; `head="connected"` replaces the GRU by the fully connected
head of DKM, which is the ablation of the paper.

Dimensions: n targets, m modes, h past ticks, t ticks ahead, z features.
"""

from dataclasses import dataclass
from typing import Literal, final

import torch
from torch import nn

from asp_env.dynamics.bicycle import Integrator
from asp_env.errors import AspEnvError
from predictors.models.batch import Batch
from predictors.models.encoders import make_encoder
from predictors.models.heads import ConnectedHead, Decoder, RecurrentReader, UnrolledDecoder
from predictors.models.network import (
    AbstractNetwork,
    Modes,
    NetworkConfig,
    NetworkShape,
    rollout_from_now,
)


@dataclass(frozen=True, slots=True, kw_only=True)
class FFWASPConfig(NetworkConfig):
    """Options of FFW-ASP; the defaults are the paper's."""

    head: Literal["recurrent", "connected"] = "recurrent"
    """Whether a GRU or a fully connected layer reads the features and the past actions."""
    decoder: Decoder = "read"
    """How the GRU makes actions, see `heads.Decoder`; only `read` for the connected head."""
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
            AspEnvError: A size is not positive, or a connected head is to be unrolled.
        """
        self.check_positive("features", "modes", "gru_width", "gru_layers")
        if self.head == "connected" and self.decoder != "read":
            raise AspEnvError(
                f"network: decoder is {self.decoder!r} with the connected head, which has no GRU: "
                "take the recurrent head"
            )
        if self.hidden < 0:
            raise AspEnvError(f"network: hidden is {self.hidden}, expected 0 or more")


@final
class FFWASPNetwork(AbstractNetwork):
    """φ, γ and the bicycle model.

    φ maps the observation to z (n, z). γ reads z and the past actions (n, h, 2), and its head
    returns actions (n, m, t, 2) and logits (n, m).
    """

    def __init__(self, config: FFWASPConfig, shape: NetworkShape) -> None:
        """Initialises the weights at random."""
        super().__init__(config, shape)
        self._integrator: Integrator = config.integrator
        self._skip = config.skip
        self.encoder = make_encoder(config.encoder, shape, config.features)
        self.norm = nn.LayerNorm(config.features)
        self.reader: RecurrentReader | None = None
        self.head: ConnectedHead | None = None
        self.decoder: UnrolledDecoder | None = None
        skipped = config.features + 2 * shape.history + 1 if config.skip else 0
        if config.decoder == "unrolled":
            self.decoder = UnrolledDecoder(
                config.features,
                config.gru_width,
                config.gru_layers,
                modes=config.modes,
                static=skipped,
                hidden=config.hidden,
            )
            return
        width = skipped
        if config.head == "recurrent":
            self.reader = RecurrentReader(config.features, config.gru_width, config.gru_layers)
            width += config.gru_width
        elif not config.skip:
            width = config.features + 2 * shape.history
        self.head = ConnectedHead(width, config.hidden, modes=config.modes, ticks=shape.horizon)

    def forward(self, batch: Batch) -> Modes:
        """Returns states (n, m, t, 4), logits (n, m) and actions (n, m, t, 2)."""
        z = self.norm(self.encoder(batch.observation).float())
        with torch.autocast(z.device.type, enabled=False):
            past = self.scaled_actions(batch.actions)
            static = [z, past.flatten(1)] if self._skip or self.reader is None else []
            if self._skip:
                static.append(self.scaled_motion(batch)[:, :1])
            if self.decoder is not None:
                skipped = torch.cat(static, dim=-1) if self._skip else None
                outputs, logits = self.decoder(z, past, self.shape.horizon, skipped)
            else:
                assert self.head is not None
                read = [] if self.reader is None else [self.reader(z, past)]
                outputs, logits = self.head(torch.cat([*read, *static], dim=-1))
            actions = self.bounded_actions(outputs)
            states = rollout_from_now(actions, batch, self.shape.dt_s, self._integrator)
            standing = self.standing_logit(z, batch)
        return Modes(states, logits, actions, features=z, standing=standing)
