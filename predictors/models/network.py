"""What every trainable network is: made of a configuration and a shape, giving modes and a loss."""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor, nn

from asp_env.data.predictor import Predictor
from asp_env.dynamics import clip_actions, rollout
from asp_env.dynamics.bicycle import Integrator
from asp_env.errors import AspEnvError
from asp_env.views.vectors import VectorShape
from predictors.models.batch import Batch, Labels
from predictors.models.losses import Assignment, Classification, mode_terms

MOTION_SCALE = (10.0, 3.0, 0.5)
"""What speed (m/s), acceleration (m/s²) and yaw rate (rad/s) are divided by before a network."""


class Modes(NamedTuple):
    """What a network says of N targets, in their own frames."""

    states: Float[Tensor, "n m t 4"]
    logits: Float[Tensor, "n m"]
    actions: Float[Tensor, "n m t 2"] | None = None
    """None from a network that predicts positions."""


class TrainingProgress(NamedTuple):
    """Where in its training a network is."""

    share: float = 1.0
    """Of all steps: 0 at the first, 1 at the end."""
    pretraining: bool = False
    """Whether the epochs come first in which only the features are learned."""


class Features(NamedTuple):
    """Features of the scene to come, as encoded from it and as predicted, for diagnosis."""

    encoded: Float[Tensor, "n z"]
    predicted: Float[Tensor, "n z"]


@dataclass(frozen=True, slots=True, kw_only=True)
class NetworkShape:
    """What a network is made for, besides its own configuration."""

    seen: tuple[int, int, int] | VectorShape
    """Channels, height, width of pictures, or the shape of vectors."""
    packed: bool
    """Whether pictures come packed to bits."""
    history: int
    """Past ticks."""
    horizon: int
    """Ticks ahead."""
    dt_s: float
    action_range: tuple[float, float]
    """What outputs in [-1, 1] are multiplied by: m/s², rad. The normaliser."""


@dataclass(frozen=True, slots=True, kw_only=True)
class NetworkConfig:
    """What the configurations of all networks hold; the defaults are the paper's."""

    encoder: str = "resnet18"
    """`resnet18` or `small` for pictures, `vector` for vectors."""
    features: int = 512
    """z, the width of what the encoder gives."""
    modes: int = 3
    assignment: Assignment = "angle-random"
    classification: Classification = "cross-entropy"
    annealed: bool = False
    """Whether all modes learn from every label at first, by nearness (softmin), and the best one
    alone at the end."""

    def __post_init__(self) -> None:
        """Checks the sizes.

        Raises:
            AspEnvError: one is not positive.
        """
        self.check_positive("features", "modes")

    def check_positive(self, *fields: str) -> None:
        """Refuses sizes below one.

        Raises:
            AspEnvError: one is not positive.
        """
        for field in fields:
            if getattr(self, field) < 1:
                raise AspEnvError(f"network: {field} is {getattr(self, field)}, expected 1 or more")


class AbstractNetwork(nn.Module, ABC):
    """A network that can be trained and put behind the socket; made of (config, shape)."""

    def __init__(self, config: NetworkConfig, shape: NetworkShape) -> None:
        """Keeps both."""
        super().__init__()
        self.config = config
        self.shape = shape
        self.register_buffer("action_range", torch.tensor(shape.action_range), persistent=False)
        self.register_buffer("motion_scale", torch.tensor(MOTION_SCALE), persistent=False)

    @property
    def later_ticks(self) -> tuple[int, ...]:
        """How many ticks after now the later scenes lie that it learns from; mostly none."""
        return ()

    @abstractmethod
    def forward(self, batch: Batch) -> Modes:
        """The modes of every target."""

    def loss(self, modes: Modes, labels: Labels, moment: TrainingProgress) -> dict[str, Tensor]:
        """The terms of the loss by name, `loss` their weighted sum."""
        terms = mode_terms(
            modes.states[..., :2],
            modes.logits,
            labels.states[..., :2],
            assignment=self.config.assignment,
            classification=self.config.classification,
            share=moment.share if self.config.annealed else None,
        )
        return {"loss": terms["regression"] + terms["classification"], **terms}

    def training_loss(
        self, batch: Batch, labels: Labels, moment: TrainingProgress
    ) -> dict[str, Tensor]:
        """The terms of the loss that is trained on, `loss` their weighted sum."""
        return self.loss(self(batch), labels, moment)

    def features(self, batch: Batch, labels: Labels) -> Features | None:
        """Encoded and predicted features of the scene to come; None where none are predicted."""
        del batch, labels
        return None

    def after_step(self) -> None:
        """Called after every step of the optimiser."""

    def scaled_actions(self, actions: Float[Tensor, "n t 2"]) -> Float[Tensor, "n t 2"]:
        """Past actions as a network reads them: in units of the range, without outliers."""
        return (actions / self.get_buffer("action_range")).clamp(-1.5, 1.5)

    def scaled_motion(self, batch: Batch) -> Float[Tensor, "n 3"]:
        """Speed, acceleration and yaw rate as a network reads them."""
        return (batch.motion / self.get_buffer("motion_scale")).clamp(-3, 3)

    def actions_from(self, raw: Float[Tensor, "n m t 2"]) -> Float[Tensor, "n m t 2"]:
        """Outputs of any size as actions: tanh times the range, within the limits."""
        return clip_actions(raw.tanh() * self.get_buffer("action_range"))


def start_states(batch: Batch) -> Float[Tensor, "n 4"]:
    """The targets now, seen from themselves: at (0, 0) with heading 0 and their speed."""
    return batch.motion[:, :1] * batch.motion.new_tensor([0.0, 0.0, 0.0, 1.0])


def drive(
    actions: Float[Tensor, "n m t 2"], batch: Batch, dt_s: float, integrator: Integrator
) -> Float[Tensor, "n m t 4"]:
    """The states that actions lead to from (0, 0) at the present speed."""
    start = start_states(batch)[:, None].expand(-1, actions.shape[1], -1)
    return drive_from(start, actions, batch.length_m, dt_s, integrator)


def drive_from(
    start: Float[Tensor, "n m 4"],
    actions: Float[Tensor, "n m t 2"],
    length_m: Float[Tensor, " n"],
    dt_s: float,
    integrator: Integrator,
) -> Float[Tensor, "n m t 4"]:
    """The states that actions lead to from each mode's own start."""
    lengths = length_m[:, None].expand(-1, actions.shape[1])
    return rollout(start, actions, lengths, dt_s, integrator=integrator)


@dataclass(frozen=True, slots=True, kw_only=True)
class LearnedPlug:
    """What the registry holds under a learned predictor's name, for training and loading."""

    name: str
    """By which it is registered."""
    config: type[NetworkConfig]
    """A frozen dataclass of what JSON can hold."""
    network: type[AbstractNetwork]
    """Made of (config, shape); its module tells what the predictor is."""

    def from_name(self, argument: str, *, horizon: int, dt_s: float) -> Predictor:
        """The predictor of a finished run's folder; it keeps the horizon it was trained for.

        Behind an @ stands how segments are chained, for a run that chains any: `RUN@beam` (as
        without it), `RUN@top1`, `RUN@full`, or `RUN@oracle`, which knows the recorded future.

        Raises:
            CheckpointError: the folder holds no finished run of this predictor.
            AspEnvError: it was trained for another time step, or the chaining does not apply.
        """
        del horizon
        from predictors.inference.checkpoint import load_learned

        return load_learned(self, argument, dt_s=dt_s)
