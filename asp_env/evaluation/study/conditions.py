"""The conditions of a study, and the methods that drive in each of them."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from asp_env.data.predictor import Predictor
from asp_env.data.recording import ticks
from asp_env.data.scenarios.scenario import ScenarioSet
from asp_env.data.snippets import HISTORY_S
from asp_env.data.source import Recordings, open_readable, source_folder
from asp_env.errors import AspEnvError
from asp_env.evaluation.closed_loop.benchmark import FROZEN, parse_method
from asp_env.evaluation.closed_loop.comparison import EXPERT, Methods, WorkUnit, work_units
from asp_env.evaluation.hard import select_scenarios
from asp_env.evaluation.ladder import ORACLE, missing_controls
from asp_env.evaluation.results import Condition
from asp_env.evaluation.selection import (
    expand_runs,
    load_predictors,
    no_data_error,
    ticks_to_evaluate,
)
from asp_env.evaluation.study.cells import key_of
from asp_env.evaluation.study.identity import (
    CORE,
    identity,
    package_hash,
    registered_code,
    versions,
)
from asp_env.evaluation.study.settings import StudySettings
from asp_env.metrics.driving.rules import find_rules
from asp_env.planning.planner import load_planner
from asp_env.sim.traffic.log import LogDriver
from asp_env.sim.world import world_class

BLIND = "blind"
"""Name of the predictor that forecasts all agents far away, whose errors state nothing."""

DELAYED = "delayed"
"""Name of the predictor that states what another one forecast some ticks ago."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Group:
    """A planner with its predictors in one condition.

    If the planner is the expert, it is replayed while each predictor forecasts.
    """

    condition: Condition
    planner: str
    runs: Mapping[str, tuple[str, ...]]
    """Training runs of each predictor by its name as given; late by the condition's latency."""
    uses_forecasts: bool
    options: Mapping[str, Any]
    """Arguments of `Methods`."""

    @property
    def is_static(self) -> bool:
        """Whether the expert is replayed, so that forecasts are of logged states."""
        return self.planner == EXPERT

    def methods(self) -> Methods:
        """Loads the planner and the predictors.

        Raises:
            AspEnvError: something cannot be loaded, or the options do not fit.
        """
        return Methods(**self.options)


