"""`asp-env study`: methods in several traffics, latencies and data, from one command."""

import fcntl
import json
import os
import shlex
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, fields, replace
from functools import partial
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from asp_env.arguments import check_jobs
from asp_env.console import text_console
from asp_env.data.scenarios.selection import save_scenarios
from asp_env.errors import AspEnvError
from asp_env.evaluation.closed_loop.comparison import EXPERT, EpisodeScores, Methods, joined_scores
from asp_env.evaluation.closed_loop.forecast_quality import open_loop_rows
from asp_env.evaluation.closed_loop.scenario_table import DrivenScenarios, write_scenario_table
from asp_env.evaluation.closed_loop.summary import (
    Comparison,
    MethodScores,
    comparison_rows,
    scores_by_method,
)
from asp_env.evaluation.closed_loop.tidy_table import check_parquet_possible, write_tidy_table
from asp_env.evaluation.ladder import BASELINE, is_under_test
from asp_env.evaluation.report import Episode, check_report_possible, write_report
from asp_env.evaluation.results import SCORE, Condition, Row, write_manifest, write_metrics
from asp_env.evaluation.selection import PartChoice
from asp_env.evaluation.study.cells import CELLS, CellFolder
from asp_env.evaluation.study.conditions import (
    Cell,
    DataSet,
    Group,
    late_prefix,
    make_cells,
    make_groups,
    open_data_sets,
)
from asp_env.evaluation.study.driving import DriveTasks, Task, drive_tasks
from asp_env.evaluation.study.questions import Answer, answers
from asp_env.evaluation.study.ray_cluster import drive_on_ray
from asp_env.evaluation.study.settings import StudySettings, read_settings
from asp_env.evaluation.study.tables import answer_lines, condition_tables, fault_lines
from asp_env.files import write_text
from asp_env.metrics.driving.rules import find_rules
from asp_env.sim.traffic.log import LogDriver

IN_THIS_PROCESS: DriveTasks = partial(drive_tasks, jobs=1)

SETTINGS = "study.json"
"""File with the settings of the last study in a folder."""

