"""The base of all networks: configuration, shape, modes, loss and the forecast in the world.

Dimensions: n targets, m modes, t ticks ahead, z features.
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn

from asp_env.data.predictor import Forecast, make_forecast
from asp_env.data.scene import Scene
from asp_env.dynamics import MAX_ACCELERATION_MPS2, clip_actions, rollout
from asp_env.dynamics.bicycle import Integrator
from asp_env.errors import AspEnvError
from asp_env.geometry import from_frame, wrap_angle
from asp_env.views.vectors import VectorShape
from predictors.models.batch import Batch, Labels
from predictors.models.chaining import Chaining
from predictors.models.losses import (
    DEFAULT_ASSIGNMENT,
    Assignment,
    Classification,
    mode_terms,
    standing_loss,
    stands,
)

STANDING_HIDDEN = 64
"""Width of the hidden layer before the logit of standing. Chosen by hand."""

SLOW_MPS = 1.0
"""Above this speed a target is not standing; the subset `moving` has the same limit."""

FAST_LOGIT = -12.0
"""Logit of standing of a target that is faster: a probability of 6e-6. Chosen by hand."""

MOTION_SCALE = (10.0, 3.0, 0.5)
"""Divisors of speed (m/s), acceleration (m/s²) and yaw rate (rad/s) at the input of a network.
Chosen by hand: typical inputs then lie within [-1, 1]."""


class Modes(NamedTuple):
    """Output of a network: M modes of T ticks for N targets, in the targets' frames now."""

    states: Float[Tensor, "n m t 4"]
    """[x m, y m, heading rad, speed m/s]."""
    logits: Float[Tensor, "n m"]
    actions: Float[Tensor, "n m t 2"] | None = None
    """[acceleration m/s², steering rad]; None from a network that predicts positions."""
    features: Float[Tensor, "n f"] | None = None
    """What the network encodes of the inputs: z, and for SSP-ASP the predicted ẑ behind it."""
    standing: Float[Tensor, " n"] | None = None
    """Logit of the probability that a target stands; None from a network without that mode."""


class TrainingProgress(NamedTuple):
    """How far the training has come, for losses that depend on it."""

    share: float = 1.0
    """Share of the steps of the prediction epochs: 0 in pre-training, 1 at the end."""
    pretraining: bool = False
    """Whether only the features are learned (the first epochs of `ssp-asp`)."""


class Features(NamedTuple):
    """Features at the end of the first segment, for diagnosis."""

    encoded: Float[Tensor, "n z"]
    """Features encoded from the inputs at that time."""
    predicted: Float[Tensor, "n z"]
    """Features predicted from the inputs at the present tick."""


class Validation(NamedTuple):
    """What the validation of a batch computes besides the modes."""

    terms: dict[str, Tensor]
    """The terms of the loss by name; `loss` is their weighted sum."""
    features: Features | None = None
    """None if the network predicts no features."""


@dataclass(frozen=True, slots=True, kw_only=True)
class NetworkShape:
    """Sizes of inputs and outputs, which follow from the view, the data and the horizon."""

    observation: tuple[int, int, int] | VectorShape
    """Channels, height and width of rasters, or the shape of vectors."""
    packed: bool
    """Whether rasters are packed to bits."""
    history: int
    """Number of past ticks."""
    horizon: int
    """Number of ticks ahead."""
    dt_s: float
    action_range: tuple[float, float]
    """Normaliser, the scale of actions (m/s², rad): outputs in [-1, 1] are multiplied by it."""


