"""Controls: predictors of known quality, which calibrate a comparison of other predictors.

A score says little without a scale. `blind` is its lower end, `constant-velocity` and `oracle` are
two of its marks, `blend:SHARE` are the marks between them, and `noisy-oracle:METRES` and
`shuffled-oracle` lie below the oracle by a known defect. `interactive-oracle` takes the place of
`oracle` where traffic reacts to the ego. All forecast agents of any class. Those that are made from
the recorded future, or a simulated one, are privileged.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int, UInt64

from asp_env.data.classes import is_predicted
from asp_env.data.predictor import Forecast, constant_velocity
from asp_env.data.scene import Scene
from asp_env.data.snippets import Future
from asp_env.data.split import TrainedOn
from asp_env.errors import AspEnvError
from asp_env.geometry import between_states, from_frame, states_to_frame, wrap_angle
from predictors.counter_random import mixed, nearly_normal
from predictors.physical import Oracle, one_mode, refuse_argument, with_inferred_actions

FAR_M = 1000.0
"""Distance at which `blind` places every target. Chosen by hand: beyond all that an ego reaches
within a horizon, and near enough for positions to be exact to 0.1 mm as 32-bit numbers."""

REACH_PER_METRE = 3.0
"""`noisy-oracle` reduces its error for targets that move less than this many times METRES. Chosen
by hand: larger values leave slow targets nearly exact, smaller ones let them turn on the spot."""

CLIPPED_AT = 3.0
"""The noise of `noisy-oracle` is clipped at this many standard deviations. With `REACH_PER_METRE`,
no target moves backwards. Chosen by hand: one value in 1000 is clipped."""

DRAWN_EVERY_S = 2.4
"""Time between independent draws of `noisy-oracle`. Chosen by hand: the errors along of constant
velocity after 3 s correlate by 0.9, 0.5 and 0.1 with those of forecasts 0.6 s, 1.8 s and 3.0 s
later (`sample:intersection`); those of `noisy-oracle` correlate by 0.9, 0.5 and 0.1."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Blind:
    """Forecasts every present agent as standing 1 km ahead, so that the road is free for a planner.

    It has no actions.
    """

    horizon: int
    dt_s: float
    name: str = "blind"
    privileged: bool = False
    trained_on: TrainedOn | None = None
    history: int = 0
    reads_past: bool = False

    @property
    def metadata(self) -> Mapping[str, str]:
        """Empty: nothing is trained."""
        return {}

    @classmethod
    def from_name(cls, argument: str, *, horizon: int, dt_s: float) -> "Blind":
        """Makes the predictor for any horizon (ticks) and time step.

        Raises:
            AspEnvError: The argument is not empty.
        """
        refuse_argument("blind", argument)
        return cls(horizon=horizon, dt_s=dt_s)

    def predict(self, scene: Scene, future: Future | None = None) -> Forecast:
        """Forecasts the targets in one mode; the future is ignored.

        Raises:
            AspEnvError: The scene has another time step.
        """
        del future
        scene.check_dt(self.dt_s, self.name)
        valid = scene.valid[scene.targets[:, 0], scene.targets[:, 1], -1]
        away = np.where(valid[:, None], scene.target_states, 0)
        away[:, 0] += FAR_M * np.cos(away[:, 2])
        away[:, 1] += FAR_M * np.sin(away[:, 2])
        away[:, 3] = 0
        return one_mode(scene, np.repeat(away[:, None], self.horizon, axis=1), None, valid)


@dataclass(frozen=True, slots=True, kw_only=True)
class _RecordedFuture:
    """Shared by the controls that are made from the oracle's forecast."""

    horizon: int
    dt_s: float
    name: str
    privileged: bool = True
    trained_on: TrainedOn | None = None
    history: int = 0
    reads_past: bool = False

    @property
    def metadata(self) -> Mapping[str, str]:
        """Empty: nothing is trained."""
        return {}

    def _oracle(self, scene: Scene, future: Future | None) -> Forecast:
        oracle = Oracle(horizon=self.horizon, dt_s=self.dt_s, name=self.name)
        return oracle.predict(scene, future)


