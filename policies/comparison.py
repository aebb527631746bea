"""`asp-env rl compare`: do forecasts make policies learn to drive better?

Every row is a policy that observes other forecasts, trained with several seeds and equal steps.
All policies, planners, and zero and random actions then drive the same held-out scenarios, and are
scored by the same metrics.
"""

import csv
import dataclasses
import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache, partial
from html import escape
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table

from asp_env.data.predictor import load_predictor
from asp_env.data.recording import ticks
from asp_env.data.scenarios.scenario import ScenarioSet
from asp_env.data.scenarios.selection import choose_scenarios
from asp_env.data.snippets import HISTORY_S
from asp_env.data.source import Recordings, open_readable
from asp_env.errors import AspEnvError
from asp_env.evaluation.closed_loop.episodes import EpisodeSettings, drive_episodes
from asp_env.evaluation.statistics import (
    Difference,
    Estimate,
    difference,
    interval,
    resampled_means,
)
from asp_env.files import is_vacant, write_text
from asp_env.metrics.driving.rules import DEFAULT_RULES, find_rules
from asp_env.metrics.driving.scores import driving_metrics
from asp_env.planning.planner import Planner, load_planner
from asp_env.sim.traffic.assignment import make_traffic
from asp_env.sim.world import Ending, world_class
from asp_env.workers import WorkerPool, one_thread
from policies.evaluation import evaluate_policy
from policies.held_actions import RandomActions, zero_actions
from policies.planner import PolicyPlanner
from policies.runs import POLICY, load_policy
from policies.settings import EnvironmentSettings, PolicySettings
from policies.training import train_policy

METRICS = ("success", "at-fault collision", "off-road", "progress", "score")
"""Share of the scenarios that reach the goal, that end with an at-fault collision or off the road;
progress and score (PDMS) of `asp-env drive`."""

EPISODES_AT_ONCE = 64
ONE_THREAD = {"OMP_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1"}
HORIZON_S = 3.0
CURVE = "episodes/success"

