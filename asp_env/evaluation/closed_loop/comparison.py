"""Methods that drive the same scenarios, in work units that any process can run.

A work unit is a set of scenarios that one method drives side by side. Units do not depend on each
other or on the number of processes, and networks run on one thread, so results are the same bit
for bit however the units are distributed.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, final

import numpy as np
from jaxtyping import Float, Int

from asp_env.data.predictor import Predictor
from asp_env.data.recording import ticks
from asp_env.data.rollout import Rollout
from asp_env.data.scenarios.scenario import Scenario, ScenarioSet
from asp_env.data.snippets import HISTORY_S
from asp_env.data.source import Recordings
from asp_env.evaluation.closed_loop.containment import Fault
from asp_env.evaluation.closed_loop.episodes import EpisodeSettings, drive_episodes
from asp_env.evaluation.results import FALLBACK, FAULTY
from asp_env.evaluation.selection import load_predictors, short_names
from asp_env.metrics.driving.rules import Rules, find_rules
from asp_env.metrics.driving.scores import driving_metrics
from asp_env.metrics.masked import Masked
from asp_env.planning.planner import Planner, TrainedPlanner, load_planner
from asp_env.sim.traffic.assignment import make_traffic
from asp_env.sim.world import Ending, world_class
from asp_env.workers import one_thread

EPISODES_AT_ONCE = 16
"""Number of scenarios in a work unit at most. Chosen by hand: units of one to a few seconds let
processes finish at about the same time, and larger ones are no faster."""

SAVED_ROLLOUTS = 6
"""Number of the worst scenarios, whose rollouts are saved for every method."""

TELLING_ROLLOUTS = 3
"""Number of scenarios with the largest gains over the reference whose rollouts are saved as well,
and of those with the largest losses."""

EXPERT = "expert"
"""Name of the planner that replays the logged ego; the reference of every comparison."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Method:
    """A planner with a predictor, or with one training run of a predictor of several runs."""

    planner: Planner
    predictor: Predictor
    predictor_name: str
    """Name of the predictor as given, which several runs share; empty if the planner uses no
    forecasts."""
    run: str
    """Name of the training run; that of the predictor if it has one run."""


