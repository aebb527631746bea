"""Observations as stable-baselines3 likes them.

MERGED: Forecasts of the agents nearby as parts of the observation.
"""

from collections.abc import Sequence
from typing import Any, Protocol, runtime_checkable

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.utils import RecordConstructorArgs
from gymnasium.vector import VectorEnv, VectorObservationWrapper
from gymnasium.vector.utils import batch_space
from jaxtyping import Int

from asp_env.data.predictor import Predictor, fill_missing, load_predictor
from asp_env.data.recording import ticks
from asp_env.data.scene import EGO, Scene
from asp_env.data.snippets import Future
from asp_env.errors import AspEnvError
from asp_env.geometry import to_frame


class FlatParts(gymnasium.ObservationWrapper[dict[str, Any], Any, dict[str, Any]]):
    """Makes a vector of every table among the parts of a Dict; images and vectors stay.

    stable-baselines3's `check_env` warns of tables such as the action history, (15, 2); behind this
    wrapper it is a vector, (30,), time by time. Agents, lines, their masks and the route likewise.
    """

    def __init__(self, env: gymnasium.Env[dict[str, Any], Any]) -> None:
        """Wraps an environment whose observations are a Dict of boxes."""
        super().__init__(env)
        parts = env.observation_space
        assert isinstance(parts, spaces.Dict)
        self.observation_space = spaces.Dict({name: _flat(box) for name, box in parts.items()})

    def observation(self, observation: dict[str, Any]) -> dict[str, Any]:
        """The same numbers in the shapes of this wrapper's space."""
        parts = self.observation_space
        assert isinstance(parts, spaces.Dict)
        return {name: value.reshape(parts[name].shape) for name, value in observation.items()}


def _flat(box: spaces.Space[Any]) -> spaces.Space[Any]:
    if not isinstance(box, spaces.Box) or len(box.shape) < 2:
        return box
    if len(box.shape) == 3 and box.dtype == np.uint8:
        return box
    return spaces.Box(np.ravel(box.low), np.ravel(box.high), dtype=box.low.dtype.type)


MAX_AWAY_M = 100.0
"""Forecast positions further ahead, behind or aside than this are shown as this."""

AT_S = (1.0, 2.0, 3.0)

PARTS = ("forecast", "forecast_probabilities", "forecast_valid")


@runtime_checkable
class SceneProvider(Protocol):
    """What an environment offers to those who forecast in its loop."""

    dt_s: float

    def scene(self) -> Scene:
        """All that may be known now."""
        ...

    def recorded_future(self, scene: Scene, horizon: int) -> Future:
        """What the scene's targets went on to do, for privileged predictors."""
        ...


