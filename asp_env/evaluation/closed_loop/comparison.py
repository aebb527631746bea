"""The drives of a comparison in units that do not depend on each other, in any process."""

import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, final

import numpy as np
from jaxtyping import Int

from asp_env.data.predictor import Predictor
from asp_env.data.recording import ticks
from asp_env.data.rollout import Rollout
from asp_env.data.scenarios.scenario import Scenario, ScenarioSet
from asp_env.data.snippets import HISTORY_S
from asp_env.data.source import Recordings
from asp_env.evaluation.closed_loop.episodes import drive_episodes
from asp_env.evaluation.selection import load_predictors
from asp_env.metrics.driving.rules import Rules, find_rules
from asp_env.metrics.driving.scores import driving_metrics
from asp_env.metrics.masked import Masked
from asp_env.planning.planner import Planner, load_planner
from asp_env.sim.traffic.assignment import make_traffic
from asp_env.sim.world import Ending, world_class

EPISODES_AT_ONCE = 16
"""A second or a few of work, so that processes end together; more at once saves no time."""

SAVED_ROLLOUTS = 6
"""So many scenarios' rollouts are kept to look at, of every driver."""

EXPERT = "expert"


@dataclass(frozen=True, slots=True, kw_only=True)
class Method:
    """Who drives the ego, and whom it asks what the others will do."""

    planner: Planner
    name: str
    """Of the predictor; empty where none takes part."""
    predictor: Predictor


