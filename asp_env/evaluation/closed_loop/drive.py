"""`asp-env drive`: a planner drives the ego with the forecasts of each predictor in turn."""

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import tyro
from rich.progress import Progress

from asp_env.arguments import check_jobs, check_max_scenarios
from asp_env.console import text_console
from asp_env.data.recording import DEFAULT_DT_S
from asp_env.data.road_map import RoadMap
from asp_env.data.rollout import Rollout
from asp_env.data.scenarios.scenario import ScenarioSet
from asp_env.data.scenarios.selection import save_scenarios
from asp_env.data.source import Recordings, open_readable
from asp_env.errors import AspEnvError
from asp_env.evaluation.closed_loop.comparison import (
    EXPERT,
    ComparisonScores,
    EpisodeScores,
    Methods,
    WorkUnit,
    work_units,
)
from asp_env.evaluation.closed_loop.scenario_table import DrivenScenarios, write_scenario_table
from asp_env.evaluation.closed_loop.summary import (
    Comparison,
    MethodScores,
    comparison_rows,
    scores_by_method,
)
from asp_env.evaluation.closed_loop.tidy_table import check_parquet_possible, write_tidy_table
from asp_env.evaluation.hard import HARD_NOTE, is_hard, select_scenarios
from asp_env.evaluation.ladder import BASELINE, is_under_test, missing_controls
from asp_env.evaluation.report import check_report_possible, write_report
from asp_env.evaluation.results import (
    SCORE,
    Condition,
    Row,
    fallback_sentences,
    fallback_shares,
    write_manifest,
    write_metrics,
)
from asp_env.evaluation.selection import (
    PartChoice,
    expand_runs,
    no_data_error,
    ticks_to_evaluate,
    with_fallback,
)
from asp_env.evaluation.tables import driving_tables, headlines
from asp_env.files import atomic_folder
from asp_env.metrics.driving.rules import DEFAULT_RULES, RULES, Rules
from asp_env.sim.traffic.log import LogDriver
from asp_env.sim.world import world_class
from asp_env.workers import WorkerPool


