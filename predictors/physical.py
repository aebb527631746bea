"""Predictors without weights: constant velocity, constant turn rate, and the oracle."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from asp_env.data.classes import is_predicted
from asp_env.data.predictor import Forecast, constant_velocity, make_forecast
from asp_env.data.scene import Scene
from asp_env.data.snippets import Future
from asp_env.data.split import TrainedOn
from asp_env.dynamics import clip_actions, inverse, rollout
from asp_env.errors import AspEnvError
from asp_env.geometry import wrap_angle

TURN_OVER_S = 0.6
"""Time over which the present yaw rate is averaged. Chosen by hand: a single step of 0.2 s is
mostly measurement noise."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ConstantVelocity:
    """Continues straight at the present speed: zero actions."""

    horizon: int
    dt_s: float
    name: str = "constant-velocity"
    privileged: bool = False
    trained_on: TrainedOn | None = None
    history: int = 0
    reads_past: bool = False

    @property
    def metadata(self) -> Mapping[str, str]:
        """Empty: nothing is trained."""
        return {}

    @classmethod
    def from_name(cls, argument: str, *, horizon: int, dt_s: float) -> "ConstantVelocity":
        """Makes the predictor for any horizon (ticks) and time step.

        Raises:
            AspEnvError: The argument is not empty.
        """
        refuse_argument("constant-velocity", argument)
        return cls(horizon=horizon, dt_s=dt_s)

    def predict(self, scene: Scene, future: Future | None = None) -> Forecast:
        """Forecasts the targets in one mode; the future is ignored.

        Raises:
            AspEnvError: The scene has another time step.
        """
        del future
        scene.check_dt(self.dt_s, self.name)
        states = constant_velocity(scene, steps=self.horizon)
        actions = np.zeros((*states.shape[:-1], 2), dtype=states.dtype)
        return one_mode(scene, states, actions, predictable_targets(scene, self.history))


@dataclass(frozen=True, slots=True, kw_only=True)
class ConstantTurnRate:
    """Continues at the present speed and the mean yaw rate of the last 0.6 s.

    The yaw rate is converted to the steering that causes it at the present speed, which then stays
    constant, within ±π/4; it is 0 below 0.5 m/s.
    """

    horizon: int
    dt_s: float
    name: str = "constant-turn-rate"
    privileged: bool = False
    trained_on: TrainedOn | None = None

    @property
    def history(self) -> int:
        """Ticks within 0.6 s, at least one."""
        return max(1, round(TURN_OVER_S / self.dt_s))

    @property
    def metadata(self) -> Mapping[str, str]:
        """Empty: nothing is trained."""
        return {}

    @classmethod
    def from_name(cls, argument: str, *, horizon: int, dt_s: float) -> "ConstantTurnRate":
        """Makes the predictor for any horizon (ticks) and time step.

        Raises:
            AspEnvError: The argument is not empty.
        """
        refuse_argument("constant-turn-rate", argument)
        return cls(horizon=horizon, dt_s=dt_s)

    def predict(self, scene: Scene, future: Future | None = None) -> Forecast:
        """Forecasts the targets in one mode; the future is ignored.

        Raises:
            AspEnvError: The scene has another time step, or a history shorter than 0.6 s.
        """
        del future
        scene.check_dt(self.dt_s, self.name)
        valid = predictable_targets(scene, self.history)
        index = (scene.targets[:, 0], scene.targets[:, 1])
        headings = scene.states[index][:, -self.history - 1 :, 2]
        headings = np.where(valid[:, None], headings, 0)
        turn_per_tick = wrap_angle(np.diff(headings, axis=-1)).mean(axis=-1)
        now = np.where(valid[:, None], scene.target_states, 0).astype(np.float32)
        lengths = np.where(valid, scene.sizes[index][:, 0], 1).astype(np.float32)
        after = now.copy()
        after[:, 2] += turn_per_tick
        action = clip_actions(inverse(now, after, lengths, self.dt_s))
        actions = np.repeat(action[:, None], self.horizon, axis=1)
        states = rollout(now, actions, lengths, self.dt_s, reverse=True)
        return one_mode(scene, states, actions, valid)


@dataclass(frozen=True, slots=True, kw_only=True)
class Oracle:
    """The recorded future as a single mode: a perfect forecast, for comparison.

    It forecasts agents of any class. States in gaps of the recording are interpolated; after its
    end the target continues at its last speed and heading. The actions are inferred from the states
    and may exceed the limits of actions.
    """

    horizon: int
    dt_s: float
    name: str = "oracle"
    privileged: bool = True
    trained_on: TrainedOn | None = None
    history: int = 0
    reads_past: bool = False

    @property
    def metadata(self) -> Mapping[str, str]:
        """Empty: nothing is trained."""
        return {}

    @classmethod
    def from_name(cls, argument: str, *, horizon: int, dt_s: float) -> "Oracle":
        """Makes the predictor for any horizon (ticks) and time step.

        Raises:
            AspEnvError: The argument is not empty.
        """
        refuse_argument("oracle", argument)
        return cls(horizon=horizon, dt_s=dt_s)

    def predict(self, scene: Scene, future: Future | None = None) -> Forecast:
        """Returns the future of targets that are present now and recorded at a future tick.

        Raises:
            AspEnvError: The scene has another time step, or the future is missing or too short.
        """
        scene.check_dt(self.dt_s, self.name)
        if future is None or future.states.shape[1] < self.horizon:
            given = "none" if future is None else f"one of {future.states.shape[1]} ticks"
            raise AspEnvError(
                f"{self.name} needs the recorded future of {self.horizon} ticks and was given "
                f"{given}: it works on recordings only"
            )
        index = (scene.targets[:, 0], scene.targets[:, 1])
        known = future.valid[:, : self.horizon]
        valid = scene.valid[index][:, -1] & known.any(axis=-1)
        now = np.where(valid[:, None], scene.target_states, 0)
        states = _fill_gaps(now, future.states[:, : self.horizon], known, self.dt_s)
        return with_inferred_actions(scene, states, valid)