@dataclass(frozen=True, slots=True, kw_only=True)
class Blend(_RecordedFuture):
    """States a share of the way from constant velocity's to the oracle's: `blend:SHARE`.

    Positions and speeds are interpolated linearly, headings through the smaller angle. It forecasts
    the targets that the oracle forecasts. Actions are inferred from the states.
    """

    share: float
    """0 for constant velocity to 1 for the oracle."""

    @classmethod
    def from_name(cls, argument: str, *, horizon: int, dt_s: float) -> "Blend":
        """Makes the predictor for any horizon (ticks) and time step.

        Args:
            argument: the share, 0 to 1.
            horizon: number of ticks to forecast.
            dt_s: seconds per tick.

        Raises:
            AspEnvError: The argument is not a number from 0 to 1.
        """
        share = _number(argument)
        if not 0 <= share <= 1:
            raise AspEnvError(
                f"predictor {_given('blend', argument)}: expected blend:SHARE with a number from 0 "
                "(constant velocity) to 1 (oracle), such as blend:0.25"
            )
        return cls(horizon=horizon, dt_s=dt_s, name=f"blend:{argument}", share=share)

    def predict(self, scene: Scene, future: Future | None = None) -> Forecast:
        """Forecasts the targets in one mode.

        Raises:
            AspEnvError: The scene has another time step, or the future is missing or too short.
        """
        oracle = self._oracle(scene, future)
        straight = constant_velocity(scene, steps=self.horizon).astype(np.float64)
        straight = np.where(oracle.valid[:, None, None], straight, 0)
        states = between_states(straight, oracle.states[:, 0].astype(np.float64), self.share)
        return with_inferred_actions(scene, _wrapped(states), oracle.valid)


@dataclass(frozen=True, slots=True, kw_only=True)
class NoisyOracle(_RecordedFuture):
    """The oracle's forecast with an error of known size: `noisy-oracle:METRES`.

    The oracle's path is stretched and turned about the target's present position, so that speeds
    and headings fit the positions, and agents that stand remain standing. Each position, as a
    complex number relative to the present one, is multiplied by 1 + s (z₁ + i z₂) / √2. Its error
    is therefore proportional to its distance from the present position, and grows linearly in time
    at constant velocity. z₁ (along) and z₂ (across) have mean 0 and variance 1, and s is METRES
    divided by the distance D of the farthest position, which usually is the last. There, the root
    of the mean squared displacement, over both axes together, is METRES. The axes have equal shares
    because the squared error along is 30 to 80 % of the total in forecasts of constant velocity and
    of trained predictors, depending on the site.

    For targets that move less than three times METRES, the root of the mean squared displacement is
    METRES · (D / 3 METRES)² instead, so that parked agents do not move.

    z is a function of the track id, the tick and, if there is one, the episode's seed,
    `Scene.seeds` (`persistent_noise`). It changes slowly, since the errors of predictors persist
    over consecutive forecasts.
    """

    metres: float
    """Root mean square of the displacement at the farthest position, m."""

    @classmethod
    def from_name(cls, argument: str, *, horizon: int, dt_s: float) -> "NoisyOracle":
        """Makes the predictor for any horizon (ticks) and time step.

        Args:
            argument: the root mean square of the displacement in metres, at least 0.
            horizon: number of ticks to forecast.
            dt_s: seconds per tick.

        Raises:
            AspEnvError: The argument is not a number of at least 0.
        """
        metres = _number(argument)
        if not 0 <= metres < math.inf:
            raise AspEnvError(
                f"predictor {_given('noisy-oracle', argument)}: expected noisy-oracle:METRES with "
                "a number of at least 0, such as noisy-oracle:2"
            )
        return cls(horizon=horizon, dt_s=dt_s, name=f"noisy-oracle:{argument}", metres=metres)

    def predict(self, scene: Scene, future: Future | None = None) -> Forecast:
        """Forecasts the targets in one mode.

        Raises:
            AspEnvError: The scene has another time step, or the future is missing or too short.
        """
        oracle = self._oracle(scene, future)
        states = oracle.states[:, 0].astype(np.float64)
        now = np.where(oracle.valid[:, None], scene.target_states, 0).astype(np.float64)[:, None]
        ahead = (states[..., 0] - now[..., 0]) + 1j * (states[..., 1] - now[..., 1])
        reach_m = np.abs(ahead).max(axis=1)
        size = np.minimum(
            self.metres / np.maximum(reach_m, 1e-9),
            reach_m / max(REACH_PER_METRE**2 * self.metres, 1e-9),
        )
        seeds = None if scene.seeds is None else scene.seeds[scene.targets[:, 0]]
        z = persistent_noise(oracle.ids, oracle.tick, self.dt_s, seeds)
        factor = (1 + size / math.sqrt(2) * (z[:, 0] + 1j * z[:, 1]))[:, None]
        moved = ahead * factor
        states[..., 0], states[..., 1] = now[..., 0] + moved.real, now[..., 1] + moved.imag
        states[..., 2] += np.angle(factor)
        states[..., 3] *= np.abs(factor)
        return with_inferred_actions(scene, _wrapped(states), oracle.valid)


