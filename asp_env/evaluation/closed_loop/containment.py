"""Containment of faulty predictors and planners, which any package may register.

A predictor or planner that raises, returns something else than what its socket asks for, or takes
too long does not stop a study: the episodes concerned are marked with the cause, and what is
missing is filled in with constant velocity. That is, agents without a usable forecast continue
straight at their present speed, and an ego without a usable plan carries out zero actions.
"""

import dataclasses
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Literal, TypeVar

import numpy as np
from jaxtyping import Bool

from asp_env.data.predictor import Forecast, Predictor, make_forecast
from asp_env.data.scene import EGO, Scene
from asp_env.data.snippets import Future
from asp_env.dynamics import rollout
from asp_env.errors import AspEnvError
from asp_env.planning.planner import Plan, Planner

PROBABILITY_TOLERANCE = 1e-3
"""Largest deviation of the sum of the modes' probabilities from one. Chosen by hand."""

Cause = Literal["raised", "wrong shapes", "wrong ids", "not finite", "over budget"]
"""What is wrong with a forecast or a plan."""

ResultT = TypeVar("ResultT")


@dataclass(frozen=True, slots=True, kw_only=True)
class Fault:
    """What went wrong first in an episode."""

    socket: Literal["predictor", "planner"]
    name: str
    """Name of the predictor or planner."""
    cause: Cause
    detail: str
    """One line."""
    tick: int
    """Tick of the episode, 0 for the first decision."""

    def __str__(self) -> str:
        return f"{self.socket} {self.name} {self.cause} at tick {self.tick}: {self.detail}"


class _FaultyResultError(Exception):
    """A result is not usable at all.

    Attributes:
        cause: what is wrong with it.
    """

    def __init__(self, cause: Cause, detail: str) -> None:
        self.cause: Cause = cause
        super().__init__(detail)