@dataclass(frozen=True, slots=True, kw_only=True)
class WorkUnit:
    """Scenarios that one entrant drives side by side."""

    entrant: int
    numbers: Int[np.ndarray, " b"]
    """Of the scenarios, among all."""
    scenarios: tuple[Scenario, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class EpisodeScores:
    """What came of a unit."""

    metrics: Mapping[str, Masked]
    endings: tuple[Ending, ...]
    rollouts: tuple[Rollout, ...]


@final
class Methods:
    """The expert, and the planner with each predictor or, if it asks none, alone.

    All are made by their names, and so are copies in other processes.
    """

    def __init__(
        self,
        data: str,
        planner: str,
        predictors: tuple[str, ...],
        traffic: str | None,
        metrics: str,
        horizon_s: float,
        dt_s: float,
    ) -> None:
        """Loads them, as the fields of `Drive` name them; opens no data.

        Raises:
            AspEnvError: something is unknown, cannot be loaded, or does not fit.
        """
        self._names = (data, planner, predictors, traffic, metrics, horizon_s, dt_s)
        self._kind = world_class(data)
        self._traffic = make_traffic(traffic, dt_s=dt_s, default=self._kind.traffic)
        self.preset: Rules = find_rules(metrics)
        self.dt_s = dt_s
        self._horizon, self.history = ticks(horizon_s, dt_s), ticks(HISTORY_S, dt_s)
        driver = load_planner(planner)
        loaded = load_predictors(predictors, horizon=self._horizon, dt_s=dt_s)
        self.predictors: Mapping[str, Predictor] = dict(zip(predictors, loaded, strict=True))
        found = [Method(planner=load_planner(EXPERT), name="", predictor=loaded[0])]
        if driver.uses_forecasts:
            found += [
                Method(planner=driver, name=name, predictor=predictor)
                for name, predictor in self.predictors.items()
            ]
        elif not driver.privileged:
            found.append(Method(planner=driver, name="", predictor=loaded[0]))
        self.all: tuple[Method, ...] = tuple(found)

    def __reduce__(self) -> tuple[Any, ...]:
        """Loads everything anew."""
        return Methods, self._names

    def drive(self, recordings: Recordings, unit: WorkUnit) -> EpisodeScores:
        """Drives the scenarios of a unit, and judges it.

        Raises:
            AspEnvError: the data do not suit a predictor or a driver.
        """
        entrant = self.all[unit.entrant]
        with _one_thread():
            driven = drive_episodes(
                recordings,
                unit.scenarios,
                entrant.planner,
                entrant.predictor,
                preset=self.preset,
                traffic=self._traffic,
                kind=self._kind,
                horizon=self._horizon,
                history=self.history,
                dt_s=self.dt_s,
            )
        return EpisodeScores(
            metrics={**driving_metrics(driven.drives, self.preset), **driven.realism},
            endings=tuple(Ending(kind) for kind in driven.endings.tolist()),
            rollouts=driven.rollouts,
        )


@contextmanager
def _one_thread() -> Iterator[None]:
    """Networks run on one thread, whose sums are the same whatever the number of cores."""
    torch = sys.modules.get("torch")
    if torch is None:
        yield
        return
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def work_units(scenarios: ScenarioSet, entrants: int) -> list[WorkUnit]:
    """All scenarios for every entrant: the longest together and first, the expert's last of each.

    Episodes side by side all go on until the last has ended, and short units at the end let
    processes end together. They depend on nothing else, and so neither do the results.
    """
    order = np.argsort(-scenarios.length, kind="stable")
    chunks = np.array_split(order, -(-len(order) // EPISODES_AT_ONCE))
    return [
        WorkUnit(
            entrant=entrant, numbers=chunk, scenarios=tuple(scenarios[i] for i in chunk.tolist())
        )
        for chunk in chunks
        for entrant in reversed(range(entrants))
    ]


@final
class ComparisonScores:
    """What came of all units; of the rollouts, those of the worst scenarios."""

    def __init__(self, entrants: int, preset: Rules) -> None:
        """Of none yet.

        Args:
            entrants: how many.
            preset: its score tells the worst scenarios, those with the lowest mean over entrants;
                the expert's counts only where it is alone. A preset without a score has the product
                of progress, on the road and no collision instead.
        """
        self._entrants = entrants
        self._judged_by = ("score",) if preset.weights else ("no collision", "on road", "progress")
        self._open: dict[int, dict[int, EpisodeScores]] = {}
        self._numbers: list[Int[np.ndarray, " b"]] = []
        self._closed: list[Sequence[EpisodeScores]] = []
        self._worst: list[tuple[float, int, tuple[Rollout, ...]]] = []

    def add(self, unit: WorkUnit, outcome: EpisodeScores) -> None:
        """Takes what came of a unit, in any order."""
        first = int(unit.numbers[0])
        found = self._open.setdefault(first, {})
        found[unit.entrant] = outcome
        if len(found) == self._entrants:
            del self._open[first]
            self._close(unit.numbers, [found[entrant] for entrant in range(self._entrants)])

    def _close(self, numbers: Int[np.ndarray, " b"], found: Sequence[EpisodeScores]) -> None:
        """Keeps what is needed of the same scenarios driven by all."""
        products = [
            np.prod([outcome.metrics[name].value for name in self._judged_by], axis=0)
            for outcome in found[1:] or found
        ]
        scores = np.mean(products, axis=0).tolist()
        rollouts = zip(*(outcome.rollouts for outcome in found), strict=True)
        these = zip(scores, numbers.tolist(), rollouts, strict=True)
        worst = sorted([*self._worst, *these], key=lambda each: each[:2])
        self._worst = worst[:SAVED_ROLLOUTS]
        self._numbers.append(numbers)
        self._closed.append(
            [
                EpisodeScores(metrics=each.metrics, endings=each.endings, rollouts=())
                for each in found
            ]
        )

    @property
    def worst(self) -> list[int]:
        """Numbers of the scenarios whose rollouts are kept, the worst first."""
        return [number for _, number, _ in self._worst]

    def of(self, entrant: int) -> EpisodeScores:
        """Of all scenarios in their order, with the rollouts of the worst."""
        order = np.argsort(np.concatenate(self._numbers))
        parts = [found[entrant] for found in self._closed]
        endings = [ending for part in parts for ending in part.endings]
        return EpisodeScores(
            metrics={
                name: Masked(
                    value=np.concatenate([part.metrics[name].value for part in parts])[order],
                    valid=np.concatenate([part.metrics[name].valid for part in parts])[order],
                )
                for name in parts[0].metrics
            },
            endings=tuple(endings[i] for i in order.tolist()),
            rollouts=tuple(rollouts[entrant] for _, _, rollouts in self._worst),
        )
