"""Observation wrappers: forecasts as part of the observation, and flat tables."""

from collections.abc import Sequence
from typing import Any, Protocol, runtime_checkable

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.utils import RecordConstructorArgs
from gymnasium.vector import VectorEnv, VectorObservationWrapper
from gymnasium.vector.utils import batch_space
from jaxtyping import Int

from asp_env.data.predictor import (
    Predictor,
    feature_size,
    fill_missing,
    load_predictor,
    needs_simulation,
)
from asp_env.data.recording import ticks
from asp_env.data.scene import EGO, Scene
from asp_env.data.snippets import Future
from asp_env.errors import AspEnvError
from asp_env.geometry import to_frame

MAX_POSITION_M = 100.0
"""Forecast positions are clipped to this distance along each axis of the ego's frame. Chosen by
hand."""

FORECAST_TIMES_S = (1.0, 2.0, 3.0)
"""Default times ahead of the forecast positions."""

MAX_FEATURE = 100.0
"""Features are clipped to this size. Chosen by hand: normalised features stay below 30."""


class FlatParts(gymnasium.ObservationWrapper[dict[str, Any], Any, dict[str, Any]]):
    """Flattens the tables of a Dict observation to vectors; images and vectors stay unchanged.

    stable-baselines3's `check_env` warns of tables such as the action history, (15, 2), which
    becomes (30,), tick by tick. Agents, lines, their masks and the route are flattened as well.
    """

    def __init__(self, env: gymnasium.Env[dict[str, Any], Any]) -> None:
        """Wraps an environment.

        Args:
            env: an environment whose observation space is a Dict of boxes.
        """
        super().__init__(env)
        space = env.observation_space
        assert isinstance(space, spaces.Dict)
        self.observation_space = spaces.Dict({name: _flatten(box) for name, box in space.items()})

    def observation(self, observation: dict[str, Any]) -> dict[str, Any]:
        """Returns the observation in the shapes of this wrapper's space."""
        space = self.observation_space
        assert isinstance(space, spaces.Dict)
        return {name: value.reshape(space[name].shape) for name, value in observation.items()}


def _flatten(box: spaces.Space[Any]) -> spaces.Space[Any]:
    if not isinstance(box, spaces.Box) or len(box.shape) < 2:
        return box
    if len(box.shape) == 3 and box.dtype == np.uint8:
        return box
    return spaces.Box(np.ravel(box.low), np.ravel(box.high), dtype=box.low.dtype.type)


class PredictionFeatures(
    gymnasium.ObservationWrapper[dict[str, Any], Any, dict[str, Any]], RecordConstructorArgs
):
    """Adds a predictor's forecasts of the nearest agents to the observation.

    | key | space | content |
    |---|---|---|
    | `forecast` | `Box(±100, (agents · modes · times · 2,))` | positions in m, x ahead and y to \
the left in the present frame of the ego |
    | `forecast_probabilities` | `Box(0, 1, (agents · modes,))` | probabilities of the modes, in \
descending order |
    | `forecast_valid` | `Box(0, 1, (agents,))` | 1 where there is an agent |
    | `forecast_features` | `Box(±100, (agents · features,))` | with `features=True`: what the \
predictor's network encodes of each agent, `Forecast.features` |

    All entries are flat float32 arrays. The nearest agent comes first; entries without an agent or
    a mode are zero. Agents without a forecast get constant velocity, as for planners, and features
    of zero. For a
    privileged predictor the keys start with `oracle_`. The predictor is called once in every
    `reset` and `step`.
    """

    def __init__(
        self,
        env: gymnasium.Env[dict[str, Any], Any],
        predictor: str | Predictor,
        *,
        agents: int = 8,
        modes: int = 3,
        at_s: Sequence[float] = FORECAST_TIMES_S,
        privileged: bool = False,
        features: bool = False,
    ) -> None:
        """Wraps an environment.

        Args:
            env: an environment of this package, possibly in wrappers, with a Dict observation.
            predictor: a predictor or its name, such as `constant-velocity`, `ffw-asp:pretrained` or
                `ssp-asp:RUN_DIR`.
            agents: number of nearest agents.
            modes: number of most probable modes.
            at_s: times ahead of the positions in seconds, whole ticks.
            privileged: allows a predictor that uses the recorded future.
            features: adds the features of the predictor's network, which must be a trained one.

        Raises:
            AspEnvError: the environment, the predictor or an argument is invalid.
        """
        RecordConstructorArgs.__init__(
            self,
            predictor=predictor,
            agents=agents,
            modes=modes,
            at_s=at_s,
            privileged=privileged,
            features=features,
        )
        super().__init__(env)
        self._forecasts = ForecastObservations(
            predictor,
            agents=agents,
            modes=modes,
            at_s=at_s,
            dt_s=_scene_provider(env.unwrapped).dt_s,
            privileged=privileged,
            features=features,
        )
        self.observation_space = _extend(env.observation_space, self._forecasts.spaces)

    def observation(self, observation: dict[str, Any]) -> dict[str, Any]:
        """Returns the observation with the present forecasts."""
        forecasts = self._forecasts.observe(_scene_provider(self.env.unwrapped))
        return observation | {name: value[0] for name, value in forecasts.items()}