class ForecastObservations:
    """Turns scenes into the parts of an observation that show a predictor's forecasts."""

    def __init__(
        self,
        predictor: str | Predictor,
        *,
        agents: int,
        modes: int,
        at_s: Sequence[float],
        dt_s: float,
        privileged: bool,
    ) -> None:
        """See `PredictionFeatures` for the arguments; `dt_s` is the environment's.

        Raises:
            AspEnvError: an argument is out of range, or the predictor does not fit.
        """
        for what, count in (("agents", agents), ("modes", modes), ("at_s: times", len(at_s))):
            if count < 1:
                raise AspEnvError(f"{what} {count}: expected at least 1")
        at = np.array([ticks(time_s, dt_s) for time_s in at_s])
        horizon = int(at.max())
        if isinstance(predictor, str):
            predictor = load_predictor(predictor, horizon=horizon, dt_s=dt_s)
        _check(predictor, horizon, dt_s, privileged)
        self.predictor = predictor
        self._shape = agents, modes, len(at)
        self._at = at - 1
        prefix = "oracle_" if predictor.privileged else ""
        self._names = tuple(prefix + name for name in PARTS)
        sizes = (agents * modes * len(at) * 2, agents * modes, agents)
        lows = (-MAX_AWAY_M, 0.0, 0.0)
        highs = (MAX_AWAY_M, 1.0, 1.0)
        self.spaces: dict[str, spaces.Space[Any]] = {
            name: spaces.Box(low, high, (size,), dtype=np.float32)
            for name, low, high, size in zip(self._names, lows, highs, sizes, strict=True)
        }

    def observe(self, env: SceneProvider) -> dict[str, np.ndarray]:
        """One array (B, …) per part; one call of the predictor for all situations."""
        scene = env.scene()
        agents, modes, _ = self._shape
        targets, rank = nearest_agents(scene, agents)
        scene = scene.with_targets(targets)
        count = len(scene.tick)
        positions = np.zeros((count, *self._shape, 2), dtype=np.float32)
        probabilities = np.zeros((count, agents, modes), dtype=np.float32)
        there = np.zeros((count, agents), dtype=np.float32)
        if len(targets):
            predictor = self.predictor
            future = env.recorded_future(scene, predictor.horizon) if predictor.privileged else None
            forecast = fill_missing(predictor.predict(scene, future), scene)
            # a stable order, so that equally probable modes stay as the predictor has them
            order = np.argsort(-forecast.log_probs, axis=1, kind="stable")[:, :modes]
            rows, situation = np.arange(len(targets))[:, None], targets[:, 0]
            points = forecast.states[rows, order][:, :, self._at, :2]
            egos = scene.states[situation, EGO, -1][:, None, None]
            shown = order.shape[1]
            positions[situation, rank, :shown] = to_frame(points, egos)
            probabilities[situation, rank, :shown] = forecast.probabilities[rows, order]
            there[situation, rank] = 1.0
        parts = np.clip(positions, -MAX_AWAY_M, MAX_AWAY_M), np.clip(probabilities, 0, 1), there
        return {
            name: part.reshape(count, -1) for name, part in zip(self._names, parts, strict=True)
        }


def nearest_agents(
    scene: Scene, count: int
) -> tuple[Int[np.ndarray, "t 2"], Int[np.ndarray, " t"]]:
    """Targets: the agents nearest to each ego; and the how-manieth nearest each of them is."""
    others = scene.valid[:, :, -1].copy()
    others[:, EGO] = False
    offset_m = scene.states[:, :, -1, :2] - scene.states[:, EGO, None, -1, :2]
    away_m = np.where(others, np.hypot(offset_m[..., 0], offset_m[..., 1]), np.inf)
    # of those equally far the id decides: a slot must mean nothing
    nearest = np.lexsort((scene.ids, away_m), axis=-1)[:, :count]
    there = np.isfinite(np.take_along_axis(away_m, nearest, axis=1))
    situation, rank = np.nonzero(there)
    return np.stack([situation, nearest[there]], axis=-1), rank


