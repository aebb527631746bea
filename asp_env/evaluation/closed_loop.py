"""`asp-env drive`: a planner drives by what a predictor says, in many episodes at once."""

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tyro
from rich.console import Console
from rich.progress import Progress

from asp_env.data.clock import DEFAULT_DT_S, ticks
from asp_env.data.predictor import Predictor
from asp_env.data.road_map import RoadMap
from asp_env.data.rollout import Rollout
from asp_env.data.scenario import Scenario, ScenarioSet
from asp_env.data.scenario_choice import choose_scenarios
from asp_env.data.scenario_file import save_scenarios
from asp_env.data.scenario_tags import TAGS
from asp_env.data.snippets import HISTORY_S
from asp_env.data.source import Recordings, open_data
from asp_env.evaluation import intervals
from asp_env.evaluation.entrants import load_predictors, short_names
from asp_env.evaluation.episodes import drive_episodes
from asp_env.evaluation.output import Row, output_folder, write_manifest, write_metrics
from asp_env.evaluation.report import check_report_possible, write_report
from asp_env.evaluation.tables import driving_table
from asp_env.evaluation.unseen import PartChoice, nothing_left, ticks_to_judge
from asp_env.metrics.driving import driving_metrics
from asp_env.metrics.masked import Masked
from asp_env.metrics.presets import DEFAULT_PRESET, PRESETS, Preset, find_preset
from asp_env.planning.planner import Planner, load_planner
from asp_env.sim.drivers import Driver
from asp_env.sim.traffic import make_traffic
from asp_env.sim.world import Ending
from asp_env.sim.worlds import world_of

EPISODES_AT_ONCE = 64

SAVED_ROLLOUTS = 6
"""So many scenarios' rollouts are kept to look at, of every driver."""

EXPERT = "expert"
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
    most: int | None = None
    """At most so many, spread evenly over those there are."""
    horizon: float = 3.0
    """Seconds to forecast and to plan."""
    dt: float = DEFAULT_DT_S
    """Seconds per tick."""
    part: PartChoice = "auto"
    """Which part of DATA; auto takes what no named predictor has seen."""
    metrics: str = DEFAULT_PRESET
    """Whose definitions judge the drives: nuplan, pdms, waymax or strict."""

    def run(self) -> None:
        """Drives, writes the folder, prints the table; the expert stands first."""
        check_report_possible()
        with output_folder(self.out) as folder:
            result = drive(self)
            write_metrics(folder, result.rows)
            write_manifest(folder, "drive", **result.manifest)
            save_scenarios(folder / "scenarios.json", result.scenarios, result.recordings)
            save_rollouts(folder, result)
            write_report(folder, title=f"Driving on {Path(self.data).name}", maps=result.maps)
        console = Console()
        shown = PRESETS[self.metrics].shown
        console.print(driving_table(result.rows, result.manifest["privileged"], shown))
        console.print(f"wrote {self.out}/report.html")


@dataclass(frozen=True, slots=True, kw_only=True)
class _Run:
    """One driver's episodes."""

    planner: str
    predictor: str
    about: Mapping[str, str]
    """Of the predictor; empty where none takes part."""
    metrics: Mapping[str, Masked]
    endings: tuple[Ending, ...]
    rollouts: tuple[Rollout, ...]


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
    """Drives with every predictor, the expert first."""
    kind = world_of(config.data)
    config = replace(config, traffic=config.traffic or kind.traffic)
    # refused before anything is computed
    traffic = make_traffic(config.traffic, dt_s=config.dt, default=kind.traffic)
    preset = find_preset(config.metrics)
    recordings = open_data(config.data)
    horizon, history = ticks(config.horizon, config.dt), ticks(HISTORY_S, config.dt)
    predictors = load_predictors(config.predictors, horizon=horizon, dt_s=config.dt)
    allowed, part = ticks_to_judge(recordings, predictors, config.part, dt_s=config.dt)
    found = choose_scenarios(
        recordings, config.scenarios, dt_s=config.dt, history=history, allowed=allowed
    )
    if not len(found):
        raise nothing_left("scenario")
    chosen = found if config.most is None else found.spread(config.most)
    scenarios = list(chosen)
    entrants: list[tuple[Planner, str, Predictor]] = [(load_planner(EXPERT), "", predictors[0])]
    planner = load_planner(config.planner)
    if planner.uses_forecasts:
        entrants += [
            (planner, name, predictor)
            for name, predictor in zip(config.predictors, predictors, strict=True)
        ]
    elif not planner.privileged:
        entrants.append((planner, "", predictors[0]))
    with Progress(transient=True) as progress:
        task = progress.add_task("driving", total=len(entrants) * len(scenarios))
        runs = [
            _drive_all(
                config, preset, traffic, recordings, scenarios, *entrant, horizon, history,
                lambda count: progress.advance(task, count),
            )
            for entrant in entrants
        ]  # fmt: skip
    reference = next((run for run in runs if run.predictor == REFERENCE), None)
    named = dict(zip(config.predictors, predictors, strict=True))
    rows = [row for run in runs for row in _rows(config, preset, run, reference, chosen)]
    short = short_names(config.predictors)
    drivers = {
        f"{run.planner} + {short[run.predictor]}" if run.predictor else run.planner: run
        for run in runs
    }
    kept = _worst(runs, preset)
    return ClosedLoop(
        rows=rows,
        manifest={
            "data": config.data,
            "data_hash": recordings.data_hash(),
            "planner": config.planner,
            "predictors": {name: dict(p.about) for name, p in named.items()},
            "privileged": [
                EXPERT,
                *(name for name, p in named.items() if p.privileged),
            ],
            "traffic": config.traffic,
            "metrics": {"preset": preset.name, "version": preset.version, "about": preset.about},
            "horizon_s": config.horizon,
            "dt_s": config.dt,
            "part": part,
            "asked for": {"scenarios": config.scenarios, "most": config.most},
            "scenarios": {scenario.name: {"seed": scenario.seed} for scenario in scenarios},
            "endings": {
                driver: dict(Counter(kind.name for kind in run.endings))
                for driver, run in drivers.items()
            },
            "intervals": "95 %, bootstrap over recordings",
        },
        rollouts={driver: tuple(run.rollouts[i] for i in kept) for driver, run in drivers.items()},
        maps={
            scenarios[i].recording_name: recordings[scenarios[i].recording].road_map for i in kept
        },
        scenarios=chosen,
        recordings=recordings,
    )