class VectorPredictionFeatures(VectorObservationWrapper):
    """`PredictionFeatures` for a vector environment, with one predictor call for all episodes."""

    def __init__(
        self,
        env: VectorEnv,
        predictor: str | Predictor,
        *,
        agents: int = 8,
        modes: int = 3,
        at_s: Sequence[float] = FORECAST_TIMES_S,
        privileged: bool = False,
        features: bool = False,
    ) -> None:
        """Wraps a `ReplayVectorEnv`, possibly in wrappers.

        Args:
            env: the vector environment.
            predictor: see `PredictionFeatures`, as for the following arguments.
            agents: number of nearest agents.
            modes: number of most probable modes.
            at_s: times ahead of the positions in seconds, whole ticks.
            privileged: allows a predictor that uses the recorded future.
            features: adds the features of the predictor's network, which must be a trained one.

        Raises:
            AspEnvError: the environment, the predictor or an argument is invalid.
        """
        super().__init__(env)
        self._forecasts = ForecastObservations(
            predictor,
            agents=agents,
            modes=modes,
            at_s=at_s,
            dt_s=_scene_provider(env.unwrapped).dt_s,
            privileged=privileged,
            features=features,
        )
        self.single_observation_space = _extend(
            env.single_observation_space, self._forecasts.spaces
        )
        self.observation_space = batch_space(self.single_observation_space, env.num_envs)

    def observations(self, observations: dict[str, Any]) -> dict[str, Any]:
        """Returns the observations with the present forecasts."""
        return observations | self._forecasts.observe(_scene_provider(self.env.unwrapped))


@runtime_checkable
class SceneProvider(Protocol):
    """An environment whose agents can be forecast."""

    dt_s: float

    def scene(self) -> Scene:
        """Returns everything that may be known now."""
        ...

    def recorded_future(self, scene: Scene, horizon: int) -> Future:
        """Returns the recorded future of the scene's targets, for privileged predictors."""
        ...


class ForecastObservations:
    """Converts scenes to the observation entries that show a predictor's forecasts."""

    def __init__(
        self,
        predictor: str | Predictor,
        *,
        agents: int,
        modes: int,
        at_s: Sequence[float],
        dt_s: float,
        privileged: bool,
        features: bool,
    ) -> None:
        """Loads the predictor and defines the spaces.

        Args:
            predictor: see `PredictionFeatures`, as for the following arguments.
            agents: number of nearest agents.
            modes: number of most probable modes.
            at_s: times ahead of the positions in seconds, whole ticks.
            dt_s: length of a tick of the environment in seconds.
            privileged: allows a predictor that uses the recorded future.
            features: adds the features of the predictor's network, which must be a trained one.

        Raises:
            AspEnvError: an argument is out of range, or the predictor is invalid.
        """
        for name, count in (("agents", agents), ("modes", modes), ("at_s: times", len(at_s))):
            if count < 1:
                raise AspEnvError(f"{name} {count}: expected at least 1")
        ticks_ahead = np.array([ticks(time_s, dt_s) for time_s in at_s])
        horizon = int(ticks_ahead.max())
        if isinstance(predictor, str):
            predictor = load_predictor(predictor, horizon=horizon, dt_s=dt_s)
        _check_predictor(predictor, horizon, dt_s, privileged)
        self.predictor = predictor
        self._shape = agents, modes, len(ticks_ahead)
        self._steps = ticks_ahead - 1
        prefix = "oracle_" if predictor.privileged else ""
        self._feature_size = feature_size(predictor) if features else 0
        if features and not self._feature_size:
            raise AspEnvError(
                f"predictor {predictor.name} has no features, only trained ones do: take one, such "
                "as ssp-asp:pretrained, or omit features=True"
            )
        bounds = {
            "forecast": (-MAX_POSITION_M, MAX_POSITION_M, agents * modes * len(ticks_ahead) * 2),
            "forecast_probabilities": (0.0, 1.0, agents * modes),
            "forecast_valid": (0.0, 1.0, agents),
        }
        if features:
            size = agents * self._feature_size
            bounds["forecast_features"] = (-MAX_FEATURE, MAX_FEATURE, size)
        self.spaces: dict[str, spaces.Space[Any]] = {
            prefix + key: spaces.Box(low, high, (size,), dtype=np.float32)
            for key, (low, high, size) in bounds.items()
        }

    def observe(self, env: SceneProvider) -> dict[str, np.ndarray]:
        """Returns an array (B, size) for each key, with one call of the predictor."""
        scene = env.scene()
        agents, modes, _ = self._shape
        targets, rank = nearest_agents(scene, agents)
        scene = scene.with_targets(targets)
        count = len(scene.tick)
        positions = np.zeros((count, *self._shape, 2), dtype=np.float32)
        probabilities = np.zeros((count, agents, modes), dtype=np.float32)
        valid = np.zeros((count, agents), dtype=np.float32)
        features = np.zeros((count, agents, self._feature_size), dtype=np.float32)
        if len(targets):
            predictor = self.predictor
            future = env.recorded_future(scene, predictor.horizon) if predictor.privileged else None
            forecast = fill_missing(predictor.predict(scene, future), scene)
            # A stable sort keeps the predictor's order of equally probable modes.
            order = np.argsort(-forecast.log_probs, axis=1, kind="stable")[:, :modes]
            rows, situation = np.arange(len(targets))[:, None], targets[:, 0]
            points = forecast.states[rows, order][:, :, self._steps, :2]
            egos = scene.states[situation, EGO, -1][:, None, None]
            num_modes = order.shape[1]
            positions[situation, rank, :num_modes] = to_frame(points, egos)
            probabilities[situation, rank, :num_modes] = forecast.probabilities[rows, order]
            valid[situation, rank] = 1.0
            if self._feature_size and forecast.features is not None:
                features[situation, rank] = forecast.features
        values = [
            np.clip(positions, -MAX_POSITION_M, MAX_POSITION_M),
            np.clip(probabilities, 0, 1),
            valid,
        ]
        if self._feature_size:
            values.append(np.clip(features, -MAX_FEATURE, MAX_FEATURE))
        return {
            key: value.reshape(count, -1) for key, value in zip(self.spaces, values, strict=True)
        }