@dataclass(frozen=True, slots=True, kw_only=True)
class NetworkConfig:
    """Options of all networks; the defaults are those of Janjoš et al. (2021)."""

    encoder: str = "resnet18"
    """`resnet18` or `small` for rasters, `vector` for vectors."""
    features: int = 512
    """Number of features z that the encoder returns."""
    modes: int = 3
    """Number of modes M; SSP-ASP predicts M in each segment."""
    assignment: Assignment = DEFAULT_ASSIGNMENT
    """How the best mode of a label is chosen."""
    classification: Classification = "cross-entropy"
    """The classification term of the loss."""
    annealed: bool = False
    """Whether all modes learn from every label at first, weighted by their distance (softmin), and
    only the best one at the end."""
    standing: bool = False
    """Whether forecasts have a further mode, in which the target stands, with a probability that
    is learned and calibrated apart. The other modes then learn from no label that stands."""
    shrunk: bool = False
    """Whether forecast accelerations are multiplied by a factor, fitted after the training on the
    validation data. It is below 1 if these are of other traffic, in which vehicles accelerate and
    brake at other places than the training data show."""

    def __post_init__(self) -> None:
        """Checks the sizes.

        Raises:
            AspEnvError: A size is not positive.
        """
        self.check_positive("features", "modes")

    def check_positive(self, *fields: str) -> None:
        """Checks that fields are at least one.

        Raises:
            AspEnvError: One of the fields is not positive.
        """
        for field in fields:
            if getattr(self, field) < 1:
                raise AspEnvError(f"network: {field} is {getattr(self, field)}, expected 1 or more")