def _drive_all(
    config: Drive,
    preset: Preset,
    traffic: Driver,
    recordings: Recordings,
    scenarios: Sequence[Scenario],
    planner: Planner,
    name: str,
    predictor: Predictor,
    horizon: int,
    history: int,
    advance: Callable[[int], None],
) -> _Run:
    metrics: dict[str, list[Masked]] = {}
    endings: list[Ending] = []
    rollouts: list[Rollout] = []
    for start in range(0, len(scenarios), EPISODES_AT_ONCE):
        some = scenarios[start : start + EPISODES_AT_ONCE]
        driven = drive_episodes(
            recordings,
            some,
            planner,
            predictor,
            preset=preset,
            traffic=traffic,
            kind=world_of(config.data),
            horizon=horizon,
            history=history,
            dt_s=config.dt,
        )
        metrics_of = {**driving_metrics(driven.drives, preset), **driven.realism}
        for metric, found in metrics_of.items():
            metrics.setdefault(metric, []).append(found)
        endings += [Ending(kind) for kind in driven.endings.tolist()]
        rollouts += driven.rollouts
        advance(len(some))
    joined = {
        metric: Masked(
            value=np.concatenate([each.value for each in found]),
            valid=np.concatenate([each.valid for each in found]),
        )
        for metric, found in metrics.items()
    }
    return _Run(
        planner=planner.name,
        predictor=name,
        about=predictor.about if name else {},
        metrics=joined,
        endings=tuple(endings),
        rollouts=tuple(rollouts),
    )


def _rows(
    config: Drive, preset: Preset, run: _Run, reference: _Run | None, scenarios: ScenarioSet
) -> list[Row]:
    """Of all scenarios, and of those with each tag."""
    values = dict(run.metrics)
    if preset.weights and reference is not None and run is not reference:
        gain = run.metrics["score"].value - reference.metrics["score"].value
        values[f"score - {REFERENCE}"] = Masked(value=gain, valid=run.metrics["score"].valid)
    subsets = {"all": np.ones(len(scenarios), dtype=bool)}
    subsets |= {tag: scenarios.has(tag) for tag in TAGS}
    rows = []
    for (subset, member), (metric, found) in product(subsets.items(), values.items()):
        counts = found.valid & member
        if not counts.any():
            continue
        estimate = intervals.mean(found.value[counts], scenarios.recording[counts])
        rows.append(
            Row(
                data=config.data,
                predictor=run.predictor,
                trained_on=run.about.get("trained_on", ""),
                view=run.about.get("view", ""),
                preset=run.about.get("preset", ""),
                planner=run.planner,
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


def _worst(runs: Sequence[_Run], preset: Preset) -> list[int]:
    """The scenarios with the lowest mean scores; the expert's count only where it is alone.

    Without a score, those with the lowest mean of progress on the road without a collision.
    """
    names = ("score",) if preset.weights else ("no collision", "on road", "progress")
    scores = np.mean(
        [np.prod([run.metrics[name].value for name in names], axis=0) for run in runs[1:] or runs],
        axis=0,
    )
    return np.argsort(scores, kind="stable")[:SAVED_ROLLOUTS].tolist()


def save_rollouts(folder: Path, result: ClosedLoop) -> None:
    """`rollouts/DRIVER/SCENARIO.npz`."""
    for driver, rollouts in result.rollouts.items():
        into = folder / "rollouts" / driver
        into.mkdir(parents=True)
        for rollout in rollouts:
            rollout.save(into / f"{rollout.scenario.name}.npz")
