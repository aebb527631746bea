"""`asp-env drive`: a planner drives the ego with the forecasts of each predictor in turn."""

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, replace
from functools import partial
from itertools import product
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tyro
from rich.console import Console
from rich.progress import Progress

from asp_env.data.recording import DEFAULT_DT_S
from asp_env.data.road_map import RoadMap
from asp_env.data.rollout import Rollout
from asp_env.data.scenarios.scenario import ScenarioSet
from asp_env.data.scenarios.selection import save_scenarios
from asp_env.data.scenarios.tags import TAGS
from asp_env.data.source import Recordings, open_data
from asp_env.errors import AspEnvError
from asp_env.evaluation import statistics
from asp_env.evaluation.closed_loop.comparison import (
    EXPERT,
    ComparisonScores,
    EpisodeScores,
    Method,
    Methods,
    WorkUnit,
    work_units,
)
from asp_env.evaluation.hard import HARD_NOTE, is_hard, select_scenarios
from asp_env.evaluation.report import check_report_possible, write_report
from asp_env.evaluation.results import Row, write_manifest, write_metrics
from asp_env.evaluation.selection import PartChoice, no_data_error, short_names, ticks_to_evaluate
from asp_env.evaluation.tables import driving_table
from asp_env.files import atomic_folder
from asp_env.metrics.driving.rules import DEFAULT_RULES, RULES, Rules
from asp_env.metrics.masked import Masked
from asp_env.sim.world import world_class
from asp_env.workers import WorkerPool