class AbstractNetwork(nn.Module, ABC):
    """A trainable network, constructed from its configuration and its shape.

    The names of modules and buffers are keys of the files of weights.
    """

    acceleration_scale: Tensor | None
    """Scalar factor on forecast accelerations, fitted after the training; None without the option
    `shrunk`."""
    merging_temperature: Tensor | None
    """Scalar divisor of the log-probabilities of chains before they are merged, fitted after the
    training; None for a network that merges none."""

    def __init__(self, config: NetworkConfig, shape: NetworkShape) -> None:
        """Stores both arguments and registers the scales of inputs and outputs."""
        super().__init__()
        self.config = config
        self.shape = shape
        self.register_buffer("action_range", torch.tensor(shape.action_range), persistent=False)
        self.register_buffer("motion_scale", torch.tensor(MOTION_SCALE), persistent=False)
        self.register_buffer("merging_temperature", None)
        self.standing_head: nn.Module | None = None
        self.register_buffer("standing_calibration", None)
        # As `merging_temperature` of SSP-ASP, a weight: it belongs to what was trained.
        self.register_buffer("acceleration_scale", torch.ones(()) if config.shrunk else None)
        if config.standing:
            inputs = config.features + len(MOTION_SCALE) + 2 * shape.history
            self.standing_head = nn.Sequential(
                nn.Linear(inputs, STANDING_HIDDEN), nn.ReLU(), nn.Linear(STANDING_HIDDEN, 1)
            )
            self.register_buffer("standing_calibration", torch.tensor([1.0, 0.0]))

    @property
    def later_ticks(self) -> tuple[int, ...]:
        """Ticks ahead at which the loss reads future inputs: the ends of the segments, if any."""
        return ()

    @property
    def feature_size(self) -> int:
        """Number of features of each target in `Modes.features`."""
        return self.config.features

    @abstractmethod
    def forward(self, batch: Batch) -> Modes:
        """Returns the modes of every target."""

    def chain(
        self, batch: Batch, chaining: Chaining, label: Float[Tensor, "n t 2"] | None = None
    ) -> Modes:
        """Returns the modes with a given chaining of segments.

        Networks that predict the whole horizon at once ignore the chaining.

        Args:
            batch: Inputs.
            chaining: How segments are chained.
            label: Recorded positions in the targets' frames; read by `oracle` only.
        """
        del chaining, label
        return self(batch)

    def all_chains(self, batch: Batch) -> Modes:
        """Returns all chains of segments, over as many segments as `MAX_CHAINS` allows.

        Networks that predict the whole horizon at once return their modes.

        Args:
            batch: Inputs.

        Returns:
            The chains, of at most the horizon, with logits.
        """
        return self(batch)

    def calibrated(
        self,
        batch: Batch,
        *,
        temperature: float = 1.0,
        chaining: Chaining = "beam",
        label: Float[Tensor, "n t 2"] | None = None,
    ) -> Modes:
        """Returns the modes with calibrated log-probabilities in place of logits.

        Args:
            batch: Inputs.
            temperature: Divisor of the logits, fitted on validation data. For the chaining `full`,
                the merging temperature takes its place if there is one.
            chaining: How segments are chained.
            label: Recorded positions in the targets' frames; read by `oracle` only.
        """
        modes = self.chain(batch, chaining, label)
        divisor: float | Tensor = temperature
        if chaining == "full" and self.merging_temperature is not None:
            divisor = self.merging_temperature
        modes = modes._replace(logits=(modes.logits / divisor).log_softmax(dim=-1))
        return self.with_standing(batch, modes)

    def standing_logit(self, z: Float[Tensor, "n z"], batch: Batch) -> Float[Tensor, " n"] | None:
        """The logit of standing, from features, motion and past actions.

        Args:
            z: Features with a bounded scale.
            batch: Inputs.

        Returns:
            Logits, not calibrated; `FAST_LOGIT` over 1 m/s; None without the option `standing`.
        """
        if self.standing_head is None:
            return None
        past = self.scaled_actions(batch.actions).flatten(1)
        inputs = torch.cat([z, self.scaled_motion(batch), past], dim=-1)
        logit = self.standing_head(inputs)[:, 0]
        slow = batch.motion[:, 0].abs() <= SLOW_MPS
        return torch.where(slow, logit, torch.full_like(logit, FAST_LOGIT))

    def with_standing(self, batch: Batch, modes: Modes) -> Modes:
        """Appends the mode in which the target stands, or stops as fast as it can.

        Args:
            batch: Inputs.
            modes: Modes with log-probabilities in place of logits.

        Returns:
            The modes, unchanged if they have no logit of standing.
        """
        if modes.standing is None:
            return modes
        slope, shift = self.get_buffer("standing_calibration")
        fast = modes.standing <= FAST_LOGIT
        logit = torch.where(fast, modes.standing, slope * modes.standing + shift)[:, None]
        stops = stopping_actions(batch, modes.states.shape[2], self.shape.dt_s)[:, None]
        integrator: Integrator = getattr(self.config, "integrator", "heun")
        states = rollout_from_now(stops, batch, self.shape.dt_s, integrator)
        log_probs = torch.cat([modes.logits + log_sigmoid(-logit), log_sigmoid(logit)], dim=1)
        actions = None if modes.actions is None else torch.cat([modes.actions, stops], dim=1)
        return modes._replace(
            states=torch.cat([modes.states, states], dim=1),
            logits=log_probs,
            actions=actions,
            standing=None,
        )

    @torch.inference_mode()
    def forecast(
        self,
        scene: Scene,
        batch: Batch,
        *,
        temperature: float = 1.0,
        chaining: Chaining = "beam",
        label: Float[Tensor, "n t 2"] | None = None,
    ) -> Forecast:
        """Forecasts the targets of a scene in the frame of its recording.

        Args:
            scene: N targets, each valid at every tick of the history.
            batch: Inputs made of the scene.
            temperature: As in `calibrated`.
            chaining: As in `calibrated`.
            label: As in `calibrated`.

        Returns:
            The forecast; all its rows are valid.
        """
        modes = self.calibrated(batch, temperature=temperature, chaining=chaining, label=label)
        now = scene.target_states.astype(np.float64)[:, None, None]
        local = modes.states.numpy()
        xy = from_frame(local[..., :2].astype(np.float64), now)
        heading = wrap_angle(local[..., 2:3] + now[..., 2:3])
        return make_forecast(
            scene,
            states=np.concatenate([xy, heading, local[..., 3:]], axis=-1).astype(np.float32),
            actions=None if modes.actions is None else modes.actions.numpy(),
            log_probs=modes.logits.numpy(),
            valid=np.ones(len(local), dtype=bool),
            features=None if modes.features is None else modes.features.numpy(),
        )

    def loss(self, modes: Modes, labels: Labels, progress: TrainingProgress) -> dict[str, Tensor]:
        """The terms of the loss of given modes by name; `loss` is their weighted sum."""
        terms = mode_terms(
            modes.states[..., :2],
            modes.logits,
            labels.states[..., :2],
            assignment=self.config.assignment,
            classification=self.config.classification,
            share=progress.share if self.config.annealed else None,
            learned=None if modes.standing is None else ~stands(labels.states),
        )
        if modes.standing is not None:
            terms["standing"] = standing_loss(modes.standing, labels.states)
        return {"loss": torch.stack(list(terms.values())).sum(), **terms}

    def training_loss(
        self, batch: Batch, labels: Labels, progress: TrainingProgress
    ) -> dict[str, Tensor]:
        """The terms of the loss in training by name; `loss` is their weighted sum."""
        return self.loss(self(batch), labels, progress)

    def validate(
        self, modes: Modes, batch: Batch, labels: Labels, progress: TrainingProgress
    ) -> Validation:
        """The loss of a forecast with the terms and weights of the training, and the features.

        Args:
            modes: The forecast, which is made without the labels.
            batch: Inputs.
            labels: Labels.
            progress: How far the training has come; its `share` is 1.
        """
        del batch
        return Validation(self.loss(modes, labels, progress))

    def after_step(self) -> None:
        """Called after every step of the optimiser."""

    def scaled_actions(self, actions: Float[Tensor, "n t 2"]) -> Float[Tensor, "n t 2"]:
        """Past actions as inputs: in units of the action range, clamped to ±1.5."""
        return (actions / self.get_buffer("action_range")).clamp(-1.5, 1.5)

    def scaled_motion(self, batch: Batch) -> Float[Tensor, "n 3"]:
        """Speed, acceleration and yaw rate as inputs: over `MOTION_SCALE`, clamped to ±3."""
        return (batch.motion / self.get_buffer("motion_scale")).clamp(-3, 3)

    def bounded_actions(self, outputs: Float[Tensor, "n m t 2"]) -> Float[Tensor, "n m t 2"]:
        """Actions of unbounded outputs: tanh times the action range, within the limits.

        Accelerations are multiplied by the fitted factor, if there is one.
        """
        actions = outputs.tanh() * self.get_buffer("action_range")
        if self.acceleration_scale is not None:
            actions = actions * torch.stack(
                [self.acceleration_scale, torch.ones_like(self.acceleration_scale)]
            )
        return clip_actions(actions)