@dataclass(frozen=True, slots=True, kw_only=True)
class ShuffledOracle(_RecordedFuture):
    """Each target gets the recorded motion of another target of the same situation.

    The motion, relative to the other target's present position and heading, starts from the
    target's own ones. The other target is the next in the order of track ids, and for the last the
    first; motorised vehicles and bicycles are one circle, all other agents another. A target alone
    in its circle gets constant velocity. Forecasts together are distributed like the oracle's, but
    say nothing about the individual agent.

    The forecast of a target depends on which other targets are forecast with it. No other predictor
    does this.
    """

    name: str = "shuffled-oracle"

    @classmethod
    def from_name(cls, argument: str, *, horizon: int, dt_s: float) -> "ShuffledOracle":
        """Makes the predictor for any horizon (ticks) and time step.

        Raises:
            AspEnvError: The argument is not empty.
        """
        refuse_argument("shuffled-oracle", argument)
        return cls(horizon=horizon, dt_s=dt_s)

    def predict(self, scene: Scene, future: Future | None = None) -> Forecast:
        """Forecasts the targets in one mode.

        Raises:
            AspEnvError: The scene has another time step, or the future is missing or too short.
        """
        oracle = self._oracle(scene, future)
        classes = scene.classes[scene.targets[:, 0], scene.targets[:, 1]]
        predicted = is_predicted(classes)
        other = _next_in_circle(oracle.ids, (scene.targets[:, 0], predicted), oracle.valid)
        now = np.where(oracle.valid[:, None], scene.target_states, 0).astype(np.float64)[:, None]
        motion = states_to_frame(oracle.states[other, 0].astype(np.float64), now[other])
        states = motion.copy()
        states[..., :2] = from_frame(motion[..., :2], now)
        states[..., 2] += now[..., 2]
        alone = (other == np.arange(len(other)))[:, None, None]
        states = np.where(alone, constant_velocity(scene, steps=self.horizon), states)
        states = np.where(oracle.valid[:, None, None], states, 0)
        return with_inferred_actions(scene, _wrapped(states), oracle.valid)


