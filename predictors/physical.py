"""Forecasters without weights: the first rows of every table, and the oracle."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from asp_env.data.classes import PREDICTED
from asp_env.data.predictor import Forecast, constant_velocity, make_forecast
from asp_env.data.scene import Scene
from asp_env.data.snippets import Future
from asp_env.data.split import TrainedOn
from asp_env.dynamics import clip_actions, inverse, rollout
from asp_env.errors import AspEnvError
from asp_env.geometry import wrap_angle

TURN_OVER_S = 0.6
"""The present yaw rate is the mean over this time: one step of 0.2 s is mostly noise."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ConstantVelocity:
    """Each target goes straight on at its present speed: zero actions."""

    horizon: int
    dt_s: float
    name: str = "constant-velocity"
    privileged: bool = False
    trained_on: TrainedOn | None = None
    history: int = 0

    @property
    def metadata(self) -> Mapping[str, str]:
        """Nothing: it is not trained."""
        return {}

    @classmethod
    def from_name(cls, argument: str, *, horizon: int, dt_s: float) -> "ConstantVelocity":
        """The predictor for any horizon and time step; it takes no argument.

        Raises:
            AspEnvError: there is an argument.
        """
        _refuse_argument("constant-velocity", argument)
        return cls(horizon=horizon, dt_s=dt_s)

    def predict(self, scene: Scene, future: Future | None = None) -> Forecast:
        """Forecasts the targets in one mode; reads no future.

        Raises:
            AspEnvError: the scene has another time step.
        """
        del future
        scene.check_dt(self.dt_s, self.name)
        states = constant_velocity(scene, steps=self.horizon)
        actions = np.zeros((*states.shape[:-1], 2), dtype=states.dtype)
        return _one_mode(scene, states, actions, seen_for(scene, self.history))


@dataclass(frozen=True, slots=True, kw_only=True)
class ConstantTurnRate:
    """Each target keeps its present speed and the yaw rate it had over the last 0.6 s.

    The yaw rate is turned into the steering that causes it at the present speed, which is then
    held; steering stays within ±π/4, and is 0 below 0.5 m/s.
    """

    horizon: int
    dt_s: float
    name: str = "constant-turn-rate"
    privileged: bool = False
    trained_on: TrainedOn | None = None

    @property
    def history(self) -> int:
        """The ticks that 0.6 s span, at least one."""
        return max(1, round(TURN_OVER_S / self.dt_s))

    @property
    def metadata(self) -> Mapping[str, str]:
        """Nothing: it is not trained."""
        return {}

    @classmethod
    def from_name(cls, argument: str, *, horizon: int, dt_s: float) -> "ConstantTurnRate":
        """The predictor for any horizon and time step; it takes no argument.

        Raises:
            AspEnvError: there is an argument.
        """
        _refuse_argument("constant-turn-rate", argument)
        return cls(horizon=horizon, dt_s=dt_s)

    def predict(self, scene: Scene, future: Future | None = None) -> Forecast:
        """Forecasts the targets in one mode; reads no future.

        Raises:
            AspEnvError: the scene has another time step, or a history shorter than 0.6 s.
        """
        del future
        scene.check_dt(self.dt_s, self.name)
        valid = seen_for(scene, self.history)
        at = (scene.targets[:, 0], scene.targets[:, 1])
        headings = scene.states[at][:, -self.history - 1 :, 2]
        headings = np.where(valid[:, None], headings, 0)
        turned = wrap_angle(np.diff(headings, axis=-1)).mean(axis=-1)
        now = np.where(valid[:, None], scene.target_states, 0).astype(np.float32)
        lengths = np.where(valid, scene.sizes[at][:, 0], 1).astype(np.float32)
        after = now.copy()
        after[:, 2] += turned
        action = clip_actions(inverse(now, after, lengths, self.dt_s))
        actions = np.repeat(action[:, None], self.horizon, axis=1)
        states = rollout(now, actions, lengths, self.dt_s, reverse=True)
        return _one_mode(scene, states, actions, valid)