def log_sigmoid(x: Float[Tensor, "*n"]) -> Float[Tensor, "*n"]:
    """Logarithm of the sigmoid, by an exponential and a logarithm.

    The sigmoid of onnxruntime has an absolute error of 4e-8, which its logarithm at -12 shows.
    """
    return x.clamp(max=0) - x.abs().neg().exp().log1p()


def stopping_actions(batch: Batch, ticks: int, dt_s: float) -> Float[Tensor, "n t 2"]:
    """Actions that stop the targets as fast as the limit of accelerations permits, and no more.

    Args:
        batch: Inputs.
        ticks: Number of ticks.
        dt_s: Time step.
    """
    speed = batch.motion[:, :1]
    steps = torch.arange(ticks + 1, device=speed.device)
    remaining = (speed.abs() - MAX_ACCELERATION_MPS2 * dt_s * steps).clamp(min=0) * speed.sign()
    accelerations = torch.diff(remaining, dim=1) / dt_s
    return torch.stack([accelerations, torch.zeros_like(accelerations)], dim=-1)


def start_states(batch: Batch) -> Float[Tensor, "n 4"]:
    """The targets' states now in their own frames: at (0, 0) with heading 0 and their speed."""
    return batch.motion[:, :1] * batch.motion.new_tensor([0.0, 0.0, 0.0, 1.0])


def rollout_from_now(
    actions: Float[Tensor, "n m t 2"], batch: Batch, dt_s: float, integrator: Integrator
) -> Float[Tensor, "n m t 4"]:
    """The states that actions lead to from the targets' states now.

    Args:
        actions: [acceleration m/s², steering rad] of each mode.
        batch: Inputs, which hold speeds and lengths.
        dt_s: Time step.
        integrator: `euler` (equation 4 of Janjoš et al. 2021) or `heun`.
    """
    start = start_states(batch)[:, None].expand(-1, actions.shape[1], -1)
    return rollout_from(start, actions, batch.length_m, dt_s, integrator)


def rollout_from(
    start: Float[Tensor, "n m 4"],
    actions: Float[Tensor, "n m t 2"],
    length_m: Float[Tensor, " n"],
    dt_s: float,
    integrator: Integrator,
) -> Float[Tensor, "n m t 4"]:
    """The states that actions lead to from a start state of each mode.

    Args:
        start: Start states.
        actions: [acceleration m/s², steering rad] of each mode.
        length_m: Lengths of the targets.
        dt_s: Time step.
        integrator: `euler` or `heun`.
    """
    lengths = length_m[:, None].expand(-1, actions.shape[1])
    return rollout(start, actions, lengths, dt_s, integrator=integrator)