def predictable_targets(scene: Scene, history: int) -> Bool[np.ndarray, " t"]:
    """Mask of targets of a predicted class that are valid now and at the last `history` ticks.

    Raises:
        AspEnvError: The scene has a shorter history.
    """
    if scene.history < history:
        raise AspEnvError(
            f"the predictor needs {history} past ticks, the scene has {scene.history}: "
            "make the scene with a longer history"
        )
    index = (scene.targets[:, 0], scene.targets[:, 1])
    predicted = is_predicted(scene.classes[index])
    return predicted & scene.valid[index][:, scene.history - history :].all(axis=-1)


def refuse_argument(name: str, argument: str) -> None:
    """Raises an `AspEnvError` if a predictor without an argument was given one."""
    if argument:
        raise AspEnvError(f"predictor {name} takes no argument, {argument!r} was given: use {name}")


def _fill_gaps(
    now: Float[np.ndarray, "t 4"],
    future: Float[np.ndarray, "t steps 4"],
    known: Bool[np.ndarray, "t steps"],
    dt_s: float,
) -> Float[np.ndarray, "t steps 4"]:
    """Future states without gaps: interpolated between known ticks, constant velocity after them.

    Args:
        now: States now.
        future: Recorded states; any values where they are not known.
        known: Mask of the recorded ticks.
        dt_s: Time step.

    Returns:
        The recorded states unchanged where they are known.
    """
    steps = future.shape[1]
    ticks = np.arange(steps + 1)
    present = np.concatenate([np.ones((len(known), 1), dtype=bool), known], axis=1)
    states = np.concatenate([now[:, None], future], axis=1).astype(np.float64)
    states = np.where(present[..., None], states, 0)
    last = np.maximum.accumulate(np.where(present, ticks, 0), axis=1)
    following = np.where(present, ticks, steps + 1)[:, ::-1]
    following = np.minimum.accumulate(following, axis=1)[:, ::-1]
    in_gap = (following <= steps)[..., None]
    rows = np.arange(len(states))[:, None]
    before, after = states[rows, last], states[rows, np.minimum(following, steps)]

    span = after - before
    span[..., 2] = wrap_angle(span[..., 2])
    share = (ticks - last) / np.maximum(following - last, 1)
    interpolated = before + share[..., None] * span
    distance_m = before[..., 3] * (ticks - last) * dt_s
    continued = before.copy()
    continued[..., 0] += distance_m * np.cos(before[..., 2])
    continued[..., 1] += distance_m * np.sin(before[..., 2])
    filled = np.where(in_gap, interpolated, continued)
    filled[..., 2] = wrap_angle(filled[..., 2])
    return np.where(known[..., None], future, filled[:, 1:]).astype(np.float32)


def with_inferred_actions(
    scene: Scene, states: Float[np.ndarray, "t steps 4"], valid: Bool[np.ndarray, " t"]
) -> Forecast:
    """A forecast of one mode whose actions are inferred from its states.

    The actions may exceed the limits of actions.

    Args:
        scene: the scene.
        states: [x m, y m, heading rad, speed m/s] in the recording's frame.
        valid: which targets are forecast.
    """
    index = (scene.targets[:, 0], scene.targets[:, 1])
    now = np.where(valid[:, None], scene.target_states, 0)
    lengths = np.where(valid, scene.sizes[index][:, 0], 1).astype(np.float32)[:, None]
    before = np.concatenate([now[:, None], states[:, :-1]], axis=1)
    return one_mode(scene, states, inverse(before, states, lengths, scene.dt_s), valid)


def one_mode(
    scene: Scene,
    states: Float[np.ndarray, "t steps 4"],
    actions: Float[np.ndarray, "t steps 2"] | None,
    valid: Bool[np.ndarray, " t"],
) -> Forecast:
    """A forecast of one mode with probability 1.

    Args:
        scene: the scene.
        states: [x m, y m, heading rad, speed m/s] in the recording's frame.
        actions: [acceleration m/s², steering rad], or None for a forecast without actions.
        valid: which targets are forecast.
    """
    certain = np.zeros((len(states), 1), dtype=np.float32)
    modes = None if actions is None else actions[:, None]
    return make_forecast(
        scene, states=states[:, None], actions=modes, log_probs=certain, valid=valid
    )