@dataclass(frozen=True, slots=True, kw_only=True)
class DataSet:
    """One DATA of a study and the scenarios that are driven in it."""

    recordings: Recordings
    scenarios: ScenarioSet
    part: str
    """Which part of DATA the scenarios are from."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Cell:
    """A work unit of one method in one condition, and the key that its result is stored under."""

    key: str
    group: int
    """Index of the group."""
    unit: WorkUnit


def make_groups(settings: StudySettings) -> list[Group]:
    """All groups of a study, in the order of DATA, traffic, latency and planners.

    Planners without forecasts drive without latency only.

    Args:
        settings: the settings.

    Raises:
        AspEnvError: a name is unknown, or a method is not a planner with a predictor.
    """
    find_rules(settings.rules)  # raises an error before the traffic of a suite is made
    named: dict[str, list[str]] = {}
    for method in settings.methods:
        planner, predictor = parse_method(method)
        named.setdefault(planner, []).extend([predictor] if predictor else [])
    groups = []
    for data in settings.data:
        world = world_class(data)
        for traffic in settings.traffic or (world.traffic,):
            for latency in settings.latency_ticks:
                condition = Condition(data=data, traffic=traffic, latency_ticks=latency)
                groups += [
                    group
                    for planner, predictors in named.items()
                    if (group := _group(settings, condition, planner, predictors)) is not None
                ]
        groups += _static_groups(settings, data, groups)
    if not groups:
        raise AspEnvError(
            f"study: no method uses forecasts, and without forecasts there is nothing to be late "
            f"by {', '.join(map(str, settings.latency_ticks))} ticks; add 0 to latency_ticks, or a "
            "method PLANNER+PREDICTOR"
        )
    return groups


def _static_groups(settings: StudySettings, data: str, groups: Sequence[Group]) -> list[Group]:
    """Groups in which the expert is replayed and all predictors of DATA forecast, by latency."""
    found = []
    for latency in settings.latency_ticks:
        condition = Condition(data=data, traffic=world_class(data).traffic, latency_ticks=latency)
        runs = {
            name: each
            for group in groups
            if group.condition.data == data
            and group.condition.latency_ticks == latency
            and group.uses_forecasts
            for name, each in group.runs.items()
            if name != BLIND
        }
        if runs:
            found.append(_make_group(settings, condition, EXPERT, runs))
    return found


def _group(
    settings: StudySettings, condition: Condition, planner: str, predictors: Sequence[str]
) -> Group | None:
    """A group; None for a planner without forecasts in a condition with latency."""
    uses_forecasts = load_planner(planner).uses_forecasts
    if uses_forecasts != bool(predictors):
        wanted = f"{planner}+PREDICTOR" if uses_forecasts else f"{planner} alone"
        raise AspEnvError(f"planner {planner}: expected the method {wanted}")
    if not uses_forecasts and condition.latency_ticks:
        return None
    wanted = [*predictors] if uses_forecasts else [settings.reference]
    if uses_forecasts:
        ladder = condition.traffic == LogDriver.name and not condition.latency_ticks
        more = missing_controls(wanted) if settings.controls and ladder else (ORACLE,)
        wanted += [each for each in (settings.reference, *more) if each not in wanted]
    wanted = list(dict.fromkeys(wanted))
    runs = {
        name: tuple(f"{late_prefix(condition.latency_ticks)}{run}" for run in each)
        for name, each in expand_runs(wanted).items()
    }
    return _make_group(settings, condition, planner, runs, uses_forecasts=uses_forecasts)


def _make_group(
    settings: StudySettings,
    condition: Condition,
    planner: str,
    runs: Mapping[str, tuple[str, ...]],
    *,
    uses_forecasts: bool = False,
) -> Group:
    return Group(
        condition=condition,
        planner=planner,
        runs=runs,
        uses_forecasts=uses_forecasts,
        options={
            "data": condition.data,
            "planner": planner,
            "predictors": runs,
            "traffic": condition.traffic,
            "rules": settings.rules,
            "horizon_s": settings.horizon_s,
            "dt_s": settings.dt_s,
            "contain_faults": True,
            "budget_ms": settings.budget_ms,
            "measure_forecasts": True,
        },
    )


def late_prefix(latency_ticks: int) -> str:
    """What the name of a predictor starts with that is late by some ticks."""
    return f"{DELAYED}:{latency_ticks}:" if latency_ticks else ""


def open_data_sets(settings: StudySettings, groups: Sequence[Group]) -> dict[str, DataSet]:
    """Opens all DATA and chooses the scenarios, which are the same for all methods.

    Args:
        settings: the settings.
        groups: all groups; scenarios are from what none of their predictors was trained on.

    Raises:
        AspEnvError: data cannot be read, or no scenario matches.
    """
    names = dict.fromkeys(
        run
        for group in groups
        if not group.condition.latency_ticks
        for each in group.runs.values()
        for run in each
    ) or dict.fromkeys(run for group in groups for each in group.runs.values() for run in each)
    horizon = ticks(settings.horizon_s, settings.dt_s)
    predictors = load_predictors([*names], horizon=horizon, dt_s=settings.dt_s)
    return {data: _data_set(settings, data, predictors) for data in settings.data}


def _data_set(settings: StudySettings, data: str, predictors: Sequence[Predictor]) -> DataSet:
    recordings = open_readable(data, dt_s=settings.dt_s)
    allowed, part = ticks_to_evaluate(recordings, predictors, settings.part, dt_s=settings.dt_s)
    frozen = source_folder(data) / FROZEN
    selection = settings.scenarios or (str(frozen) if frozen.is_file() else "")
    chosen = select_scenarios(
        recordings,
        selection,
        dt_s=settings.dt_s,
        history=ticks(HISTORY_S, settings.dt_s),
        allowed=allowed,
    )
    if not len(chosen):
        raise no_data_error("scenario")
    if settings.max_scenarios is not None:
        chosen = chosen.evenly_spaced(settings.max_scenarios)
    return DataSet(recordings=recordings, scenarios=chosen, part=part)


def make_cells(
    groups: Sequence[Group], loaded: Sequence[Methods], data_sets: Mapping[str, DataSet]
) -> list[Cell]:
    """All cells of a study; those of one group are next to each other.

    Cells of the expert, and of other methods that do not differ between groups, have the same key.

    Args:
        groups: the groups.
        loaded: the methods of each group.
        data_sets: DATA by name.
    """
    shared = {
        "versions": versions(),
        "code": package_hash(CORE),
        "readers' and views' code": registered_code("readers", "views"),
    }
    hashes = {name: each.recordings.hashes() for name, each in data_sets.items()}
    cells = []
    for number, group in enumerate(groups):
        methods = loaded[number]
        data = group.condition.data
        world = methods.settings.world
        common = {
            **shared,
            "world": f"{world.__module__}.{world.__qualname__}",
            "world's code": package_hash(world.__module__.partition(".")[0]),
            "traffic": group.condition.traffic,
            "traffic's": identity(group.condition.traffic, ("drivers", "predictors")),
            "rules": methods.settings.rules.label,
            "horizon": methods.settings.horizon,
            "history": methods.settings.history,
            "dt_s": methods.settings.dt_s,
            "budget_ms": methods.settings.budget_ms,
        }
        by_method = [
            {
                "planner": method.planner.name,
                "planner's": identity(method.planner.name, ("planners",)),
                "predictor": method.run,
                "predictor's": identity(method.run, ("predictors",)),
            }
            for method in methods.all
        ]
        for unit in work_units(data_sets[data].scenarios, len(methods.all)):
            scenarios = [
                [
                    hashes[data][each.recording],
                    each.ego_id,
                    each.start_tick,
                    each.length,
                    each.seed,
                ]
                for each in unit.scenarios
            ]
            key = key_of({**common, **by_method[unit.method], "scenarios": scenarios})
            cells.append(Cell(key=key, group=number, unit=unit))
    return cells