@dataclass(frozen=True, slots=True, kw_only=True)
class WorkUnit:
    """Scenarios that one method, or one run of it, drives side by side."""

    method: int
    """Index in `Methods.all`."""
    numbers: Int[np.ndarray, " b"]
    """Indices of the scenarios among all."""
    scenarios: tuple[Scenario, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class EpisodeScores:
    """Driving metrics, endings and rollouts of B episodes of one method."""

    metrics: Mapping[str, Masked]
    """Values (b,) by name."""
    endings: tuple[Ending, ...]
    rollouts: tuple[Rollout, ...]
    faults: tuple[Fault | None, ...]
    """The first fault of each episode, where faults are contained."""


@final
class Methods:
    """The methods of a comparison.

    These are the expert, and the planner with each predictor, or alone if it uses no forecasts.
    Pickled methods are loaded again by the names of their runs.

    Attributes:
        all: the methods; the expert is the first. A method of several training runs has an item for
            each of them, one after the other.
        predictors: the predictors by the name of their run.
        settings: settings of all episodes.
    """

    def __init__(
        self,
        *,
        data: str,
        planner: str,
        predictors: Mapping[str, tuple[str, ...]],
        traffic: str | None,
        rules: str,
        horizon_s: float,
        dt_s: float,
        contain_faults: bool = False,
        budget_ms: float | None = None,
        measure_forecasts: bool = False,
    ) -> None:
        """Loads the planner and the predictors, but opens no data.

        Args:
            data: DATA, which determines the world.
            planner: name of the planner.
            predictors: names of the training runs of each predictor, by its name as given; see
                `asp_env.evaluation.selection.expand_runs`.
            traffic: drivers of the other agents; None for the default of the world.
            rules: name of the driving rules.
            horizon_s: horizon of forecasts and plans in seconds.
            dt_s: duration of a tick in seconds.
            contain_faults: as of `EpisodeSettings`.
            budget_ms: as of `EpisodeSettings`.
            measure_forecasts: as of `EpisodeSettings`. If the planner is the expert, the methods
                are then the forecasts of each predictor while it is replayed.

        Raises:
            AspEnvError: a name is unknown, something cannot be loaded, or the options do not fit.
        """
        self._options = {
            "data": data,
            "planner": planner,
            "predictors": predictors,
            "traffic": traffic,
            "rules": rules,
            "horizon_s": horizon_s,
            "dt_s": dt_s,
            "contain_faults": contain_faults,
            "budget_ms": budget_ms,
            "measure_forecasts": measure_forecasts,
        }
        world = world_class(data)
        self.settings = EpisodeSettings(
            traffic=make_traffic(traffic, dt_s=dt_s, default=world.traffic),
            rules=find_rules(rules),
            world=world,
            horizon=ticks(horizon_s, dt_s),
            history=ticks(HISTORY_S, dt_s),
            dt_s=dt_s,
            contain_faults=contain_faults,
            budget_ms=budget_ms,
            measure_forecasts=measure_forecasts,
        )
        chosen = load_planner(planner)
        runs = [run for names in predictors.values() for run in names]
        loaded = load_predictors(runs, horizon=self.settings.horizon, dt_s=dt_s)
        self.predictors: Mapping[str, Predictor] = dict(zip(runs, loaded, strict=True))
        if isinstance(chosen, TrainedPlanner):
            for each in loaded if chosen.uses_forecasts else []:
                chosen.check_predictor(each)
        alone = partial(Method, predictor=loaded[0], predictor_name="", run="")
        at_log = chosen.privileged and measure_forecasts
        methods = [] if at_log else [alone(planner=load_planner(EXPERT))]
        if chosen.uses_forecasts or at_log:
            methods += [
                Method(
                    planner=chosen,
                    predictor=self.predictors[run],
                    predictor_name=name,
                    run=run,
                )
                for name, names in predictors.items()
                for run in names
            ]
        elif not chosen.privileged:
            methods.append(alone(planner=chosen))
        self.all: tuple[Method, ...] = tuple(methods)

    @property
    def labels(self) -> list[str]:
        """A short name for every run of every method."""
        short = short_names([*self.predictors])
        return [
            " + ".join([method.planner.name, *([short[method.run]] if method.run else [])])
            for method in self.all
        ]

    def __reduce__(self) -> tuple[Any, ...]:
        return partial(Methods, **self._options), ()

    def drive(self, recordings: Recordings, unit: WorkUnit) -> EpisodeScores:
        """Drives the scenarios of a work unit and computes the metrics.

        Args:
            recordings: DATA.
            unit: the work unit.

        Raises:
            AspEnvError: the data do not suit a predictor or a driver.
        """
        method = self.all[unit.method]
        measured = self.settings.measure_forecasts and bool(method.run)
        settings = dataclasses.replace(self.settings, measure_forecasts=measured)
        with one_thread():
            driven = drive_episodes(
                recordings, unit.scenarios, method.planner, method.predictor, settings
            )
        metrics = driving_metrics(driven.drives, self.settings.rules)
        faulty = np.array([fault is not None for fault in driven.faults])
        contained = np.full(len(faulty), self.settings.contain_faults)
        return EpisodeScores(
            metrics={
                **metrics,
                **driven.realism,
                FALLBACK: driven.fallback,
                FAULTY: Masked(value=faulty.astype(np.float64), valid=contained),
                **driven.forecasts,
            },
            endings=tuple(Ending(kind) for kind in driven.endings.tolist()),
            rollouts=driven.rollouts,
            faults=driven.faults,
        )


def work_units(scenarios: ScenarioSet, methods: int) -> list[WorkUnit]:
    """All scenarios for every method, the longest first.

    Scenarios of similar length are in the same unit, because a unit takes as long as its longest
    episode. For each set of scenarios the unit of the expert, which is the fastest, is the last:
    short units at the end let processes finish at about the same time.

    Args:
        scenarios: all scenarios.
        methods: number of methods, with each run of a method of several runs.
    """
    order = np.argsort(-scenarios.length, kind="stable")
    chunks = np.array_split(order, -(-len(order) // EPISODES_AT_ONCE))
    return [
        WorkUnit(
            method=method, numbers=chunk, scenarios=tuple(scenarios[i] for i in chunk.tolist())
        )
        for chunk in chunks
        for method in reversed(range(methods))
    ]


@final
class ComparisonScores:
    """Scores of all methods in all scenarios, and the rollouts of the worst and most telling ones.

    A method of several training runs counts once for each of them. The worst scenarios have the
    lowest mean score over the methods. The expert counts only if it
    is the only method. The most telling scenarios are those in which one of the methods under test
    gains most over the reference, and those in which one loses most. Rules without a score use the
    product of three metrics instead: no collision, on road and progress.
    """

    def __init__(
        self,
        methods: int,
        rules: Rules,
        *,
        under_test: Sequence[int] = (),
        reference: int | None = None,
    ) -> None:
        """Creates an empty collection.

        Args:
            methods: number of methods.
            rules: the driving rules.
            under_test: indices of the methods that are compared with the reference.
            reference: index of the reference; None for no most telling scenarios.
        """
        self._methods = methods
        self._under_test = [*under_test]
        self._reference = reference
        self._gains: list[_Ranked] = []
        self._losses: list[_Ranked] = []
        self._ranked_by = ("score",) if rules.weights else ("no collision", "on road", "progress")
        self._incomplete: dict[int, dict[int, EpisodeScores]] = {}
        self._numbers: list[Int[np.ndarray, " b"]] = []
        self._complete: list[Sequence[EpisodeScores]] = []
        self._worst: list[_Ranked] = []

    def add(self, unit: WorkUnit, scores: EpisodeScores) -> None:
        """Adds the scores of a work unit; units may come in any order."""
        first = int(unit.numbers[0])
        by_method = self._incomplete.setdefault(first, {})
        by_method[unit.method] = scores
        if len(by_method) == self._methods:
            del self._incomplete[first]
            self._complete_unit(unit.numbers, [by_method[i] for i in range(self._methods)])

    def _complete_unit(
        self, numbers: Int[np.ndarray, " b"], by_method: Sequence[EpisodeScores]
    ) -> None:
        """Stores the scores of all methods in the same scenarios, and the rollouts to be saved."""
        products = np.stack(
            [
                np.prod([scores.metrics[name].value for name in self._ranked_by], axis=0)
                for scores in by_method
            ]
        )
        rollouts = [*zip(*(scores.rollouts for scores in by_method), strict=True)]
        means = products[min(1, self._methods - 1) :].mean(axis=0)
        self._worst = _lowest([*self._worst, *_ranked(means, numbers, rollouts)], SAVED_ROLLOUTS)
        if self._reference is not None and self._under_test:
            gains = products[self._under_test] - products[self._reference]
            up = _ranked(-gains.max(axis=0), numbers, rollouts)
            down = _ranked(gains.min(axis=0), numbers, rollouts)
            self._gains = _lowest([*self._gains, *_below_zero(up)], TELLING_ROLLOUTS)
            self._losses = _lowest([*self._losses, *_below_zero(down)], TELLING_ROLLOUTS)
        self._numbers.append(numbers)
        self._complete.append([dataclasses.replace(scores, rollouts=()) for scores in by_method])

    @property
    def saved(self) -> list[int]:
        """Indices of the scenarios whose rollouts are stored.

        The worst are first, then those with the largest gains, then those with the largest losses.
        """
        return [*self._saved()]

    def _saved(self) -> dict[int, tuple[Rollout, ...]]:
        """The stored rollouts of all methods by the index of their scenario."""
        ranked = (*self._worst, *self._gains, *self._losses)
        return {number: rollouts for _, number, rollouts in ranked}

    def of(self, method: int) -> EpisodeScores:
        """Scores of a method in all scenarios, in their order, with the rollouts of `saved`."""
        parts = [by_method[method] for by_method in self._complete]
        return dataclasses.replace(
            joined_scores([*zip(self._numbers, parts, strict=True)]),
            rollouts=tuple(rollouts[method] for rollouts in self._saved().values()),
        )


def joined_scores(
    parts: Sequence[tuple[Int[np.ndarray, " _"], EpisodeScores]],
) -> EpisodeScores:
    """The scores of one method in several work units, in the order of the scenarios.

    Args:
        parts: the indices of the scenarios of each unit, and their scores; rollouts are left out.
    """
    order = np.argsort(np.concatenate([numbers for numbers, _ in parts]))
    endings = [ending for _, scores in parts for ending in scores.endings]
    faults = [fault for _, scores in parts for fault in scores.faults]
    return EpisodeScores(
        metrics={
            name: Masked(
                value=np.concatenate([scores.metrics[name].value for _, scores in parts])[order],
                valid=np.concatenate([scores.metrics[name].valid for _, scores in parts])[order],
            )
            for name in parts[0][1].metrics
        },
        endings=tuple(endings[i] for i in order.tolist()),
        faults=tuple(faults[i] for i in order.tolist()),
        rollouts=(),
    )


_Ranked = tuple[float, int, tuple[Rollout, ...]]
"""A value by which scenarios are ranked, the index of a scenario, its rollouts by method."""


def _ranked(
    values: Float[np.ndarray, " b"],
    numbers: Int[np.ndarray, " b"],
    rollouts: Sequence[tuple[Rollout, ...]],
) -> list[_Ranked]:
    return [*zip(values.tolist(), numbers.tolist(), rollouts, strict=True)]


def _lowest(ranked: Sequence[_Ranked], count: int) -> list[_Ranked]:
    return sorted(ranked, key=lambda each: each[:2])[:count]


def _below_zero(ranked: Sequence[_Ranked]) -> list[_Ranked]:
    return [each for each in ranked if each[0] < 0]
