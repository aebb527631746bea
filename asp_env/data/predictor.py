"""Predictors and their forecasts."""

import dataclasses
import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from operator import attrgetter
from typing import Any, Protocol, no_type_check, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float, Int

from asp_env import registry
from asp_env.arguments import positive_number, text, whole_number
from asp_env.compiled import njit
from asp_env.data.scene import Scene
from asp_env.data.snippets import Future
from asp_env.data.split import TrainedOn
from asp_env.geometry import wrap_angle

MAX_HORIZON = 2**20
"""Longest horizon in ticks. Chosen by hand: beyond all recordings."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Forecast:
    """M modes of T ticks for each of N targets; step 0 is one tick after the scene."""

    states: Float[np.ndarray, "t m steps 4"]
    """[x m, y m, heading rad, speed m/s] in the recording's frame."""
    actions: Float[np.ndarray, "t m steps 2"]
    """[acceleration m/s², steering rad] that lead to the states."""
    actions_valid: Bool[np.ndarray, " t"]
    """False for targets without actions."""
    log_probs: Float[np.ndarray, "t m"]
    """Natural logarithms of the modes' probabilities, which sum to one."""
    ids: Int[np.ndarray, " t"]
    """Track ids of the targets."""
    targets: Int[np.ndarray, "t 2"]
    """(situation, slot) in the scene."""
    tick: Int[np.ndarray, " t"]
    """The scene's tick."""
    valid: Bool[np.ndarray, " t"]
    """False for targets that the predictor does not forecast; their rows are zeros."""
    dt_s: float
    """Seconds per tick."""
    fallback: Float[np.ndarray, " t"] | None = None
    """Share of constant velocity in each target's forecast, within [0, 1], NaN for a target that
    the predictor does not forecast; None from a predictor that has no guard against scenes outside
    of what it learned."""
    features: Float[np.ndarray, "t features"] | None = None
    """What a trained network encodes of each target, for other networks; None without a network."""

    @property
    def probabilities(self) -> Float[np.ndarray, "t m"]:
        """The modes' probabilities."""
        return np.exp(self.log_probs)

    @property
    def most_probable(self) -> Int[np.ndarray, " t"]:
        """Index of each target's most probable mode, the first of several."""
        return self.log_probs.argmax(axis=-1)


@runtime_checkable
class Predictor(Protocol):
    """Forecasts the targets of a scene."""

    @property
    def name(self) -> str:
        """The name in tables and messages."""
        ...

    @property
    def privileged(self) -> bool:
        """Whether `predict` uses the recorded future; tables mark such predictors as oracles."""
        ...

    @property
    def dt_s(self) -> float:
        """Seconds per tick of the scenes and forecasts."""
        ...

    @property
    def history(self) -> int:
        """Number of past ticks at which a target must be present."""
        ...

    @property
    def horizon(self) -> int:
        """Number of ticks of a forecast."""
        ...

    @property
    def trained_on(self) -> TrainedOn | None:
        """The training data; None for predictors without training."""
        ...

    @property
    def metadata(self) -> Mapping[str, str]:
        """Entries for tables and manifests: `trained_on`, `view`, `preset` (recipe), `weights`."""
        ...

    def predict(self, scene: Scene, future: Future | None = None) -> Forecast:
        """Forecasts the scene's targets.

        Args:
            scene: the scene.
            future: the recorded future of the targets, only for privileged predictors.
        """
        ...


@runtime_checkable
class InteractivePredictor(Predictor, Protocol):
    """A privileged predictor that is given a simulated future where there is a simulation.

    `asp-env drive` gives it the future that the simulation has if the ego carries out its last plan
    (`asp_env.sim.simulated_future`). At logged states the ego carries out the log, so that this
    future is the recorded one. It cannot be used where the plan of the ego is not known, as in
    environments and drivers.
    """

    @property
    def needs_simulation(self) -> bool:
        """Whether the future is to be simulated; if not, it is the recorded one."""
        ...


@runtime_checkable
class FeaturePredictor(Predictor, Protocol):
    """A predictor whose forecasts have `features`."""

    @property
    def feature_size(self) -> int:
        """Number of features of each target; 0 if the forecasts have none."""
        ...