class PredictionFeatures(
    gymnasium.ObservationWrapper[dict[str, Any], Any, dict[str, Any]], RecordConstructorArgs
):
    """Adds a predictor's forecasts of the nearest agents to the observation.

    | part | space | what it is |
    |---|---|---|
    | `forecast` | `Box(±100, (agents · modes · times · 2,))` | positions, x ahead and y left in \
the ego's present frame, m |
    | `forecast_probabilities` | `Box(0, 1, (agents · modes,))` | of the modes, which are sorted \
by it, the most probable first |
    | `forecast_valid` | `Box(0, 1, (agents,))` | 1 where there is such an agent |

    All are flat, float32, the nearest agent first, and zero where there is no such agent or mode.
    As planners do, the parts have constant velocity for agents that the predictor leaves out. The
    parts of a predictor that is told the future have `oracle_` before their names.

    The observation is asked for at every `reset` and `step`: one call of the predictor each.
    """

    def __init__(
        self,
        env: gymnasium.Env[dict[str, Any], Any],
        predictor: str | Predictor,
        *,
        agents: int = 8,
        modes: int = 3,
        at_s: Sequence[float] = AT_S,
        privileged: bool = False,
    ) -> None:
        """Wraps an environment of this package whose observations are a Dict.

        Args:
            env: the environment, possibly in wrappers already.
            predictor: its name, `constant-velocity` or `ssp-asp:RUN_DIR`, or a predictor.
            agents: how many of the nearest agents are shown.
            modes: how many of the most probable modes are shown.
            at_s: the times ahead whose positions are shown, whole ticks.
            privileged: allows a predictor that is told the recorded future.

        Raises:
            AspEnvError: the environment, the predictor or an argument does not fit.
        """
        RecordConstructorArgs.__init__(
            self, predictor=predictor, agents=agents, modes=modes, at_s=at_s, privileged=privileged
        )
        super().__init__(env)
        self._parts = ForecastObservations(
            predictor,
            agents=agents,
            modes=modes,
            at_s=at_s,
            dt_s=_scenic(env.unwrapped).dt_s,
            privileged=privileged,
        )
        self.observation_space = _joined(env.observation_space, self._parts.spaces)

    def observation(self, observation: dict[str, Any]) -> dict[str, Any]:
        """The observation and what is forecast now."""
        parts = self._parts.observe(_scenic(self.env.unwrapped))
        return observation | {name: part[0] for name, part in parts.items()}


class VectorPredictionFeatures(VectorObservationWrapper):
    """`PredictionFeatures` over a vector environment: one call of the predictor for all of it."""

    def __init__(
        self,
        env: VectorEnv,
        predictor: str | Predictor,
        *,
        agents: int = 8,
        modes: int = 3,
        at_s: Sequence[float] = AT_S,
        privileged: bool = False,
    ) -> None:
        """Wraps `asp_env/Replay-v0` as made by `gymnasium.make_vec`; see `PredictionFeatures`.

        Raises:
            AspEnvError: the environment, the predictor or an argument does not fit.
        """
        super().__init__(env)
        self._parts = ForecastObservations(
            predictor,
            agents=agents,
            modes=modes,
            at_s=at_s,
            dt_s=_scenic(env.unwrapped).dt_s,
            privileged=privileged,
        )
        self.single_observation_space = _joined(env.single_observation_space, self._parts.spaces)
        self.observation_space = batch_space(self.single_observation_space, env.num_envs)

    def observations(self, observations: dict[str, Any]) -> dict[str, Any]:
        """The observations and what is forecast now."""
        return observations | self._parts.observe(_scenic(self.env.unwrapped))


def _check(predictor: Predictor, horizon: int, dt_s: float, privileged: bool) -> None:
    if predictor.privileged and not privileged:
        raise AspEnvError(
            f"predictor {predictor.name} is told the recorded future, which no driver knows: "
            "give privileged=True if that is what you want"
        )
    if abs(predictor.dt_s - dt_s) > 1e-6:
        raise AspEnvError(
            f"predictor {predictor.name} was made for a time step of {predictor.dt_s:g} s, "
            f"the environment has {dt_s:g} s"
        )
    if predictor.horizon < horizon:
        raise AspEnvError(
            f"predictor {predictor.name} forecasts {predictor.horizon * dt_s:g} s: at_s asks for "
            f"{horizon * dt_s:g} s"
        )


def _scenic(env: Any) -> SceneProvider:
    if not isinstance(env, SceneProvider):
        raise AspEnvError(
            f"{type(env).__name__} has no scenes to forecast: expected an environment of asp_env"
        )
    return env


def _joined(space: spaces.Space[Any], more: dict[str, spaces.Space[Any]]) -> spaces.Space[Any]:
    if not isinstance(space, spaces.Dict):
        raise AspEnvError(f"observation space {space}: expected a Dict")
    if taken := sorted(set(space.keys()) & set(more)):
        raise AspEnvError(f"the observation has a part {taken[0]!r} already")
    return spaces.Dict({**space.spaces, **more})