def nearest_agents(
    scene: Scene, count: int
) -> tuple[Int[np.ndarray, "t 2"], Int[np.ndarray, " t"]]:
    """Finds the agents nearest to the ego of each situation.

    Args:
        scene: B situations.
        count: the largest number of agents per situation.

    Returns:
        (T, 2) situation and slot of the agents, and (T,) their rank in the situation, 0 for the
        nearest. Agents at the same distance are ordered by id, since the order of slots is
        arbitrary.
    """
    present = scene.valid[:, :, -1].copy()
    present[:, EGO] = False
    offset_m = scene.states[:, :, -1, :2] - scene.states[:, EGO, None, -1, :2]
    distance_m = np.where(present, np.hypot(offset_m[..., 0], offset_m[..., 1]), np.inf)
    nearest = np.lexsort((scene.ids, distance_m), axis=-1)[:, :count]
    exists = np.isfinite(np.take_along_axis(distance_m, nearest, axis=1))
    situation, rank = np.nonzero(exists)
    return np.stack([situation, nearest[exists]], axis=-1), rank


def _check_predictor(predictor: Predictor, horizon: int, dt_s: float, privileged: bool) -> None:
    if needs_simulation(predictor):
        raise AspEnvError(
            f"predictor {predictor.name} simulates the ego's plan, which an environment does not "
            "know: use oracle, or asp-env drive"
        )
    if predictor.privileged and not privileged:
        raise AspEnvError(
            f"predictor {predictor.name} uses the recorded future, which is not known while "
            "driving: allow it with privileged=True"
        )
    if abs(predictor.dt_s - dt_s) > 1e-6:
        raise AspEnvError(
            f"predictor {predictor.name} was made for a time step of {predictor.dt_s:g} s, "
            f"the environment has {dt_s:g} s"
        )
    if predictor.horizon < horizon:
        raise AspEnvError(
            f"predictor {predictor.name} forecasts {predictor.horizon * dt_s:g} s: at_s has times "
            f"up to {horizon * dt_s:g} s"
        )


def _scene_provider(env: Any) -> SceneProvider:
    if not isinstance(env, SceneProvider):
        raise AspEnvError(
            f"{type(env).__name__} has no scenes to forecast: expected an environment of asp_env"
        )
    return env


def _extend(space: spaces.Space[Any], added: dict[str, spaces.Space[Any]]) -> spaces.Space[Any]:
    if not isinstance(space, spaces.Dict):
        raise AspEnvError(f"observation space {space}: expected a Dict")
    if taken := sorted(set(space.keys()) & set(added)):
        raise AspEnvError(f"the observation has an entry {taken[0]!r} already")
    return spaces.Dict({**space.spaces, **added})