PLANNERS = ("expert", "idm", "contingency+constant-velocity")
"""Planners in the table, the logged driver first."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Observed:
    """What the policies of a row observe of the future."""

    predictor: str | None = None
    forecast: Mapping[str, Any] = dataclasses.field(default_factory=dict)

    @property
    def privileged(self) -> bool:
        """Whether the predictor uses the recorded future."""
        return "oracle" in (self.predictor or "")


ONE_MODE = {"modes": 1}


def default_rows(learned: str) -> dict[str, Observed]:
    """The rows of the comparison by name; the first is the reference.

    Args:
        learned: name of a trained predictor.
    """
    return {
        "no forecast": Observed(),
        "constant velocity": Observed(predictor="constant-velocity", forecast=ONE_MODE),
        "learned": Observed(predictor=learned),
        "latent": Observed(predictor=learned, forecast={"features": "latent"}),
        "oracle": Observed(predictor="oracle", forecast=ONE_MODE),
        "shuffled oracle": Observed(predictor="shuffled-oracle", forecast=ONE_MODE),
    }


@dataclass(frozen=True, slots=True, kw_only=True)
class Cell:
    """One policy: a row and a seed."""

    row: str
    settings: PolicySettings
    privileged: bool
    folder: Path


@dataclass(frozen=True, slots=True, kw_only=True)
class HeldOut:
    """The scenarios that all methods drive."""

    data: str
    scenarios: str
    max_scenarios: int | None
    traffic: str | None = None

    def choose(self, dt_s: float) -> ScenarioSet:
        """The scenarios.

        Raises:
            AspEnvError: none fits.
        """
        recordings = _recordings(self.data, dt_s)
        chosen = choose_scenarios(
            recordings, self.scenarios, dt_s=dt_s, history=ticks(HISTORY_S, dt_s)
        )
        return chosen if self.max_scenarios is None else chosen.evenly_spaced(self.max_scenarios)


@cache
def _recordings(data: str, dt_s: float) -> Recordings:
    """The recordings of held-out data, once per process: what is made of their maps is reused."""
    return open_readable(data, dt_s=dt_s)


Values = dict[str, Float[np.ndarray, " n"]]
"""Values of N scenarios by `METRICS`."""


def drive_held_out(planner: Planner, predictor: str, held_out: HeldOut, dt_s: float) -> Values:
    """Drives all held-out scenarios with a planner.

    Args:
        planner: the planner.
        predictor: name of the predictor whose forecasts it is given.
        held_out: the scenarios.
        dt_s: length of a tick.

    Raises:
        AspEnvError: no scenario fits, or the predictor does not suit the data.
    """
    scenarios, recordings = held_out.choose(dt_s), _recordings(held_out.data, dt_s)
    world, rules = world_class(held_out.data), find_rules(DEFAULT_RULES)
    settings = EpisodeSettings(
        rules=rules,
        traffic=make_traffic(held_out.traffic, dt_s=dt_s, default=world.traffic),
        world=world,
        horizon=ticks(HORIZON_S, dt_s),
        history=ticks(HISTORY_S, dt_s),
        dt_s=dt_s,
    )
    loaded = load_predictor(predictor, horizon=settings.horizon, dt_s=dt_s)
    parts: list[Values] = []
    for start in range(0, len(scenarios), EPISODES_AT_ONCE):
        rows = np.arange(start, min(start + EPISODES_AT_ONCE, len(scenarios)))
        with one_thread():
            driven = drive_episodes(
                recordings, list(scenarios.select(rows)), planner, loaded, settings
            )
        metrics = driving_metrics(driven.drives, rules)
        parts.append(
            {
                "success": (driven.endings == Ending.GOAL).astype(np.float64),
                "at-fault collision": (driven.endings == Ending.COLLISION).astype(np.float64),
                "off-road": (driven.endings == Ending.OFF_ROAD).astype(np.float64),
                "progress": metrics["progress"].value.astype(np.float64),
                "score": metrics["score"].value.astype(np.float64),
            }
        )
    return {name: np.concatenate([part[name] for part in parts]) for name in METRICS}


def run_cell(held_out: HeldOut, cell: Cell) -> str:
    """Trains and drives one policy, unless that is done; returns the name of its row."""
    results = cell.folder / "held_out.json"
    if not results.exists():
        if not (cell.folder / POLICY).exists():
            resume = (cell.folder / "config.json").exists()
            train_policy(cell.settings, cell.folder, resume=resume, privileged=cell.privileged)
        trained = load_policy(cell.folder)
        environment = cell.settings.environment
        values = drive_held_out(
            PolicyPlanner(trained, cell.folder),
            environment.predictor or "constant-velocity",
            held_out,
            environment.dt_s,
        )
        content = {name: value.tolist() for name, value in values.items()}
        write_text(results, json.dumps(content))
    return cell.row


def baselines(held_out: HeldOut, environment: EnvironmentSettings) -> dict[str, Values]:
    """The values of planners, and of zero and random actions in the policies' environment.

    Zero and random actions have no score: they drive in the environment, not as planners.

    Args:
        held_out: the scenarios.
        environment: the environment of the policies.
    """
    values: dict[str, Values] = {}
    for name in PLANNERS:
        planner, _, predictor = name.partition("+")
        values[name] = drive_held_out(
            load_planner(planner), predictor or "constant-velocity", held_out, environment.dt_s
        )
    plain = dataclasses.replace(environment, predictor=None, forecast={})
    chosen = held_out.choose(environment.dt_s)
    for name, policy in (("zero actions", zero_actions), ("random actions", RandomActions(0))):
        driven = evaluate_policy(policy, plain, held_out.data, scenarios=chosen)
        values[name] = {key: driven.values[key] for key in METRICS if key in driven.values}
    return values


def read_values(folder: Path) -> Values:
    """The values of a policy as a planner, from its run folder."""
    content = json.loads((folder / "held_out.json").read_text())
    return {name: np.array(value) for name, value in content.items()}


def as_json(rows: Sequence["ComparedRow"]) -> list[dict[str, Any]]:
    """The table as plain values."""
    return [
        dataclasses.asdict(row)
        | {"early_success": [None if np.isnan(each) else each for each in row.early_success]}
        for row in rows
    ]


@dataclass(frozen=True, slots=True, kw_only=True)
class ComparedRow:
    """One row of the table."""

    name: str
    seeds: int
    estimates: dict[str, Estimate]
    """Means by `METRICS`, with intervals over recordings and seeds."""
    less_reference: dict[str, Difference]
    """Paired differences to the reference; empty for rows without seeds and the reference."""
    early_success: tuple[float, ...] = ()
    """`early_success` of each seed; empty for rows that are not trained."""


def compare_rows(
    rows: Mapping[str, Sequence[Values]],
    recording: Sequence[int] | np.ndarray,
    reference: str,
    *,
    early: Mapping[str, Sequence[float]],
) -> list[ComparedRow]:
    """The table: means, and differences to one row.

    Args:
        rows: values of each seed, by row; all of the same scenarios.
        recording: (N,) recording of each scenario.
        reference: name of the row that differences refer to.
        early: `early_success` of each seed, by row.
    """
    groups = np.asarray(recording)
    draws: dict[str, dict[str, np.ndarray]] = {}
    for stream, (name, seeds) in enumerate(rows.items()):
        draws[name] = {}
        for metric in METRICS:
            if metric in seeds[0]:
                values = np.stack([each[metric] for each in seeds])
                draws[name][metric] = resampled_means(values, groups, stream=stream)
    count = len(groups)
    return [
        ComparedRow(
            name=name,
            seeds=len(rows[name]),
            estimates={metric: interval(each, n=count) for metric, each in values.items()},
            less_reference={
                metric: difference(each - draws[reference][metric], n=count)
                for metric, each in values.items()
                if name != reference and metric in draws[reference]
            },
            early_success=tuple(early.get(name, ())),
        )
        for name, values in draws.items()
    ]


def learning_curves(
    folders: Mapping[str, Sequence[Path]],
) -> dict[str, Float[np.ndarray, "points 4"]]:
    """Success in training against steps: steps, mean over seeds, and a 95 % bootstrap interval.

    Args:
        folders: run folders of each seed, by row.
    """
    return {
        name: _curve([_progress_of(folder) for folder in seeds]) for name, seeds in folders.items()
    }


def early_success(folder: Path, steps: int) -> float:
    """Share of training episodes that reach the goal in the first half of the training.

    It is the mean of the values that the run stored, one for each update of the policy.

    Args:
        folder: the run folder.
        steps: steps of the whole training.

    Returns:
        The share; NaN if the run stored none.
    """
    progress = _progress_of(folder)
    values = progress[progress[:, 0] <= steps / 2, 1]
    return float(values.mean()) if len(values) else float("nan")


def _progress_of(folder: Path) -> Float[np.ndarray, "points 2"]:
    """Steps and success of a run, from all its tables of statistics."""
    lines: list[dict[str, str]] = []
    for path in folder.glob("progress*.csv"):
        with path.open(newline="") as file:
            lines += [line for line in csv.DictReader(file) if line.get(CURVE)]
    points = [[float(line["time/total_timesteps"]), float(line[CURVE])] for line in lines]
    return np.array(sorted(points)).reshape(-1, 2)


def _curve(seeds: Sequence[Float[np.ndarray, "_ 2"]]) -> Float[np.ndarray, "points 4"]:
    """Means of at most twenty equal sections of the training in which every seed has a value."""
    sections = 20
    last = max(each[-1, 0] for each in seeds)
    edges = np.linspace(0, last, sections + 1)
    sums, counts = np.zeros((2, len(seeds), sections))
    for row, each in enumerate(seeds):
        index = np.clip(np.searchsorted(edges, each[:, 0]) - 1, 0, sections - 1)
        counts[row] = np.bincount(index, minlength=sections)
        sums[row] = np.bincount(index, weights=each[:, 1], minlength=sections)
    known = (counts > 0).all(axis=0)
    means = sums[:, known] / counts[:, known]
    rng = np.random.default_rng(0)
    drawn = means[rng.integers(len(seeds), size=(2_000, len(seeds)))].mean(axis=1)
    low, high = np.quantile(drawn, [0.025, 0.975], axis=0)
    return np.stack([edges[1:][known], means.mean(axis=0), low, high], axis=-1)


def run_cells(cells: Sequence[Cell], held_out: HeldOut, jobs: int, console: Console) -> None:
    """Trains and drives all policies that are not done, `jobs` at a time.

    Raises:
        AspEnvError: a setting is invalid, or a process has ended.
    """
    columns = (TextColumn("policies"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with (
        Progress(*columns, console=console) as bar,
        WorkerPool(partial(run_cell, held_out), jobs, env=_environment()) as pool,
    ):
        task = bar.add_task("policies", total=len(cells))
        for _ in pool.map(cells):
            bar.advance(task)


def _environment() -> dict[str, str]:
    return {**os.environ, **ONE_THREAD}


def rendered(rows: Sequence[ComparedRow], reference: str) -> Table:
    """The table for the terminal."""
    table = Table(title="held-out scenarios; 95 % intervals over recordings and seeds")
    table.add_column("row")
    table.add_column("seeds")
    for metric in METRICS:
        table.add_column(metric)
    table.add_column(f"score less {reference}")
    table.add_column("success in the first half of training")
    for row in rows:
        means = [
            f"{row.estimates[metric]:.3f}" if metric in row.estimates else "" for metric in METRICS
        ]
        less = f"{row.less_reference['score']:+.3f}" if "score" in row.less_reference else ""
        early = ""
        if not np.isnan(row.early_success).all():
            low, high = np.nanmin(row.early_success), np.nanmax(row.early_success)
            early = f"{np.nanmean(row.early_success):.2f} ({low:.2f} to {high:.2f})"
        table.add_row(row.name, str(row.seeds), *means, less, early)
    return table


def check_out(out: Path, settings: Mapping[str, Any]) -> None:
    """Checks that a folder is new, or holds the same comparison.

    Raises:
        AspEnvError: it holds something else.
    """
    path = out / "comparison.json"
    text = json.dumps(settings, indent=1)
    if path.exists():
        if json.loads(path.read_text())["settings"] != json.loads(text):
            raise AspEnvError(f"{out} holds another comparison; choose another --out")
    elif not is_vacant(out):
        raise AspEnvError(f"{out} exists and holds no comparison; choose another --out")
    else:
        out.mkdir(parents=True, exist_ok=True)
        write_text(path, json.dumps({"settings": settings}, indent=1))


def curves_figure(curves: Mapping[str, Float[np.ndarray, "points 4"]]) -> Any:
    """A plotly figure of learning curves with their intervals.

    Args:
        curves: what `learning_curves` returned.

    Raises:
        ModuleNotFoundError: plotly is not installed.
    """
    import plotly.graph_objects as go

    figure = go.Figure()
    for number, (row, curve) in enumerate(curves.items()):
        name = escape(row)  # plotly reads labels as HTML
        steps, mean, low, high = curve.T
        colour = COLOURS[number % len(COLOURS)]
        figure.add_scatter(
            x=[*steps, *steps[::-1]],
            y=[*high, *low[::-1]],
            fill="toself",
            fillcolor=colour,
            opacity=0.15,
            line={"width": 0},
            hoverinfo="skip",
            legendgroup=name,
            showlegend=False,
        )
        figure.add_scatter(
            x=steps, y=mean, name=name, legendgroup=name, line={"color": colour, "width": 2}
        )
    figure.update_layout(
        xaxis_title="steps of training",
        yaxis_title="share of training episodes that reach the goal",
        yaxis_range=[0, 1],
        template="plotly_white",
        legend={"orientation": "h", "y": -0.2},
        margin={"l": 60, "r": 20, "t": 20, "b": 60},
    )
    return figure


COLOURS = ("#868e96", "#1c7ed6", "#e8590c", "#7048e8", "#0ca678", "#d6336c")
"""Colours of the rows."""