@dataclass(frozen=True, slots=True, kw_only=True)
class Oracle:
    """The recorded future as a single mode: what a perfect forecast would be worth.

    It forecasts agents of any class. Where the recording has a gap the states in between are
    interpolated, and behind its end the last speed and heading are kept. The actions are those
    inferred from the states, which may exceed the limits of actions.
    """

    horizon: int
    dt_s: float
    name: str = "oracle"
    privileged: bool = True
    trained_on: TrainedOn | None = None
    history: int = 0

    @property
    def metadata(self) -> Mapping[str, str]:
        """Nothing: it is not trained."""
        return {}

    @classmethod
    def from_name(cls, argument: str, *, horizon: int, dt_s: float) -> "Oracle":
        """The predictor for any horizon and time step; it takes no argument.

        Raises:
            AspEnvError: there is an argument.
        """
        _refuse_argument("oracle", argument)
        return cls(horizon=horizon, dt_s=dt_s)

    def predict(self, scene: Scene, future: Future | None = None) -> Forecast:
        """Repeats the future of targets that are there now and at one tick to come at least.

        Raises:
            AspEnvError: the scene has another time step, or there is no future of this horizon.
        """
        scene.check_dt(self.dt_s, self.name)
        if future is None or future.states.shape[1] < self.horizon:
            given = "none" if future is None else f"one of {future.states.shape[1]} ticks"
            raise AspEnvError(
                f"oracle needs the recorded future of {self.horizon} ticks and was given {given}: "
                "it works on recordings only"
            )
        at = (scene.targets[:, 0], scene.targets[:, 1])
        known = future.valid[:, : self.horizon]
        valid = scene.valid[at][:, -1] & known.any(axis=-1)
        now = np.where(valid[:, None], scene.target_states, 0)
        states = _filled(now, future.states[:, : self.horizon], known, self.dt_s)
        lengths = np.where(valid, scene.sizes[at][:, 0], 1).astype(np.float32)[:, None]
        before = np.concatenate([now[:, None], states[:, :-1]], axis=1)
        actions = inverse(before, states, lengths, self.dt_s)
        return _one_mode(scene, states, actions, valid)


def seen_for(scene: Scene, history: int) -> Bool[np.ndarray, " t"]:
    """Which targets are of a predicted class and were seen now and at the last `history` ticks.

    Raises:
        AspEnvError: the scene itself has a shorter history.
    """
    if scene.history < history:
        raise AspEnvError(
            f"the predictor needs {history} past ticks, the scene has {scene.history}: "
            "make the scene with a longer history"
        )
    at = (scene.targets[:, 0], scene.targets[:, 1])
    known = np.isin(scene.classes[at], [int(kind) for kind in PREDICTED])
    return known & scene.valid[at][:, scene.history - history :].all(axis=-1)


def _refuse_argument(name: str, argument: str) -> None:
    if argument:
        raise AspEnvError(f"predictor {name} takes no argument, {argument!r} was given: use {name}")


def _filled(
    now: Float[np.ndarray, "t 4"],
    future: Float[np.ndarray, "t steps 4"],
    known: Bool[np.ndarray, "t steps"],
    dt_s: float,
) -> Float[np.ndarray, "t steps 4"]:
    """The future where it is known, bit for bit; between along a line, behind straight on."""
    steps = future.shape[1]
    ticks = np.arange(steps + 1)
    there = np.concatenate([np.ones((len(known), 1), dtype=bool), known], axis=1)
    states = np.concatenate([now[:, None], future], axis=1).astype(np.float64)
    states = np.where(there[..., None], states, 0)
    last = np.maximum.accumulate(np.where(there, ticks, 0), axis=1)
    following = np.where(there, ticks, steps + 1)[:, ::-1]
    following = np.minimum.accumulate(following, axis=1)[:, ::-1]
    inside = (following <= steps)[..., None]
    rows = np.arange(len(states))[:, None]
    before, after = states[rows, last], states[rows, np.minimum(following, steps)]

    span = after - before
    span[..., 2] = wrap_angle(span[..., 2])
    share = (ticks - last) / np.maximum(following - last, 1)
    between = before + share[..., None] * span
    way_m = before[..., 3] * (ticks - last) * dt_s
    behind = before.copy()
    behind[..., 0] += way_m * np.cos(before[..., 2])
    behind[..., 1] += way_m * np.sin(before[..., 2])
    filled = np.where(inside, between, behind)
    filled[..., 2] = wrap_angle(filled[..., 2])
    return np.where(known[..., None], future, filled[:, 1:]).astype(np.float32)


def _one_mode(
    scene: Scene,
    states: Float[np.ndarray, "t steps 4"],
    actions: Float[np.ndarray, "t steps 2"],
    valid: Bool[np.ndarray, " t"],
) -> Forecast:
    certain = np.zeros((len(states), 1), dtype=np.float32)
    return make_forecast(
        scene, states=states[:, None], actions=actions[:, None], log_probs=certain, valid=valid
    )
