"""`asp-env drive`: a planner drives by what a predictor says, in many episodes at once."""

from collections import Counter
from collections.abc import Mapping, Sequence
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
from asp_env.data.scenarios.selection import choose_scenarios, save_scenarios
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
    work_units,
)
from asp_env.evaluation.report import check_report_possible, write_report
from asp_env.evaluation.results import Row, write_manifest, write_metrics
from asp_env.evaluation.selection import PartChoice, no_data_error, short_names, ticks_to_judge
from asp_env.evaluation.tables import driving_table
from asp_env.files import atomic_folder
from asp_env.metrics.driving.rules import DEFAULT_RULES, RULES, Rules
from asp_env.metrics.masked import Masked
from asp_env.sim.world import world_class
from asp_env.workers import WorkerPool, worker_pool

REFERENCE = "constant-velocity"
"""Scores are also given as differences to those with this predictor, paired by scenario."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Drive:
    """Drive in closed loop: does the predictor make the planner drive better?"""

    data: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="DATA")]
    """A folder in the inD/rounD or INTERACTION layout, `sample:…`, `synthetic:…` or
    `highway:…`."""
    out: Path
    """Folder to write; must not exist."""
    planner: str = "sampling"
    """Who drives the ego."""
    predictors: Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME[:RUN] …")] = (
        "constant-velocity",
    )
    """Predictors by name, each in a run of its own."""
    traffic: str | None = None
    """Who drives everybody else: a driver such as log, log-actions, idm, hybrid or predictor:NAME,
    or a table such as default=idm,truck=log,17=predictor:constant-velocity. By default as the
    world has it: log for recordings, own for highway:…"""
    scenarios: Annotated[str, tyro.conf.arg(metavar="FILTER|FILE")] = ""
    """Which: tags and comparisons, such as 'left,!stopping,length>=8', or a scenarios.json."""
    max_scenarios: int | None = None
    """At most so many, spread evenly over those there are."""
    horizon: float = 3.0
    """Seconds to forecast and to plan."""
    dt: float = DEFAULT_DT_S
    """Seconds per tick."""
    part: PartChoice = "auto"
    """Which part of DATA; auto takes what no named predictor has seen."""
    rules: str = DEFAULT_RULES
    """Whose definitions judge the drives: nuplan, pdms, waymax or strict."""
    jobs: int = 1
    """Processes that drive, of one thread each; the results are the same whatever their number."""

    def run(self) -> None:
        """Drives, writes the folder, prints the table; the expert stands first."""
        check_report_possible()
        with atomic_folder(self.out) as folder:
            result = drive(self)
            write_metrics(folder, result.rows)
            write_manifest(folder, "drive", **result.manifest)
            save_scenarios(folder / "scenarios.json", result.scenarios, result.recordings)
            save_rollouts(folder, result)
            write_report(folder, title=f"Driving on {Path(self.data).name}", maps=result.maps)
        console = Console()
        shown = RULES[self.rules].shown
        console.print(driving_table(result.rows, result.manifest["privileged"], shown))
        console.print(f"wrote {self.out}/report.html")


@dataclass(frozen=True, slots=True, kw_only=True)
class ClosedLoop:
    """What the drives came to."""

    rows: list[Row]
    manifest: dict[str, Any]
    rollouts: Mapping[str, tuple[Rollout, ...]]
    """By driver, of the same scenarios."""
    maps: dict[str, RoadMap]
    """By the names of the rollouts' recordings."""
    scenarios: ScenarioSet
    """All that were driven."""
    recordings: Recordings


