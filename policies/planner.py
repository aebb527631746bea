"""A trained policy as a planner: `asp-env drive DATA --planner sb3:RUN`."""

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from asp_env.data.predictor import Forecast, Predictor
from asp_env.data.scene import EGO, Scene
from asp_env.data.snippets import Future
from asp_env.dynamics import rollout
from asp_env.envs.forecasts import ForecastObserver, ForecastOptions, Present
from asp_env.errors import AspEnvError
from asp_env.geometry import route_coordinates
from asp_env.planning.planner import Plan
from asp_env.sim.action_types import following_steering, to_physical
from asp_env.sim.observation import ObservationContext, Observer
from asp_env.sim.world import Events
from asp_env.views import make_raster_view
from policies.observations import Observations, components, reduce_observations
from policies.runs import TrainedPolicy, check_predictor, load_policy


class PolicyPlanner:
    """Drives by the most probable action of a trained policy, which decides anew at every tick.

    In its environment the policy decides every `action_repeat` ticks. The forecast must be of the
    predictor that the policy was trained with.
    """

    privileged = False

    def __init__(self, trained: TrainedPolicy, folder: Path) -> None:
        """Makes a planner of a policy.

        Args:
            trained: the policy.
            folder: its run folder.

        Raises:
            AspEnvError: the policy observes several predictors or delayed forecasts, or is
                recurrent.
        """
        self.name = f"sb3:{folder}"
        self._trained, self._folder = trained, folder
        settings = trained.settings.environment
        if trained.settings.algorithm == "recurrent-ppo":
            raise AspEnvError(
                f"{folder}: a recurrent policy has a memory, a planner has none; evaluate it with "
                "asp-env rl evaluate"
            )
        self._options = ForecastOptions(**settings.forecast)
        if self._options.max_age_ticks:
            raise AspEnvError(
                f"{folder}: the policy observes delayed forecasts, a planner is given new ones; "
                "evaluate it with asp-env rl evaluate"
            )
        self.uses_forecasts = settings.predictor is not None
        self._observer: Observer | None = None

    @classmethod
    def from_name(cls, argument: str) -> "PolicyPlanner":
        """Loads the policy of a run folder.

        Raises:
            AspEnvError: there is no finished run, or it is damaged.
        """
        return cls(load_policy(Path(argument)), Path(argument))

    def check_predictor(self, predictor: Predictor) -> None:
        """Checks that a predictor is the one of the training.

        Raises:
            AspEnvError: it is another one.
        """
        check_predictor(self._folder, predictor)

    def plan(self, scene: Scene, forecast: Forecast) -> Plan:
        """Plans the policy's action, held for the horizon of the forecast.

        Raises:
            AspEnvError: a situation has no route, or the time step is not that of the training.
        """
        settings = self._trained.settings.environment
        scene.check_dt(settings.dt_s, f"the policy of {self._folder}")
        if (scene.route_valid.sum(axis=1) < 2).any():
            raise AspEnvError("a planner needs the ego's route: take the scene from a world")
        egos = np.ascontiguousarray(scene.states[:, EGO, -1])
        on_route = route_coordinates(
            scene.route, scene.route_valid, egos, np.full(len(scene.tick), -1.0)
        )
        observations = self._observe(scene, forecast, on_route)
        actions = self._trained.act(observations)
        lengths = np.maximum(scene.sizes[:, EGO, 0], 0.1)
        following = following_steering(
            egos, lengths, scene.route, scene.route_valid, on_route[:, 0]
        )
        physical = to_physical(
            settings.action_type, actions, scene.actions[:, EGO, -1], following, scene.dt_s
        )
        held = np.repeat(physical[:, None], forecast.states.shape[2], axis=1)
        return Plan(actions=held, states=rollout(egos, held, lengths, scene.dt_s))

    def _observe(
        self, scene: Scene, forecast: Forecast, on_route: Float[np.ndarray, "b 3"]
    ) -> Observations:
        settings = self._trained.settings.environment
        if self._observer is None:
            view = "chauffeurnet" if settings.view is None else settings.view
            raster = make_raster_view(view, pixels=settings.raster_px)
            self._observer = Observer(components(settings), raster, scene.history)
        observed = self._observer.observe(_context(scene), _events(scene, on_route))
        if self.uses_forecasts:
            observed |= self._forecast_entries(scene, forecast)
        return reduce_observations(observed, settings)

    def _forecast_entries(self, scene: Scene, forecast: Forecast) -> dict[str, np.ndarray]:
        is_privileged = any(name.startswith("oracle_") for name in self._trained.space.spaces)
        given = _GivenForecast(forecast, is_privileged, forecast.dt_s)
        options = dataclasses.replace(self._options, privileged=is_privileged)
        observer = ForecastObserver(given, options, scene.dt_s)
        rows = np.arange(len(scene.tick))
        return observer.observe(_SceneSource(scene), rows)