WORST, TELLING = 6, 3
"""Numbers of scenarios of each DATA and planner whose drives are shown: those with the lowest mean
score, and those with the largest gains and losses over constant velocity."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Study:
    """Drive methods in several traffics, latencies and data; finished parts are never repeated.

    A study that was stopped goes on where it was, and one whose options have changed drives only
    what depends on them.
    """

    config: tyro.conf.Positional[Path | None] = None
    """TOML file with the options below as keys; options replace them."""
    out: Path
    """Folder of the study: a new one, or that of a study to go on with."""
    data: Annotated[tuple[str, ...] | None, tyro.conf.arg(metavar="DATA …")] = None
    """Data, each as for asp-env drive, such as suite:intersection-v1."""
    methods: Annotated[tuple[str, ...] | None, tyro.conf.arg(metavar="METHOD …")] = None
    """Methods as for asp-env benchmark: PLANNER+PREDICTOR, a predictor
    alone, which drives with contingency, or a planner alone."""
    traffic: Annotated[tuple[str, ...] | None, tyro.conf.arg(metavar="TRAFFIC …")] = None
    """Drivers of the other agents: log, hybrid, idm, predictor:NAME, …
    The default is that of the data."""
    latency_ticks: Annotated[tuple[int, ...] | None, tyro.conf.arg(metavar="TICKS …")] = None
    """Ticks by which forecasts are late. The default is 0."""
    scenarios: Annotated[str | None, tyro.conf.arg(metavar="FILTER|FILE")] = None
    """Scenarios, as for asp-env drive. The default is the frozen list of
    the data, or all."""
    max_scenarios: int | None = None
    """Largest number of scenarios of each DATA, at even spacing."""
    controls: tyro.conf.DisallowNone[bool | None] = None
    """Whether the whole ladder of controls drives in replayed traffic
    without latency. The default is yes."""
    reference: Annotated[str | None, tyro.conf.arg(metavar="NAME[:RUN]")] = None
    """Predictor that differences refer to. The default is constant-velocity."""
    horizon_s: float | None = None
    """Horizon of forecasts and plans in seconds. The default is 3."""
    dt_s: float | None = None
    """Duration of a tick in seconds. The default is 0.2."""
    part: PartChoice | None = None
    """Part of the data, as for asp-env drive."""
    rules: str | None = None
    """Driving rules: nuplan, pdms, waymax, strict or graded."""
    budget_ms: float | None = None
    """Largest wall time of a forecast, and of a plan, in an episode at a
    tick; what takes longer counts as a fault. Results then depend on
    the machine."""
    parquet: bool = False
    """Also write scenarios.parquet, with a row per scenario, method, run and
    metric; needs the extra parquet."""
    jobs: int = 1
    """Number of processes that drive. The results do not depend on it."""
    ray: Annotated[str | None, tyro.conf.arg(metavar="ADDRESS|auto")] = None
    """Address of a Ray cluster that drives instead, or auto for the one that
    was started on this machine. The results do not depend on it."""
    ray_send_data: bool = False
    """Send the files of data that are folders through Ray's object store,
    instead of reading them on all nodes from the same path."""

    def run(self) -> None:
        """Drives what is missing, writes the folder and prints the tables.

        Raises:
            AspEnvError: an option, the file or the data are bad, or a package is missing.
        """
        check_jobs(self.jobs)
        if self.ray is not None and self.jobs > 1:
            raise AspEnvError("--ray and --jobs: give one of them; a cluster uses all its cores")
        if self.ray is None and self.ray_send_data:
            raise AspEnvError("--ray-send-data: goes with --ray ADDRESS; leave it out")
        if self.traffic == ():
            raise AspEnvError(
                "study: no traffic given, expected at least one; leave --traffic out for that of "
                "the data"
            )
        names = [field.name for field in fields(StudySettings)]
        settings = read_settings(self.config, {name: getattr(self, name) for name in names})
        check_report_possible()
        if self.parquet:
            check_parquet_possible()
        console = text_console()
        drive = partial(drive_tasks, jobs=self.jobs)
        if self.ray is not None:
            drive = partial(drive_on_ray, address=self.ray, send_data=self.ray_send_data)
        with _locked(self.out):
            result = run_study(settings, self.out, drive=drive, console=console)
            write_study(result, self.out, drive=drive)
            _write_or_remove_tidy_table(self.out, result, wanted=self.parquet)
        for table in condition_tables(result.rows, result.privileged):
            console.print(table)
        for line in (*answer_lines(result.answers), *fault_lines(result.driven)):
            console.print(line)
        console.print(f"wrote {self.out}/report.html")


@dataclass(frozen=True, slots=True, kw_only=True)
class StudyResult:
    """All results of a study."""

    settings: StudySettings
    rows: list[Row]
    """Lines of `metrics.csv`, of all conditions."""
    answers: list[Answer]
    """Answers to the questions of a study, whose rows are among `rows`."""
    driven: list[DrivenScenarios]
    """Scores of all methods in every scenario, by condition and planner."""
    data_sets: Mapping[str, DataSet]
    privileged: list[str]
    """Names of the planners and predictors that use the recorded future."""
    predictors: Mapping[str, Mapping[str, str]]
    """Metadata of the predictors by the name of their run."""
    shown: list["ShownCell"]
    """Cells with drives to show."""
    cells: int
    """Number of different cells."""
    groups: list[Group]


@dataclass(frozen=True, slots=True, kw_only=True)
class ShownCell:
    """A cell with drives to show."""

    task: Task
    label: str
    """Name of the method and run, for the player."""
    planner: str
    predictor: str
    """Name of the predictor as given; empty if the planner uses no forecasts."""
    run: str
    condition: Condition

    def command(self, settings: StudySettings, scenario: str, scenarios_file: str) -> str:
        """The command that drives one of the scenarios again; `OUT` is the folder of the study."""
        condition = self.condition
        words = ["asp-env", "drive", condition.data, "--planner", self.planner]
        words += ["--predictors", self.run] if self.run else []
        words += ["--scenarios", f"OUT/{scenarios_file}#{scenario}", "--part", "all"]
        words += ["--traffic", condition.traffic, "--rules", settings.rules]
        words += ["--horizon", f"{settings.horizon_s:g}", "--dt", f"{settings.dt_s:g}"]
        return shlex.join([*words, "--out", "episode"])


def run_study(
    settings: StudySettings,
    out: Path,
    *,
    drive: DriveTasks = IN_THIS_PROCESS,
    console: Console | None = None,
) -> StudyResult:
    """Drives all cells that are not stored yet, and summarizes all.

    Args:
        settings: the settings.
        out: folder of the study; only its cells are written.
        drive: drives the cells.
        console: where progress is shown; nowhere without one.

    Raises:
        AspEnvError: an option or the data are bad, or a process ended repeatedly.
    """
    groups = make_groups(settings)
    data_sets = open_data_sets(settings, groups)
    methods = [group.methods() for group in groups]
    cells = make_cells(groups, methods, data_sets)
    folder = CellFolder(out)
    folder.remove_leftovers()
    missing = {cell.key: Task(cell=cell) for cell in cells if cell.key not in folder}
    keys = {cell.key for cell in cells}
    columns = (TextColumn("cells"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=console, transient=True, disable=console is None) as progress:
        bar = progress.add_task("cells", total=len(keys), completed=len(keys) - len(missing))
        tasks = [*missing.values()]
        for task, scores in drive(groups, settings.dt_s, tasks) if tasks else ():
            folder.save(task.cell.key, scores)
            progress.advance(bar)
    return _summarized(settings, groups, methods, data_sets, cells, folder)


def _summarized(
    settings: StudySettings,
    groups: list[Group],
    by_group: Sequence[Methods],
    data_sets: Mapping[str, DataSet],
    cells: Sequence[Cell],
    folder: CellFolder,
) -> StudyResult:
    rows: list[Row] = []
    driven: list[DrivenScenarios] = []
    privileged = [EXPERT]
    predictors: dict[str, Mapping[str, str]] = {}
    shown: list[ShownCell] = []
    with_expert: set[Condition] = set()
    for number, group in enumerate(groups):
        methods, condition = by_group[number], group.condition
        data_set = data_sets[condition.data]
        own = [cell for cell in cells if cell.group == number]
        by_run = _scores(own, methods, folder)
        late = late_prefix(condition.latency_ticks)
        by_method = [
            replace(each, runs={run.removeprefix(late): p for run, p in each.runs.items()})
            for each in scores_by_method(methods, by_run)
        ]
        comparison = _comparison(settings, condition, data_set, by_method)
        if group.is_static:
            comparison = replace(comparison, compared=[], reference=None, replayed=False)
        found = comparison_rows(comparison)
        if group.is_static:
            found = open_loop_rows(found)
        elif condition in with_expert:  # it drives beside every planner
            by_method = [each for each in by_method if each.planner != EXPERT]
            found = [row for row in found if row.planner != EXPERT]
        with_expert |= set() if group.is_static else {condition}
        rows += found
        driven.append(
            DrivenScenarios(
                condition=condition,
                scenarios=data_set.scenarios,
                methods=by_method,
            )
        )
        for name, runs in group.runs.items():
            predictors |= {
                run.removeprefix(late): dict(methods.predictors[run].metadata) for run in runs
            }
            if methods.predictors[runs[0]].privileged and name not in privileged:
                privileged.append(name)
        if condition == _shown_condition(groups, condition.data) and not group.is_static:
            first = number == _first(groups, condition)
            shown += _shown_cells(own, group, methods, by_run, with_expert=first)
    found_answers = answers(driven, privileged)
    rows += [
        replace(row, horizon_s=settings.horizon_s, rules=find_rules(settings.rules).label)
        for answer in found_answers
        for row in answer.rows
    ]
    return StudyResult(
        settings=settings,
        rows=rows,
        answers=found_answers,
        driven=driven,
        data_sets=data_sets,
        privileged=privileged,
        predictors=predictors,
        shown=shown,
        cells=len({cell.key for cell in cells}),
        groups=groups,
    )


def _first(groups: Sequence[Group], condition: Condition) -> int:
    return next(i for i, group in enumerate(groups) if group.condition == condition)


def _shown_condition(groups: Sequence[Group], data: str) -> Condition:
    """The condition of DATA whose drives are shown: that of the first traffic and latency."""
    return next(group.condition for group in groups if group.condition.data == data)


def _scores(cells: Sequence[Cell], methods: Methods, folder: CellFolder) -> list[EpisodeScores]:
    """The scores of every method of a group in all scenarios, in the order of the scenarios."""
    parts: list[list[tuple[np.ndarray, EpisodeScores]]] = [[] for _ in methods.all]
    for cell in cells:
        parts[cell.unit.method].append((cell.unit.numbers, folder.load(cell.key)))
    return [joined_scores(each) for each in parts]


def _comparison(
    settings: StudySettings,
    condition: Condition,
    data_set: DataSet,
    methods: Sequence[MethodScores],
) -> Comparison:
    rules = find_rules(settings.rules)
    return Comparison(
        methods=methods,
        scenarios=data_set.scenarios,
        common=Row(
            data=condition.data,
            traffic=condition.traffic,
            latency_ticks=condition.latency_ticks,
            horizon_s=settings.horizon_s,
            rules=rules.label,
            metric="",
            value=0.0,
            n=0,
        ),
        compared=[*([SCORE] if rules.weights else []), *rules.shown],
        reference=settings.reference,
        replayed=condition.traffic == LogDriver.name,
    )


def _shown_cells(
    cells: Sequence[Cell],
    group: Group,
    methods: Methods,
    by_run: Sequence[EpisodeScores],
    *,
    with_expert: bool,
) -> list["ShownCell"]:
    """Cells of the scenarios whose drives are shown, for every method of a group.

    They are those with the lowest mean score over all methods but the expert, and those in which
    a method under test gains most over the reference, or loses most.
    """
    if SCORE not in by_run[0].metrics:
        return []
    scores = np.stack([each.metrics[SCORE].value for each in by_run])
    chosen = [*np.argsort(scores[min(1, len(scores) - 1) :].mean(axis=0), kind="stable")][:WORST]
    names = [method.predictor_name for method in methods.all]
    tested = [
        number
        for number, method in enumerate(methods.all)
        if names[number] and is_under_test(names[number], privileged=method.predictor.privileged)
    ]
    if BASELINE in names and tested:
        gains = scores[tested] - scores[names.index(BASELINE)]
        best, worst = gains.max(axis=0), gains.min(axis=0)
        chosen += [i for i in np.argsort(-best, kind="stable")[:TELLING] if best[i] > 0]
        chosen += [i for i in np.argsort(worst, kind="stable")[:TELLING] if worst[i] < 0]
    shown = {int(number) for number in chosen}
    found = []
    for cell in cells:
        at = tuple(i for i, number in enumerate(cell.unit.numbers.tolist()) if number in shown)
        if at and (with_expert or cell.unit.method > 0):
            method = methods.all[cell.unit.method]
            found.append(
                ShownCell(
                    task=Task(cell=cell, rollouts=at),
                    label=methods.labels[cell.unit.method],
                    planner=method.planner.name,
                    predictor=method.predictor_name,
                    run=method.run,
                    condition=group.condition,
                )
            )
    return found


def write_study(result: StudyResult, out: Path, *, drive: DriveTasks = IN_THIS_PROCESS) -> None:
    """Writes all files of a study but its cells.

    Args:
        result: the result.
        out: folder of the study.
        drive: drives the scenarios that are shown once more.

    Raises:
        AspEnvError: a process ended repeatedly, or a package is missing.
    """
    settings = result.settings
    episodes = _write_rollouts(result, out, drive)
    write_metrics(out, result.rows)
    write_scenario_table(out, result.driven)
    write_manifest(
        out,
        "study",
        settings=settings.as_json(),
        privileged=result.privileged,
        predictors=result.predictors,
        data={
            name: {
                "data_hash": each.recordings.data_hash(),
                "resampled": each.recordings.resampled(),
                "part": each.part,
                "scenarios": {
                    scenario.name: {"seed": scenario.seed} for scenario in each.scenarios
                },
            }
            for name, each in result.data_sets.items()
        },
        faults=_fault_counts(result.driven),
        answers={each.question: each.sentences for each in result.answers if each.sentences},
        cells=result.cells,
        intervals="95 %, bootstrap over recordings and, with several, over training runs",
    )
    for name, each in result.data_sets.items():
        save_scenarios(out / _scenarios_file(result, name), each.scenarios, each.recordings)
    maps = {
        f"{name}/{scenario.recording_name}": each.recordings[scenario.recording].road_map
        for name, each in result.data_sets.items()
        for scenario in each.scenarios
    }
    write_report(
        out,
        title=f"Study on {', '.join(settings.data)}",
        maps=maps,
        episodes=episodes,
        answers={each.question: each.sentences for each in result.answers if each.sentences},
    )
    write_text(out / SETTINGS, json.dumps(settings.as_json(), indent=1) + "\n")


def _write_or_remove_tidy_table(out: Path, result: StudyResult, *, wanted: bool) -> None:
    """Writes `scenarios.parquet`; if it is not wanted, removes that of a study before."""
    if wanted:
        write_tidy_table(out, result.driven)
    else:
        (out / "scenarios.parquet").unlink(missing_ok=True)


def _scenarios_file(result: StudyResult, data: str) -> str:
    """Name of the file with the scenarios of DATA."""
    if len(result.data_sets) == 1:
        return "scenarios.json"
    return f"scenarios-{[*result.data_sets].index(data) + 1}.json"


def _write_rollouts(result: StudyResult, out: Path, drive: DriveTasks) -> list[Episode]:
    """Drives the scenarios that are shown once more, unless their rollouts are stored.

    Returns:
        All episodes that the page shows.
    """
    episodes: list[Episode] = []
    wanted: dict[str, list[tuple[Path, int]]] = {}
    tasks: dict[str, Task] = {}
    for shown in result.shown:
        task, condition = shown.task, shown.condition
        place = str([*result.data_sets].index(condition.data) + 1)
        folder = out / "rollouts" / (place if len(result.data_sets) > 1 else "") / shown.label
        for position in task.rollouts:
            name = task.cell.unit.scenarios[position].name
            path = folder / f"{name}.npz"
            stamp = path.with_suffix(".key")
            if not path.exists() or not stamp.exists() or stamp.read_text() != task.cell.key:
                wanted.setdefault(task.cell.key, []).append((path, position))
                tasks[task.cell.key] = task
            episodes.append(
                Episode(
                    path=path,
                    label=shown.label,
                    planner=shown.planner,
                    predictor=shown.predictor,
                    condition=condition,
                    command=shown.command(
                        result.settings, name, _scenarios_file(result, condition.data)
                    ),
                )
            )
    if tasks:
        for task, scores in drive(result.groups, result.settings.dt_s, [*tasks.values()]):
            for path, position in wanted[task.cell.key]:
                path.parent.mkdir(parents=True, exist_ok=True)
                scores.rollouts[task.rollouts.index(position)].save(path)
                write_text(path.with_suffix(".key"), task.cell.key)
    kept = {path for each in episodes for path in (each.path, each.path.with_suffix(".key"))}
    for path in (out / "rollouts").rglob("*.*"):
        if path.is_file() and path not in kept:
            path.unlink()  # of a study with other options
    return episodes


def _fault_counts(driven: Sequence[DrivenScenarios]) -> dict[str, dict[str, int]]:
    """Number of drives with each cause, by method and condition."""
    counts: dict[str, dict[str, int]] = {}
    for each in driven:
        for method in each.methods:
            causes = Counter(
                f"{fault.socket} {fault.cause}"
                for scores in method.scores
                for fault in scores.faults
                if fault is not None
            )
            if causes:
                name = f"{method.planner}+{method.predictor}"
                counts[f"{name} ({each.condition.label})"] = dict(causes)
    return counts


@contextmanager
def _locked(out: Path) -> Iterator[None]:
    """Reserves the folder of a study for this process; removes it if nothing was written.

    Raises:
        AspEnvError: it is not a folder of a study, or another process writes to it.
    """
    if out.exists() and not out.is_dir():
        raise AspEnvError(f"{out} is a file; choose another --out")
    names = {each.name for each in out.iterdir()} if out.exists() else set[str]()
    if names and not {SETTINGS, CELLS} & names:
        raise AspEnvError(f"{out} exists and is not the folder of a study; choose another --out")
    (out / CELLS).mkdir(parents=True, exist_ok=True)
    descriptor = os.open(out, os.O_RDONLY)
    try:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            raise AspEnvError(
                f"{out}: another process drives this study; wait for it, or choose another --out"
            ) from error
        yield
    finally:
        for folder in (out / CELLS, out):
            with suppress(OSError):  # it is not empty
                folder.rmdir()
        os.close(descriptor)