def drive(config: Drive) -> ClosedLoop:
    """Drives with every predictor, the expert first.

    Raises:
        AspEnvError: an option or the data are bad.
    """
    if config.jobs < 1:
        raise AspEnvError(f"--jobs {config.jobs}: expected at least 1 process")
    config = replace(config, traffic=config.traffic or world_class(config.data).traffic)
    entrants = Methods(  # refused before anything is computed
        config.data, config.planner, config.predictors, config.traffic, config.rules,
        config.horizon, config.dt,
    )  # fmt: skip
    recordings = open_data(config.data)
    with worker_pool(config.jobs) as crew:
        chosen, part = _choose(config, recordings, entrants)
        outcomes = _drive_all(crew, recordings, chosen, entrants)
    runs = [(entrant, outcomes.of(number)) for number, entrant in enumerate(entrants.all)]
    short = short_names(config.predictors)
    drivers = {
        f"{each.planner.name} + {short[each.name]}" if each.name else each.planner.name: outcome
        for each, outcome in runs
    }
    preset, predictors = entrants.preset, entrants.predictors
    worst = [chosen[number] for number in outcomes.worst]
    return ClosedLoop(
        rows=_rows(config, preset, runs, chosen),
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
            "metrics": {
                "preset": preset.name,
                "version": preset.version,
                "about": preset.description,
            },
            "horizon_s": config.horizon,
            "dt_s": config.dt,
            "part": part,
            "asked for": {"scenarios": config.scenarios, "max_scenarios": config.max_scenarios},
            "scenarios": {scenario.name: {"seed": scenario.seed} for scenario in chosen},
            "endings": {
                driver: dict(Counter(kind.name for kind in outcome.endings))
                for driver, outcome in drivers.items()
            },
            "intervals": "95 %, bootstrap over recordings",
        },
        rollouts={driver: outcome.rollouts for driver, outcome in drivers.items()},
        maps={each.recording_name: recordings[each.recording].road_map for each in worst},
        scenarios=chosen,
        recordings=recordings,
    )


def _choose(config: Drive, recordings: Recordings, entrants: Methods) -> tuple[ScenarioSet, str]:
    """The scenarios to drive, and in words which part of the data they are of."""
    allowed, part = ticks_to_judge(
        recordings, [*entrants.predictors.values()], config.part, dt_s=config.dt
    )
    found = choose_scenarios(
        recordings, config.scenarios, dt_s=config.dt, history=entrants.history, allowed=allowed
    )
    if not len(found):
        raise no_data_error("scenario")
    return found if config.max_scenarios is None else found.evenly_spaced(
        config.max_scenarios
    ), part


def _drive_all(
    crew: WorkerPool, recordings: Recordings, scenarios: ScenarioSet, entrants: Methods
) -> ComparisonScores:
    units = work_units(scenarios, len(entrants.all))
    outcomes = ComparisonScores(len(entrants.all), entrants.preset)
    with Progress(transient=True) as progress:
        task = progress.add_task("driving", total=len(entrants.all) * len(scenarios))
        for number, outcome in crew.do(partial(entrants.drive, recordings), units):
            outcomes.add(units[number], outcome)
            progress.advance(task, len(units[number].numbers))
    return outcomes


def _rows(
    config: Drive,
    preset: Rules,
    runs: Sequence[tuple[Method, EpisodeScores]],
    scenarios: ScenarioSet,
) -> list[Row]:
    """Of every driver, of all scenarios and of those with each tag."""
    reference = next((run for each, run in runs if each.name == REFERENCE), None)
    rows = []
    for entrant, run in runs:
        values = dict(run.metrics)
        if preset.weights and reference is not None and run is not reference:
            gain = run.metrics["score"].value - reference.metrics["score"].value
            values[f"score - {REFERENCE}"] = Masked(value=gain, valid=run.metrics["score"].valid)
        rows += _rows_of(config, preset, entrant, values, scenarios)
    return rows


def _rows_of(
    config: Drive,
    preset: Rules,
    entrant: Method,
    values: Mapping[str, Masked],
    scenarios: ScenarioSet,
) -> list[Row]:
    about = entrant.predictor.metadata if entrant.name else {}
    subsets = {"all": np.ones(len(scenarios), dtype=bool)}
    subsets |= {tag: scenarios.has(tag) for tag in TAGS}
    rows = []
    for (subset, member), (metric, found) in product(subsets.items(), values.items()):
        counts = found.valid & member
        if not counts.any():
            continue
        estimate = statistics.mean(found.value[counts], scenarios.recording[counts])
        rows.append(
            Row(
                data=config.data,
                predictor=entrant.name,
                trained_on=about.get("trained_on", ""),
                view=about.get("view", ""),
                recipe=about.get("preset", ""),
                planner=entrant.planner.name,
                traffic=config.traffic or "",
                latency_ticks=0,
                horizon_s=config.horizon,
                rules=preset.label,
                subset=subset,
                metric=metric,
                value=estimate.value,
                low=estimate.low,
                high=estimate.high,
                n=estimate.n,
            )
        )
    return rows


def save_rollouts(folder: Path, result: ClosedLoop) -> None:
    """`rollouts/DRIVER/SCENARIO.npz`."""
    for driver, rollouts in result.rollouts.items():
        into = folder / "rollouts" / driver
        into.mkdir(parents=True)
        for rollout in rollouts:
            rollout.save(into / f"{rollout.scenario.name}.npz")