@runtime_checkable
class PresentPredictor(Predictor, Protocol):
    """A predictor that states whether its forecasts depend on past ticks.

    One that does not is given scenes without past ticks where these are made for it alone, as in
    environments, which saves most of the time that a scene takes.
    """

    @property
    def reads_past(self) -> bool:
        """Whether forecasts depend on more than the last tick of a scene and the future."""
        ...


def reads_past(predictor: Predictor) -> bool:
    """Whether a predictor's forecasts depend on past ticks; true if it does not state it."""
    return not isinstance(predictor, PresentPredictor) or predictor.reads_past


def feature_size(predictor: Predictor) -> int:
    """Number of features of each target in a predictor's forecasts; 0 if they have none."""
    # `isinstance` would compute it twice, at each level of predictors that wrap others.
    return getattr(predictor, "feature_size", 0)


def needs_simulation(predictor: Predictor) -> bool:
    """Whether a predictor is to be given a simulated future."""
    return getattr(predictor, "needs_simulation", False)


@runtime_checkable
class PredictorPlug(Protocol):
    """The object that an entry point of the group `asp_env.predictors` names."""

    def from_name(self, argument: str, *, horizon: int, dt_s: float) -> Predictor:
        """Makes the predictor.

        Args:
            argument: the text behind the colon of the predictor's name, or an empty text.
            horizon: number of ticks to forecast; a trained predictor has a horizon of its own.
            dt_s: seconds per tick.

        Raises:
            AspEnvError: the argument is missing, superfluous, or cannot be loaded.
        """
        ...


@runtime_checkable
class GuardablePlug(PredictorPlug, Protocol):
    """A plug whose predictors have a form with a guard, `guarded:NAME:RUN`.

    A guard replaces forecasts by constant velocity where a scene lies outside of what the predictor
    learned, and states the share in `Forecast.fallback`.
    """

    def load_guarded(self, argument: str, *, horizon: int, dt_s: float) -> Predictor:
        """Makes the predictor with its guard.

        Args:
            argument: as for `from_name`.
            horizon: as for `from_name`.
            dt_s: as for `from_name`.

        Raises:
            AspEnvError: the argument cannot be loaded, or the predictor has no guard.
        """
        ...


def load_predictor(name: str, *, horizon: int, dt_s: float) -> Predictor:
    """Loads a predictor by its name, such as `constant-velocity` or `ffw-asp:runs/1`.

    Args:
        name: the registered name and, behind a colon, the run folder of a trained predictor.
        horizon: number of ticks to forecast; a trained predictor has a horizon of its own.
        dt_s: seconds per tick.

    Raises:
        AspEnvError: the name is unknown, or the predictor cannot be made for these values.
    """
    text("predictor", name)
    whole_number("horizon", horizon, least=1, most=MAX_HORIZON)
    positive_number("time step", dt_s, "s")
    kind, _, argument = name.partition(":")

    def made_by(plug: PredictorPlug) -> Any:
        predictor = plug.from_name(argument, horizon=horizon, dt_s=dt_s)
        _accept_about(predictor)
        return predictor

    return registry.make("predictors", kind, made_by, Predictor)


def make_forecast(
    scene: Scene,
    *,
    states: Float[np.ndarray, "t m steps 4"],
    actions: Float[np.ndarray, "t m steps 2"] | None,
    log_probs: Float[np.ndarray, "t m"],
    valid: Bool[np.ndarray, " t"],
    features: Float[np.ndarray, "t features"] | None = None,
) -> Forecast:
    """A forecast of the scene's targets, with zeros where not valid.

    Args:
        scene: the scene.
        states: [x m, y m, heading rad, speed m/s] in the recording's frame.
        actions: [acceleration m/s², steering rad], or None for a predictor without actions.
        log_probs: natural logarithms of the modes' probabilities.
        valid: which targets the predictor forecasts.
        features: what a network encodes of each target, or None.
    """
    at = (scene.targets[:, 0], scene.targets[:, 1])
    has_actions = actions is not None
    if actions is None:
        actions = np.zeros((*states.shape[:-1], 2), dtype=np.float32)
    return Forecast(
        states=_zero_unless(valid, states),
        actions=_zero_unless(valid, actions),
        actions_valid=valid & has_actions,
        log_probs=log_probs.astype(np.float32),
        ids=scene.ids[at],
        targets=scene.targets,
        tick=scene.tick[scene.targets[:, 0]],
        valid=valid,
        dt_s=scene.dt_s,
        features=None
        if features is None
        else np.where(valid[:, None], features, 0).astype(np.float32),
    )