class Containment:
    """Calls predictors and planners, and records the faults of B episodes.

    Attributes:
        faults: the first fault of each episode, None for one without.
    """

    def __init__(self, num_episodes: int, *, budget_ms: float | None = None) -> None:
        """Starts without faults.

        Args:
            num_episodes: B.
            budget_ms: largest wall time of a forecast, and of a plan, of one episode at one tick;
                None for no limit. Results that are over it are not used. With a limit, results
                depend on the machine.
        """
        self.faults: list[Fault | None] = [None] * num_episodes
        self._budget_ms = budget_ms
        self._ticks = 0

    def predict(
        self,
        predictor: Predictor,
        scene: Scene,
        future: Future | None,
        running: Bool[np.ndarray, " b"],
    ) -> Forecast:
        """The forecast of a scene's targets; those without a usable one are not valid.

        If the predictor raises for all episodes together, it is called for one at a time.

        Args:
            predictor: the predictor.
            scene: the scene of B episodes.
            future: recorded future of the targets, for privileged predictors.
            running: mask of the episodes that have not ended.

        Returns:
            A forecast of all targets.
        """
        usable, faulty = self._call(
            "predictor",
            predictor.name,
            running,
            partial(_checked_forecast, predictor, scene, future),
        )
        if usable is None and running.sum() > 1 and not faulty:
            return self._predict_apart(predictor, scene, future, running)
        if usable is None:
            return _no_forecast(scene, predictor.horizon)
        return self._without_bad_rows(predictor.name, usable, scene)

    def plan(
        self, planner: Planner, scene: Scene, forecast: Forecast, running: Bool[np.ndarray, " b"]
    ) -> Plan:
        """The plans of B episodes; zero actions for those without a usable one.

        If the planner raises for all episodes together, it is called for one at a time.

        Args:
            planner: the planner.
            scene: the scene of B episodes.
            forecast: the forecast of its targets.
            running: mask of the episodes that have not ended.
        """
        steps = forecast.states.shape[2]
        usable, faulty = self._call(
            "planner",
            planner.name,
            running,
            partial(_checked_plan, planner, scene, forecast),
        )
        if usable is None and running.sum() > 1 and not faulty:
            usable = self._plan_apart(planner, scene, forecast, running)
        if usable is None:
            return coasting_plan(scene, steps)
        bad = ~_finite(usable.actions, usable.states) & running
        self._mark(bad, "planner", planner.name, "not finite", "an action or a state is not finite")
        if not bad.any():
            return usable
        filled = coasting_plan(scene, usable.actions.shape[1])
        return Plan(
            actions=np.where(bad[:, None, None], filled.actions, usable.actions),
            states=np.where(bad[:, None, None], filled.states, usable.states),
        )

    def next_tick(self) -> None:
        """States that all episodes have decided."""
        self._ticks += 1

    def _call(
        self,
        socket: Literal["predictor", "planner"],
        name: str,
        concerned: Bool[np.ndarray, " b"],
        call: Callable[[], ResultT],
    ) -> tuple[ResultT | None, bool]:
        """The result of a call, or None; and whether the episodes concerned were marked."""
        start = time.perf_counter()
        try:
            result = call()
        except _FaultyResultError as error:
            self._mark(concerned, socket, name, error.cause, str(error))
            return None, True
        except Exception as error:  # a plug of another package may raise anything
            if concerned.sum() > 1:
                return None, False
            reason = str(error) if isinstance(error, AspEnvError) else repr(error)
            self._mark(concerned, socket, name, "raised", " ".join(reason.split()))
            return None, True
        took_ms = (time.perf_counter() - start) * 1e3 / max(int(concerned.sum()), 1)
        if self._budget_ms is not None and took_ms > self._budget_ms:
            detail = f"more than {self._budget_ms:g} ms"
            self._mark(concerned, socket, name, "over budget", detail)
            return None, True
        return result, False

    def _predict_apart(
        self,
        predictor: Predictor,
        scene: Scene,
        future: Future | None,
        running: Bool[np.ndarray, " b"],
    ) -> Forecast:
        """The forecasts of one episode after another."""
        parts: list[Forecast] = []
        for episode in np.flatnonzero(running).tolist():
            rows = np.flatnonzero(scene.targets[:, 0] == episode)
            alone = scene.with_targets(scene.targets[rows])
            own = None if future is None else _rows_of_future(future, rows)
            only = np.zeros_like(running)
            only[episode] = True
            part = self.predict(predictor, alone, own, only)
            modes = next((each.states.shape[1] for each in parts if each.valid.any()), None)
            if part.valid.any() and modes not in (None, part.states.shape[1]):
                detail = f"{part.states.shape[1]} modes, {modes} in another episode"
                self._mark(only, "predictor", predictor.name, "wrong shapes", detail)
                part = _no_forecast(alone, predictor.horizon)
            parts.append(part)
        return _joined(parts, scene)

    def _plan_apart(
        self, planner: Planner, scene: Scene, forecast: Forecast, running: Bool[np.ndarray, " b"]
    ) -> Plan:
        """The plans of one episode after another."""
        steps = forecast.states.shape[2]
        plan = coasting_plan(scene, steps)
        for episode in np.flatnonzero(running).tolist():
            only = np.zeros_like(running)
            only[episode] = True
            alone, own = scene.situation(episode), _rows_of_situation(forecast, episode)
            call = partial(_checked_plan, planner, alone, own)
            found, _ = self._call("planner", planner.name, only, call)
            if found is not None:
                length = min(steps, found.actions.shape[1])
                plan.actions[episode, :length] = found.actions[0, :length]
                plan.states[episode, :length] = found.states[0, :length]
        return plan

    def _without_bad_rows(self, name: str, forecast: Forecast, scene: Scene) -> Forecast:
        """The forecast with rows that are not finite or of other agents marked as not valid."""
        at = (scene.targets[:, 0], scene.targets[:, 1])
        other = (forecast.ids != scene.ids[at]) | (forecast.targets != scene.targets).any(axis=1)
        sums = np.exp(np.where(np.isfinite(forecast.log_probs), forecast.log_probs, -np.inf))
        finite = _finite(forecast.states, forecast.actions) & ~np.isnan(forecast.log_probs).any(
            axis=1
        )
        finite &= np.abs(sums.sum(axis=1) - 1) <= PROBABILITY_TOLERANCE
        not_finite = forecast.valid & ~other & ~finite
        detail = "a forecast is of another agent than its target"
        self._mark(self._of_targets(scene, other), "predictor", name, "wrong ids", detail)
        detail = "a state or a probability is not finite, or probabilities do not sum to one"
        self._mark(self._of_targets(scene, not_finite), "predictor", name, "not finite", detail)
        bad = other | not_finite
        if not bad.any():
            return forecast
        fill = _no_forecast(scene, forecast.states.shape[2])
        log_prob = -np.log(forecast.log_probs.shape[1])
        return dataclasses.replace(
            forecast,
            states=np.where(bad[:, None, None, None], 0, forecast.states).astype(np.float32),
            actions=np.where(bad[:, None, None, None], 0, forecast.actions).astype(np.float32),
            actions_valid=forecast.actions_valid & ~bad,
            log_probs=np.where(bad[:, None], log_prob, forecast.log_probs).astype(np.float32),
            valid=forecast.valid & ~bad,
            ids=fill.ids,
            targets=fill.targets,
        )

    def _of_targets(self, scene: Scene, rows: Bool[np.ndarray, " t"]) -> Bool[np.ndarray, " b"]:
        """Mask of the episodes of some targets."""
        concerned = np.zeros(len(self.faults), dtype=bool)
        concerned[scene.targets[rows, 0]] = True
        return concerned

    def _mark(
        self,
        concerned: Bool[np.ndarray, " b"],
        socket: Literal["predictor", "planner"],
        name: str,
        cause: Cause,
        detail: str,
    ) -> None:
        for episode in np.flatnonzero(concerned).tolist():
            if self.faults[episode] is None:
                self.faults[episode] = Fault(
                    socket=socket, name=name, cause=cause, detail=detail, tick=self._ticks
                )


