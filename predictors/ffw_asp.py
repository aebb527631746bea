"""FFW-ASP: feed-forward prediction in action space (Janjoš, Dolgov, Zöllner 2021).

An encoder turns the target's raster into features z. A recurrent decoder reads [z, a] at every step
of the past actions a; its last state gives, for each mode, future actions and a logit. The bicycle
model turns actions into states, on which the loss is taken.

Read into the paper: z passes a LayerNorm before the decoder; actions are tanh times the symmetric
99.9th percentile of the training data's actions, within the limits of actions. Changed, as options
that the `paper` recipe leaves off: `skip` leads z, the present speed and the past actions around
the recurrent layers to the output, without which accuracy is lost; `hidden` puts a hidden layer
there.

Dimensions: n targets, m modes, t ticks ahead, z features.
"""

from dataclasses import dataclass
from typing import ClassVar, final

import torch
from jaxtyping import Float
from torch import Tensor, nn

from asp_env.data.predictor import Predictor
from asp_env.dynamics import clip_actions, rollout
from asp_env.dynamics.bicycle import Integrator
from asp_env.errors import AspEnvError
from predictors.batch import Batch, Labels
from predictors.encoders import EncoderName, make_encoder
from predictors.learned import AbstractNetwork, Modes, NetworkShape
from predictors.modes import (
    Assignment,
    Classification,
    best_mode,
    classification_loss,
    regression_loss,
)

SPEED_SCALE_MPS = 10.0


@dataclass(frozen=True, slots=True, kw_only=True)
class FFWASPConfig:
    """What decides the network and its loss; the defaults are the paper's."""

    encoder: EncoderName = "resnet18"
    features: int = 512
    """z, the width of what the encoder gives."""
    gru_width: int = 512
    gru_layers: int = 2
    skip: bool = False
    """Whether z, the present speed and the past actions also reach the output directly."""
    hidden: int = 0
    """Width of a hidden layer before the output; 0 for none, as in the paper."""
    modes: int = 3
    integrator: Integrator = "euler"
    assignment: Assignment = "angle"
    classification: Classification = "cross-entropy"

    def __post_init__(self) -> None:
        """Checks the sizes.

        Raises:
            AspEnvError: one is not positive.
        """
        for field in ("features", "gru_width", "gru_layers", "modes"):
            if getattr(self, field) < 1:
                raise AspEnvError(f"ffw-asp: {field} is {getattr(self, field)}, expected 1 or more")
        if self.hidden < 0:
            raise AspEnvError(f"ffw-asp: hidden is {self.hidden}, expected 0 or more")


@final
class FFWASPNetwork(AbstractNetwork):
    """Encoder, decoder and the bicycle model."""

    def __init__(self, config: FFWASPConfig, shape: NetworkShape) -> None:
        """With random weights."""
        super().__init__()
        self.config = config
        self.shape = shape
        self.register_buffer("action_range", torch.tensor(shape.action_range), persistent=False)
        self.encoder = make_encoder(config.encoder, shape.raster, config.features)
        self.norm = nn.LayerNorm(config.features)
        self.gru = nn.GRU(
            config.features + 2, config.gru_width, config.gru_layers, batch_first=True
        )
        width = config.gru_width
        if config.skip:
            width += config.features + 1 + 2 * shape.history
        layers: list[nn.Module] = []
        if config.hidden:
            layers = [nn.Linear(width, config.hidden), nn.ReLU(inplace=True)]
            width = config.hidden
        self.head = nn.Sequential(*layers, nn.Linear(width, config.modes * (2 * shape.horizon + 1)))

    def forward(self, batch: Batch) -> Modes:
        """The modes of every target."""
        device = batch.raster.device.type
        dtype = torch.bfloat16 if torch.is_autocast_enabled(device) else torch.float32
        # Bytes are moved to channels-last before they grow into floats: there is less to move.
        pixels = batch.raster.contiguous(memory_format=torch.channels_last).to(dtype)
        z = self.norm(self.encoder(pixels * (1 / 255)).float())
        with torch.autocast(device, enabled=False):
            return self._decode(z, batch)

    def _decode(self, z: Float[Tensor, "n z"], batch: Batch) -> Modes:
        scale = self.get_buffer("action_range")
        past = (batch.actions / scale).clamp(-1.5, 1.5)
        steps = torch.cat([z[:, None].expand(-1, past.shape[1], -1), past], dim=-1)
        out, _ = self.gru(steps)
        features = [out[:, -1]]
        if self.config.skip:
            speed = batch.speed_mps[:, None] / SPEED_SCALE_MPS
            features += [z, speed, past.flatten(1)]
        out = self.head(torch.cat(features, dim=-1))
        m, t = self.config.modes, self.shape.horizon
        logits, raw = out[:, :m], out[:, m:].unflatten(1, (m, t, 2))
        actions = clip_actions(raw.tanh() * scale)
        return Modes(actions, self._drive(actions, batch), logits)

    def _drive(self, actions: Float[Tensor, "n m t 2"], batch: Batch) -> Float[Tensor, "n m t 4"]:
        start = batch.speed_mps[:, None] * batch.speed_mps.new_tensor([0.0, 0.0, 0.0, 1.0])
        return rollout(
            start[:, None].expand(-1, actions.shape[1], -1),
            actions,
            batch.length_m[:, None].expand(-1, actions.shape[1]),
            self.shape.dt_s,
            integrator=self.config.integrator,
        )

    def loss(self, modes: Modes, labels: Labels) -> dict[str, Tensor]:
        """The terms of the loss by name, `loss` their sum."""
        positions, label = modes.states[..., :2], labels.states[..., :2]
        best = best_mode(positions.detach(), label, self.config.assignment)
        regression = regression_loss(positions, label, best)
        classification = classification_loss(modes.logits, best, self.config.classification)
        return {
            "loss": regression + classification,
            "regression": regression,
            "classification": classification,
        }


@final
class FFWASP:
    """What the registry holds under `ffw-asp`."""

    name: ClassVar[str] = "ffw-asp"
    config: ClassVar[type[FFWASPConfig]] = FFWASPConfig
    network: ClassVar[type[FFWASPNetwork]] = FFWASPNetwork

    @classmethod
    def from_name(cls, argument: str, *, horizon: int, dt_s: float) -> Predictor:
        """The predictor of a finished run's folder; it keeps the horizon it was trained for.

        Raises:
            CheckpointError: the folder holds no finished run of this predictor.
            AspEnvError: it was trained for another time step.
        """
        del horizon
        from predictors.checkpoint import load_learned

        return load_learned(cls, argument, dt_s=dt_s)