def _zero_unless(
    valid: Bool[np.ndarray, " t"], values: Float[np.ndarray, "t ..."]
) -> Float[np.ndarray, "t ..."]:
    """The values as new 32-bit numbers, with zeros in the rows that are not valid."""
    values = values.astype(np.float32)
    values[~valid] = 0.0
    return values


def constant_velocity(scene: Scene, *, steps: int) -> Float[np.ndarray, "t steps 4"]:
    """States of the targets that continue straight at their present speed.

    Args:
        scene: the scene.
        steps: number of ticks.
    """
    now = scene.target_states
    step_m = now[:, 3:] * np.stack([np.cos(now[:, 2]), np.sin(now[:, 2])], axis=-1)
    # Heun's method with zero actions: twice the velocity times half the duration.
    step_m = (step_m + step_m) * (0.5 * scene.dt_s)
    states = np.empty((len(now), steps, 4), dtype=now.dtype)
    _repeat_steps(now, step_m, wrap_angle(now[:, 2]), states)
    return states


@njit(cache=True, nogil=True)
@no_type_check
def _repeat_steps(now, step_m, heading_rad, states):
    """Writes the states (T, steps, 4) from `now` (T, 4) on, by a step (T, 2) in every tick."""
    for t in range(len(now)):
        x = y = np.float32(0.0)
        for step in range(states.shape[1]):
            x += step_m[t, 0]
            y += step_m[t, 1]
            states[t, step, 0] = now[t, 0] + x
            states[t, step, 1] = now[t, 1] + y
            states[t, step, 2] = heading_rad[t]
            states[t, step, 3] = now[t, 3]


def continued(
    states: Float[np.ndarray, "t m steps 4"], steps: int, dt_s: float
) -> Float[np.ndarray, "t m all 4"]:
    """States that go on straight at their last speed up to some number of steps.

    Args:
        states: [x m, y m, heading rad, speed m/s] of each mode.
        steps: number of steps of the result, at least; longer modes are returned unchanged.
        dt_s: seconds per step.
    """
    missing = steps - states.shape[2]
    if missing <= 0:
        return states
    added = np.repeat(states[:, :, -1:], missing, axis=2)
    distance_m = added[..., 3] * dt_s * np.arange(1, missing + 1, dtype=np.float32)
    added[..., 0] += distance_m * np.cos(added[..., 2])
    added[..., 1] += distance_m * np.sin(added[..., 2])
    return np.concatenate([states, added], axis=2)


def fill_missing(forecast: Forecast, scene: Scene) -> Forecast:
    """Adds constant velocity, in equally probable modes, for present targets without a forecast.

    Planners and drivers need a forecast of every agent that is present.
    """
    at = (scene.targets[:, 0], scene.targets[:, 1])
    missing = ~forecast.valid & scene.valid[at][:, -1]
    if not missing.any():
        return forecast
    alone = scene.with_targets(scene.targets[missing])
    states = forecast.states.astype(np.float32)
    states[missing] = constant_velocity(alone, steps=states.shape[2])[:, None]
    log_prob = np.float32(-np.log(forecast.log_probs.shape[1]))
    return dataclasses.replace(
        forecast,
        states=states,
        log_probs=np.where(missing[:, None], log_prob, forecast.log_probs),
        valid=forecast.valid | missing,
    )


def _accept_about(predictor: object) -> None:
    """Defines `metadata` for predictors that still have it under its former name, `about`."""
    kind: Any = type(predictor)
    inherited = getattr(kind, "metadata", None) is vars(Predictor)["metadata"]  # not defined
    if (not inherited and hasattr(predictor, "metadata")) or not hasattr(predictor, "about"):
        return
    warnings.warn(
        f"{kind.__name__}.about is deprecated and will be ignored from the next release on: rename "
        "it to `metadata`",
        DeprecationWarning,
        stacklevel=3,
    )
    kind.metadata = property(attrgetter("about"))