REFERENCE = "constant-velocity"
"""If this predictor takes part, the scores of all other methods are also stated as differences to
the score with it, paired by scenario."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Drive:
    """Drive in closed loop: compare how well a planner drives with each predictor."""

    data: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="DATA")]
    """Folder in the inD/rounD or INTERACTION layout, or sample:…, synthetic:… or highway:…."""
    out: Path
    """Folder to write; it must not exist, or be empty."""
    planner: str = "sampling"
    """Planner that drives the ego."""
    predictors: Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME[:RUN] …")] = (
        "constant-velocity",
    )
    """Predictors by name; trained ones with their run folder. Each is compared."""
    traffic: str | None = None
    """Driver of all other agents: log, log-actions, idm, hybrid,
    predictor:NAME, or a table such as default=idm,truck=log.
    The default is log for recordings and own for highway:…."""
    scenarios: Annotated[str, tyro.conf.arg(metavar="FILTER|FILE")] = ""
    """Tags and comparisons, such as 'left,!stopping,length>=8',
    or the scenarios.json of another run. The default is all;
    hard are interactive ones in which constant velocity fails."""
    max_scenarios: int | None = None
    """Largest number of scenarios; they are chosen at even spacing."""
    horizon: float = 3.0
    """Horizon of forecasts and plans in seconds."""
    dt: float = DEFAULT_DT_S
    """Duration of a tick in seconds."""
    part: PartChoice = "auto"
    """Part of DATA; auto is all of it that no predictor was
    trained or selected on."""
    rules: str = DEFAULT_RULES
    """Driving rules that define the metrics: nuplan, pdms, waymax or strict."""
    jobs: int = 1
    """Number of processes that drive. The results do not depend on it."""

    def run(self) -> None:
        """Drives, writes the folder and prints the table.

        Raises:
            AspEnvError: an option or the data are bad, or a package is missing.
        """
        check_report_possible()
        note = HARD_NOTE if is_hard(self.scenarios) else ""
        if note:
            Console().print(note)
        with atomic_folder(self.out) as folder:
            result = drive(self)
            write_metrics(folder, result.rows)
            write_manifest(folder, "drive", **result.manifest)
            save_scenarios(folder / "scenarios.json", result.scenarios, result.recordings)
            save_rollouts(folder, result)
            title = f"Driving on {Path(self.data).name}"
            write_report(folder, title=title, lead=note, maps=result.maps)
        console = Console()
        shown = RULES[self.rules].shown
        console.print(driving_table(result.rows, result.manifest["privileged"], shown))
        console.print(f"wrote {self.out}/report.html")


@dataclass(frozen=True, slots=True, kw_only=True)
class ClosedLoopResult:
    """Result of `drive`."""

    rows: list[Row]
    """Lines of `metrics.csv`."""
    manifest: dict[str, Any]
    rollouts: Mapping[str, tuple[Rollout, ...]]
    """Rollouts of the worst scenarios, by method; the scenarios are the same for all methods."""
    maps: dict[str, RoadMap]
    """Maps of the rollouts by recording name."""
    scenarios: ScenarioSet
    """All scenarios that were driven."""
    recordings: Recordings


def drive(config: Drive) -> ClosedLoopResult:
    """Drives all scenarios with the expert and with every other method; writes nothing.

    Raises:
        AspEnvError: an option or the data are bad, or a worker process ended.
    """
    if config.jobs < 1:
        raise AspEnvError(f"--jobs {config.jobs}: expected at least 1 process")
    config = replace(config, traffic=config.traffic or world_class(config.data).traffic)
    methods = Methods(  # raises errors before anything is computed
        data=config.data,
        planner=config.planner,
        predictors=config.predictors,
        traffic=config.traffic,
        rules=config.rules,
        horizon_s=config.horizon,
        dt_s=config.dt,
    )
    recordings = open_data(config.data)
    run_unit = partial(methods.drive, recordings)
    with WorkerPool(run_unit, config.jobs) if config.jobs > 1 else nullcontext() as pool:
        chosen, part = _choose_scenarios(config, recordings, methods)
        scores = _drive_all(pool, run_unit, chosen, methods)
    by_method = [(method, scores.of(number)) for number, method in enumerate(methods.all)]
    short = short_names(config.predictors)
    labels = [
        f"{method.planner.name} + {short[method.predictor_name]}"
        if method.predictor_name
        else method.planner.name
        for method in methods.all
    ]
    rules, predictors = methods.settings.rules, methods.predictors
    worst = [chosen[number] for number in scores.worst]
    return ClosedLoopResult(
        rows=_rows(config, rules, by_method, chosen),
        manifest={
            "data": config.data,
            "data_hash": recordings.data_hash(),
            "planner": config.planner,
            "predictors": {name: dict(p.metadata) for name, p in predictors.items()},
            "privileged": [
                EXPERT,
                *(name for name, p in predictors.items() if p.privileged),
            ],
            "traffic": config.traffic,
            "metrics": {"preset": rules.name, "version": rules.version, "about": rules.description},
            "horizon_s": config.horizon,
            "dt_s": config.dt,
            "part": part,
            **({"note": HARD_NOTE} if is_hard(config.scenarios) else {}),
            "asked for": {"scenarios": config.scenarios, "max_scenarios": config.max_scenarios},
            "scenarios": {scenario.name: {"seed": scenario.seed} for scenario in chosen},
            "endings": {
                label: dict(Counter(kind.name for kind in each.endings))
                for label, (_, each) in zip(labels, by_method, strict=True)
            },
            "intervals": "95 %, bootstrap over recordings",
        },
        rollouts={label: each.rollouts for label, (_, each) in zip(labels, by_method, strict=True)},
        maps={each.recording_name: recordings[each.recording].road_map for each in worst},
        scenarios=chosen,
        recordings=recordings,
    )


def _choose_scenarios(
    config: Drive, recordings: Recordings, methods: Methods
) -> tuple[ScenarioSet, str]:
    """The scenarios to drive, and a description of the part of the data that they are from."""
    allowed, part = ticks_to_evaluate(
        recordings, [*methods.predictors.values()], config.part, dt_s=config.dt
    )
    chosen = select_scenarios(
        recordings,
        config.scenarios,
        dt_s=config.dt,
        history=methods.settings.history,
        allowed=allowed,
    )
    if not len(chosen):
        raise no_data_error("scenario")
    if config.max_scenarios is not None:
        chosen = chosen.evenly_spaced(config.max_scenarios)
    return chosen, part


def _drive_all(
    pool: WorkerPool[WorkUnit, EpisodeScores] | None,
    run_unit: Callable[[WorkUnit], EpisodeScores],
    scenarios: ScenarioSet,
    methods: Methods,
) -> ComparisonScores:
    """Drives all work units in the processes of the pool, or without one in this process."""
    units = work_units(scenarios, len(methods.all))
    scores = ComparisonScores(len(methods.all), methods.settings.rules)
    with Progress(transient=True) as progress:
        task = progress.add_task("driving", total=len(methods.all) * len(scenarios))
        found = pool.map(units) if pool is not None else map(run_unit, units)
        for unit, unit_scores in zip(units, found, strict=True):
            scores.add(unit, unit_scores)
            progress.advance(task, len(unit.numbers))
    return scores


def _rows(
    config: Drive,
    rules: Rules,
    by_method: Sequence[tuple[Method, EpisodeScores]],
    scenarios: ScenarioSet,
) -> list[Row]:
    """Rows of every method, for all scenarios and for those with each tag."""
    reference = next(
        (scores for method, scores in by_method if method.predictor_name == REFERENCE), None
    )
    rows = []
    for method, scores in by_method:
        values = dict(scores.metrics)
        if rules.weights and reference is not None and scores is not reference:
            score = scores.metrics["score"]
            gain = score.value - reference.metrics["score"].value
            values[f"score - {REFERENCE}"] = Masked(value=gain, valid=score.valid)
        rows += _method_rows(config, rules, method, values, scenarios)
    return rows


def _method_rows(
    config: Drive,
    rules: Rules,
    method: Method,
    values: Mapping[str, Masked],
    scenarios: ScenarioSet,
) -> list[Row]:
    metadata = method.predictor.metadata if method.predictor_name else {}
    subsets = {"all": np.ones(len(scenarios), dtype=bool)}
    subsets |= {tag: scenarios.has(tag) for tag in TAGS}
    rows = []
    for (subset, member), (metric, masked) in product(subsets.items(), values.items()):
        counted = masked.valid & member
        if not counted.any():
            continue
        estimate = statistics.mean(masked.value[counted], scenarios.recording[counted])
        rows.append(
            Row(
                data=config.data,
                predictor=method.predictor_name,
                trained_on=metadata.get("trained_on", ""),
                view=metadata.get("view", ""),
                recipe=metadata.get("preset", ""),
                planner=method.planner.name,
                traffic=config.traffic or "",
                latency_ticks=0,
                horizon_s=config.horizon,
                rules=rules.label,
                subset=subset,
                metric=metric,
                value=estimate.value,
                low=estimate.low,
                high=estimate.high,
                n=estimate.n,
            )
        )
    return rows


def save_rollouts(folder: Path, result: ClosedLoopResult) -> None:
    """Writes `rollouts/METHOD/SCENARIO.npz` into a folder."""
    for method, rollouts in result.rollouts.items():
        into = folder / "rollouts" / method
        into.mkdir(parents=True)
        for rollout in rollouts:
            rollout.save(into / f"{rollout.scenario.name}.npz")