class _GivenForecast:
    """A predictor that returns a forecast that has been made of the same scene."""

    trained_on = None
    history = 0

    def __init__(self, forecast: Forecast, privileged: bool, dt_s: float) -> None:
        self.name, self.privileged, self.dt_s = "given", privileged, dt_s
        self.metadata: dict[str, str] = {}
        self.horizon = forecast.states.shape[2]
        self._forecast = forecast
        self.feature_size = 0 if forecast.features is None else forecast.features.shape[1]
        count = 1 + int(forecast.targets[:, 1].max(initial=0))
        self._row = {
            int(situation) * count + int(slot): row
            for row, (situation, slot) in enumerate(forecast.targets)
        }
        self._count = count

    def predict(self, scene: Scene, future: Future | None = None) -> Forecast:
        """Returns the forecast of the scene's targets; those without one are not valid."""
        del future
        keys = scene.targets[:, 0] * self._count + scene.targets[:, 1]
        known = scene.targets[:, 1] < self._count
        rows = np.array([self._row.get(int(key), -1) for key in keys], dtype=np.int64)
        rows = np.where(known, rows, -1)
        forecast = self._forecast
        found = rows >= 0

        def of(values: Any) -> Any:
            if not len(values):
                return np.zeros((len(rows), *values.shape[1:]), dtype=values.dtype)
            missing = found.reshape(-1, *[1] * (values.ndim - 1))
            return np.where(missing, values[rows], 0).astype(values.dtype)

        return dataclasses.replace(
            forecast,
            states=of(forecast.states),
            actions=of(forecast.actions),
            actions_valid=of(forecast.actions_valid),
            log_probs=np.where(found[:, None], of(forecast.log_probs), _uniform(forecast)),
            ids=scene.ids[scene.targets[:, 0], scene.targets[:, 1]],
            targets=scene.targets,
            tick=scene.tick[scene.targets[:, 0]],
            valid=of(forecast.valid),
            fallback=None,
            features=None if forecast.features is None else of(forecast.features),
        )


def _uniform(forecast: Forecast) -> np.float32:
    return np.float32(-np.log(forecast.log_probs.shape[1]))


class _SceneSource:
    """One scene, as the episodes of a `ForecastObserver`."""

    def __init__(self, scene: Scene) -> None:
        self._scene, self.dt_s = scene, scene.dt_s

    def __len__(self) -> int:
        return len(self._scene.tick)

    def present(self, rows: Int[np.ndarray, " r"]) -> Present:
        """Returns the present tick."""
        scene = self._scene
        return Present(
            states=scene.states[rows, :, -1],
            valid=scene.valid[rows, :, -1],
            ids=scene.ids[rows],
            elapsed=np.zeros(len(rows), dtype=np.int64),
            serials=rows,
        )

    def scene(
        self,
        rows: Int[np.ndarray, " r"],
        targets: Int[np.ndarray, "t 2"],
        history: int | None = None,
    ) -> Scene:
        """Returns the scene with other targets; `rows` are all its situations."""
        del rows, history
        return self._scene.with_targets(targets)

    def recorded_future(self, scene: Scene, horizon: int, rows: Int[np.ndarray, " r"]) -> Any:
        """Returns nothing: the forecast has been made."""
        del scene, horizon, rows


def _context(scene: Scene) -> ObservationContext:
    count = len(scene.tick)
    targets = np.full((count, 2), EGO)
    targets[:, 0] = np.arange(count)
    return ObservationContext(
        states=scene.states,
        valid=scene.valid,
        sizes=scene.sizes,
        classes=scene.classes,
        ids=scene.ids,
        targets=targets,
        routes=scene.route,
        route_valid=scene.route_valid,
        maps=scene.maps,
        map_index=scene.map_index,
        dt_s=scene.dt_s,
        signals=scene.signals,
    )


def _events(scene: Scene, on_route: Float[np.ndarray, "b 3"]) -> Events:
    """What the observation reads of the events; the goal, which policies do not observe, is 0."""
    count = len(scene.tick)
    nothing = np.zeros(count)
    return Events(
        contacts=np.zeros((count, 1), dtype=np.int8),
        off_road_m=nothing,
        route_m=on_route[:, 0],
        route_offset_m=on_route[:, 1],
        route_heading_rad=on_route[:, 2],
        goal_m=nothing,
        elapsed=np.zeros(count, dtype=np.int64),
        length=np.zeros(count, dtype=np.int64),
    )