@dataclass(frozen=True, slots=True, kw_only=True)
class Drive:
    """Drive in closed loop: compare how well a planner drives with each predictor."""

    data: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="DATA")]
    """Folder in the inD/rounD or INTERACTION layout, or sample:…, synthetic:… or highway:…."""
    out: Path
    """Folder to write; it must not exist, or be empty."""
    planner: str = "contingency"
    """Planner that drives the ego."""
    predictors: Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME[:RUN] …")] = (
        "constant-velocity",
    )
    """Predictors by name; trained ones with their run folder. Each is compared.
    A pattern in quotes, such as 'ffw-asp:runs/*', is one method of several runs."""
    controls: bool = False
    """Add the controls, against which methods are calibrated: blind,
    constant-velocity, blend:0.25, blend:0.5, blend:0.75 and oracle."""
    reference: Annotated[str | None, tyro.conf.arg(metavar="NAME[:RUN]")] = None
    """One of the predictors, to which differences are stated.
    The default is constant-velocity, if it takes part."""
    traffic: str | None = None
    """Driver of all other agents: log, log-actions, idm, hybrid,
    predictor:NAME, or a table such as default=idm,truck=log.
    The default is log for recordings and own for highway:…."""
    scenarios: Annotated[str, tyro.conf.arg(metavar="FILTER|FILE")] = ""
    """Tags and comparisons, such as 'left,!stopping,length>=8',
    or the scenarios.json of another run, or scenarios.json#NAME
    for one scenario of it. The default is all;
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
    """Driving rules that define the metrics: nuplan, pdms, waymax, strict or graded."""
    fallback: bool = False
    """Guard every trained predictor: where a scene lies outside
    of what it learned, its forecast is blended to constant
    velocity. As naming it guarded:NAME:RUN."""
    parquet: bool = False
    """Also write scenarios.parquet, with a row per scenario, method, run and
    metric; needs the extra parquet."""
    jobs: int = 1
    """Number of processes that drive. The results do not depend on it."""

    def run(self) -> None:
        """Drives, writes the folder and prints the table.

        Raises:
            AspEnvError: an option or the data are bad, or a package is missing.
        """
        check_report_possible()
        if self.parquet:
            check_parquet_possible()
        note = HARD_NOTE if is_hard(self.scenarios) else ""
        if note:
            text_console().print(note)
        with atomic_folder(self.out) as folder:
            result = drive(self)
            write_metrics(folder, result.rows)
            write_manifest(folder, "drive", **result.manifest)
            save_scenarios(folder / "scenarios.json", result.scenarios, result.recordings)
            write_scenario_table(folder, [result.driven])
            if self.parquet:
                write_tidy_table(folder, [result.driven])
            save_rollouts(folder, result)
            title = f"Driving on {Path(self.data).name}"
            write_report(folder, title=title, lead=note, maps=result.maps)
        console = text_console()
        shown = RULES[self.rules].shown
        for table in driving_tables(result.rows, result.manifest["privileged"], shown):
            console.print(table)
        for sentence in headlines(result.rows, result.manifest["privileged"]):
            console.print(sentence)
        for sentence in fallback_sentences(result.manifest["fallback"], "forecasts"):
            console.print(sentence)
        console.print(f"wrote {self.out}/report.html")


@dataclass(frozen=True, slots=True, kw_only=True)
class ClosedLoopResult:
    """Result of `drive`."""

    rows: list[Row]
    """Lines of `metrics.csv`."""
    methods: list[MethodScores]
    """Scores of all methods in every scenario; the expert is the first."""
    manifest: dict[str, Any]
    rollouts: Mapping[str, tuple[Rollout, ...]]
    """Rollouts of the worst and the most telling scenarios, by method; the scenarios are the same
    for all methods."""
    maps: dict[str, RoadMap]
    """Maps of the rollouts by recording name."""
    scenarios: ScenarioSet
    """All scenarios that were driven."""
    recordings: Recordings

    @property
    def driven(self) -> DrivenScenarios:
        """The scenarios with the scores of all methods."""
        return DrivenScenarios(
            condition=Condition(data=self.manifest["data"], traffic=self.manifest["traffic"]),
            scenarios=self.scenarios,
            methods=self.methods,
        )


def drive(config: Drive) -> ClosedLoopResult:
    """Drives all scenarios with the expert and with every other method; writes nothing.

    Raises:
        AspEnvError: an option or the data are bad, or a worker process ended.
    """
    check_jobs(config.jobs)
    check_max_scenarios(config.max_scenarios)
    config = _guarded(config) if config.fallback else config
    config = replace(config, traffic=config.traffic or world_class(config.data).traffic)
    runs = _runs_to_drive(config)
    methods = Methods(  # raises errors before anything is computed
        data=config.data,
        planner=config.planner,
        predictors=runs,
        traffic=config.traffic,
        rules=config.rules,
        horizon_s=config.horizon,
        dt_s=config.dt,
    )
    if config.controls and not any(method.run for method in methods.all):
        raise AspEnvError(
            f"--controls: the planner {config.planner} uses no forecasts; leave it out"
        )
    recordings = open_readable(config.data, dt_s=config.dt)
    run_unit = partial(methods.drive, recordings)
    with WorkerPool(run_unit, config.jobs) if config.jobs > 1 else nullcontext() as pool:
        chosen, part = _choose_scenarios(config, recordings, methods)
        reference = config.reference or BASELINE
        scores = _drive_all(pool, run_unit, chosen, methods, reference)
    by_run = [scores.of(number) for number in range(len(methods.all))]
    by_method = scores_by_method(methods, by_run)
    labels = methods.labels
    rules, predictors = methods.settings.rules, methods.predictors
    saved = [chosen[number] for number in scores.saved]
    rows = comparison_rows(_comparison(config, rules, by_method, chosen))
    return ClosedLoopResult(
        rows=rows,
        methods=by_method,
        manifest={
            "data": config.data,
            "data_hash": recordings.data_hash(),
            "resampled": recordings.resampled(),
            "planner": config.planner,
            "predictors": {name: dict(p.metadata) for name, p in predictors.items()},
            "runs": {name: list(each) for name, each in runs.items() if each != (name,)},
            "privileged": [
                EXPERT,
                *(name for name, (run, *_) in runs.items() if predictors[run].privileged),
            ],
            "traffic": config.traffic,
            "metrics": {"preset": rules.name, "version": rules.version, "about": rules.description},
            "horizon_s": config.horizon,
            "dt_s": config.dt,
            "part": part,
            **({"note": HARD_NOTE} if is_hard(config.scenarios) else {}),
            "asked for": {"scenarios": config.scenarios, "max_scenarios": config.max_scenarios},
            "fallback": fallback_shares(rows),
            "scenarios": {scenario.name: {"seed": scenario.seed} for scenario in chosen},
            "endings": {
                label: dict(Counter(kind.name for kind in each.endings))
                for label, each in zip(labels, by_run, strict=True)
            },
            "intervals": "95 %, bootstrap over recordings and, with several, over training runs",
        },
        rollouts={label: each.rollouts for label, each in zip(labels, by_run, strict=True)},
        maps={each.recording_name: recordings[each.recording].road_map for each in saved},
        scenarios=chosen,
        recordings=recordings,
    )


def _guarded(config: Drive) -> Drive:
    """The same with guarded predictors."""
    reference = None if config.reference is None else with_fallback([config.reference])[0]
    return replace(config, predictors=with_fallback(config.predictors), reference=reference)


def _runs_to_drive(config: Drive) -> dict[str, tuple[str, ...]]:
    """Training runs of every predictor, with those of `--controls`, by the name as given.

    Raises:
        AspEnvError: a name is given twice, no folder matches, or the reference does not take part.
    """
    runs = expand_runs(config.predictors)
    if config.controls:
        runs |= {name: (name,) for name in missing_controls(config.predictors)}
    if config.reference is not None and config.reference not in runs:
        raise AspEnvError(
            f"--reference {config.reference}: expected one of the predictors, {', '.join(runs)}"
        )
    return runs


def _comparison(
    config: Drive, rules: Rules, methods: Sequence[MethodScores], scenarios: ScenarioSet
) -> Comparison:
    return Comparison(
        methods=methods,
        scenarios=scenarios,
        common=Row(
            data=config.data,
            traffic=config.traffic or "",
            latency_ticks=0,
            horizon_s=config.horizon,
            rules=rules.label,
            metric="",
            value=0.0,
            n=0,
        ),
        compared=[*([SCORE] if rules.weights else []), *rules.shown],
        reference=config.reference or BASELINE,
        replayed=config.traffic == LogDriver.name,
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
    reference: str,
) -> ComparisonScores:
    """Drives all work units in the processes of the pool, or without one in this process."""
    units = work_units(scenarios, len(methods.all))
    names = [method.predictor_name for method in methods.all]
    scores = ComparisonScores(
        len(methods.all),
        methods.settings.rules,
        under_test=[
            number
            for number, method in enumerate(methods.all)
            if names[number] != reference
            and is_under_test(names[number], privileged=method.predictor.privileged)
        ],
        reference=names.index(reference) if reference in names else None,
    )
    with Progress(transient=True) as progress:
        task = progress.add_task("driving", total=len(methods.all) * len(scenarios))
        found = pool.map(units) if pool is not None else map(run_unit, units)
        for unit, unit_scores in zip(units, found, strict=True):
            scores.add(unit, unit_scores)
            progress.advance(task, len(unit.numbers))
    return scores


def save_rollouts(folder: Path, result: ClosedLoopResult) -> None:
    """Writes `rollouts/METHOD/SCENARIO.npz` into a folder."""
    for method, rollouts in result.rollouts.items():
        into = folder / "rollouts" / method
        into.mkdir(parents=True)
        for rollout in rollouts:
            rollout.save(into / f"{rollout.scenario.name}.npz")