def _checked_forecast(predictor: Predictor, scene: Scene, future: Future | None) -> Forecast:
    """A forecast, whose arrays have the shapes and types that the scene asks for.

    Raises:
        _FaultyResultError: it is something else.
    """
    forecast: object = predictor.predict(scene, future)
    if not isinstance(forecast, Forecast):
        raise _FaultyResultError(
            "wrong shapes", f"expected a Forecast, found {type(forecast).__name__}"
        )
    count = len(scene.targets)
    modes = forecast.log_probs.shape[1] if np.ndim(forecast.log_probs) == 2 else 1
    expected: dict[str, tuple[tuple[int, ...], str]] = {
        "states": ((count, max(modes, 1), predictor.horizon, 4), "f"),
        "actions": ((count, max(modes, 1), predictor.horizon, 2), "f"),
        "log_probs": ((count, max(modes, 1)), "f"),
        "ids": ((count,), "iu"),
        "targets": ((count, 2), "iu"),
        "valid": ((count,), "b"),
        "actions_valid": ((count,), "b"),
    }
    if forecast.fallback is not None:
        expected["fallback"] = ((count,), "f")
    for name, (shape, kinds) in expected.items():
        _check_array(name, getattr(forecast, name), shape, kinds)
    return forecast


def _checked_plan(planner: Planner, scene: Scene, forecast: Forecast) -> Plan:
    """A plan, whose arrays have the shapes and types that the scene asks for.

    Raises:
        _FaultyResultError: it is something else.
    """
    plan: object = planner.plan(scene, forecast)
    if not isinstance(plan, Plan):
        raise _FaultyResultError("wrong shapes", f"expected a Plan, found {type(plan).__name__}")
    steps = plan.actions.shape[1] if np.ndim(plan.actions) == 3 else 0
    for name, width in (("actions", 2), ("states", 4)):
        _check_array(name, getattr(plan, name), (len(scene.tick), max(steps, 1), width), "f")
    return plan