@dataclass(frozen=True, slots=True, kw_only=True)
class InteractiveOracle(_RecordedFuture):
    """The future that the simulation has if the ego carries out its last plan.

    The last plan is shifted by one tick, and its last action is repeated; before the first plan,
    the ego continues at constant speed. Where traffic reacts, this is a perfect forecast for that
    plan, while `oracle` returns a recorded run that does not happen. It is a forecast for no other
    plan: the reactions to the candidates that the planner compares are not known.

    Where traffic does not react, and at logged states, it equals `oracle`.
    """

    name: str = "interactive-oracle"
    needs_simulation: bool = True

    @classmethod
    def from_name(cls, argument: str, *, horizon: int, dt_s: float) -> "InteractiveOracle":
        """Makes the predictor for any horizon (ticks) and time step.

        Raises:
            AspEnvError: The argument is not empty.
        """
        refuse_argument("interactive-oracle", argument)
        return cls(horizon=horizon, dt_s=dt_s)

    def predict(self, scene: Scene, future: Future | None = None) -> Forecast:
        """Returns the future of the targets, like `oracle`, in one mode.

        Args:
            scene: the scene.
            future: the simulated future; at logged states, the recorded one.

        Raises:
            AspEnvError: The scene has another time step, or the future is missing or too short.
        """
        return self._oracle(scene, future)


def persistent_noise(
    ids: Int[np.ndarray, " t"],
    tick: Int[np.ndarray, " t"],
    dt_s: float,
    seeds: UInt64[np.ndarray, " t"] | None = None,
) -> Float[np.ndarray, "t 2"]:
    """Noise of mean 0 and variance 1 that changes slowly with the tick.

    It is the interpolation of independent draws every `DRAWN_EVERY_S`, divided by its standard
    deviation and clipped at ±3. The draws are a function of the id, the seed and their number, so
    that values depend on neither the order nor the number of agents or ticks.

    Args:
        ids: track ids.
        tick: the tick of each.
        dt_s: seconds per tick.
        seeds: random number of each, such as that of its episode; None for the same noise in every
            episode.

    Returns:
        Two independent values for each id.
    """
    every = max(1, round(DRAWN_EVERY_S / dt_s))
    streams = mixed(ids.astype(np.int64).view(np.uint64))
    if seeds is not None:
        streams = mixed(streams ^ seeds)
    shifted = tick + (streams % np.uint64(every)).astype(np.int64)
    number = shifted // every
    share = ((shifted - number * every) / every)[:, None]
    drawn = (1 - share) * _draws(streams, number) + share * _draws(streams, number + 1)
    noise = drawn / np.sqrt((1 - share) ** 2 + share**2)
    return np.clip(noise, -CLIPPED_AT, CLIPPED_AT)


def _draws(
    streams: UInt64[np.ndarray, " t"], number: Int[np.ndarray, " t"]
) -> Float[np.ndarray, "t 2"]:
    """Two nearly normal draws of each stream."""
    return nearly_normal(streams[:, None], 2 * number[:, None] + np.array([1, 2]))


def _next_in_circle(
    ids: Int[np.ndarray, " t"], keys: tuple[np.ndarray, np.ndarray], valid: Bool[np.ndarray, " t"]
) -> Int[np.ndarray, " t"]:
    """For each valid row, that with the next id among those with equal keys; else the row itself.

    After the largest id follows the smallest.
    """
    rows = np.flatnonzero(valid)
    order = rows[np.lexsort((ids[rows], keys[1][rows], keys[0][rows]))]
    is_first = np.ones(len(order), dtype=bool)
    is_first[1:] = (keys[0][order][1:] != keys[0][order][:-1]) | (
        keys[1][order][1:] != keys[1][order][:-1]
    )
    first = np.flatnonzero(is_first)
    following = np.arange(1, len(order) + 1)
    following[np.append(first[1:], len(order))[: len(first)] - 1] = first
    other = np.arange(len(ids))
    other[order] = order[following]
    return other


def _wrapped(states: Float[np.ndarray, "t steps 4"]) -> Float[np.ndarray, "t steps 4"]:
    """The states as 32-bit numbers, with headings in [-π, π)."""
    rounded = states.astype(np.float32)  # first, since ±π rounds to the other side
    rounded[..., 2] = wrap_angle(rounded[..., 2])
    return rounded


def _number(argument: str) -> float:
    """The number, or NaN if the text is none."""
    try:
        return float(argument)
    except ValueError:
        return math.nan


def _given(name: str, argument: str) -> str:
    return f"{name}:{argument}" if argument else name