def _check_array(name: str, value: object, shape: tuple[int, ...], kinds: str) -> None:
    """Checks the shape of an array and the kind of its numbers, as of `numpy.dtype.kind`.

    Raises:
        _FaultyResultError: they are others.
    """
    if not isinstance(value, np.ndarray):
        found = type(value).__name__
    elif value.shape == shape and value.dtype.kind in kinds:
        return
    else:
        found = f"{value.shape} of {value.dtype}"
    kind = {"f": "floating-point", "iu": "whole", "b": "true or false"}[kinds]
    raise _FaultyResultError("wrong shapes", f"{name} {found}, expected {shape} of {kind} numbers")


def _finite(*arrays: np.ndarray) -> Bool[np.ndarray, " n"]:
    """Which rows of all arrays are finite."""
    finite = [np.isfinite(each).all(axis=tuple(range(1, each.ndim))) for each in arrays]
    return np.all(finite, axis=0)


def _no_forecast(scene: Scene, steps: int) -> Forecast:
    """A forecast of one mode in which no target is valid."""
    count = len(scene.targets)
    return make_forecast(
        scene,
        states=np.zeros((count, 1, steps, 4), dtype=np.float32),
        actions=None,
        log_probs=np.zeros((count, 1), dtype=np.float32),
        valid=np.zeros(count, dtype=bool),
    )


def coasting_plan(scene: Scene, steps: int) -> Plan:
    """Plans of zero actions for all situations of a scene.

    Args:
        scene: the scene.
        steps: number of ticks.
    """
    egos = scene.states[:, EGO, -1]
    actions = np.zeros((len(egos), steps, 2), dtype=np.float32)
    lengths_m = np.maximum(scene.sizes[:, EGO, 0], 1.0)  # episodes that have ended may have none
    states = rollout(egos, actions, lengths_m, scene.dt_s).astype(np.float32)
    return Plan(actions=actions, states=states)


def _rows_of_future(future: Future, rows: np.ndarray) -> Future:
    return Future(states=future.states[rows], valid=future.valid[rows])


def _rows_of_situation(forecast: Forecast, situation: int) -> Forecast:
    """The forecast of the targets of one situation, which becomes situation 0."""
    rows = np.flatnonzero(forecast.targets[:, 0] == situation)
    arrays = {
        field.name: value[rows]
        for field in dataclasses.fields(forecast)
        if isinstance(value := getattr(forecast, field.name), np.ndarray)
    }
    arrays["targets"][:, 0] = 0
    return dataclasses.replace(forecast, **arrays)


def _joined(parts: list[Forecast], scene: Scene) -> Forecast:
    """The forecasts of single episodes, of equally many modes, as one of all targets of a scene."""
    usable = [part for part in parts if part.valid.any()]
    if not usable:
        return _no_forecast(scene, parts[0].states.shape[2])
    modes, steps = usable[0].states.shape[1:3]
    whole = _no_forecast(scene, steps)
    states = np.repeat(whole.states, modes, axis=1)
    actions = np.repeat(whole.actions, modes, axis=1)
    log_probs = np.full((len(states), modes), -np.log(modes), dtype=np.float32)
    valid, actions_valid = whole.valid.copy(), whole.actions_valid.copy()
    for part in usable:
        rows = np.flatnonzero(scene.targets[:, 0] == part.targets[0, 0])
        states[rows], actions[rows], log_probs[rows] = part.states, part.actions, part.log_probs
        valid[rows], actions_valid[rows] = part.valid, part.actions_valid
    return dataclasses.replace(
        whole,
        states=states,
        actions=actions,
        log_probs=log_probs,
        valid=valid,
        actions_valid=actions_valid,
    )
