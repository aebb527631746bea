"""From every snippet's metrics to rows of a table: means and their statistics, by subset.

MERGED: `asp-env evaluate`: forecasts against what happened, on snippets of recordings.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import tyro
from jaxtyping import Bool, Int
from rich.console import Console

from asp_env.data.causal import causal_histories
from asp_env.data.predictor import Predictor
from asp_env.data.recording import DEFAULT_DT_S, ticks
from asp_env.data.snippets import SnippetIndex, gather_future, gather_scene, index_snippets
from asp_env.data.source import Recordings, open_data
from asp_env.evaluation import statistics
from asp_env.evaluation.open_loop.judging import (
    ALL_MODES,
    Judged,
    Judgement,
    ModeProbabilities,
    ask,
    judge,
)
from asp_env.evaluation.report import ForecastExamples, check_report_possible, write_report
from asp_env.evaluation.results import Row, output_folder, write_manifest, write_metrics
from asp_env.evaluation.selection import PartChoice, keep_within, load_predictors, ticks_to_judge
from asp_env.evaluation.statistics import Estimate
from asp_env.evaluation.tables import open_loop_tables
from asp_env.metrics.forecast.calibration import calibration_error, calibration_sums
from asp_env.metrics.forecast.errors import MODE_RULES, ModeRule

REFERENCE = "constant-velocity"
"""Every predictor's FDE is also given as a ratio to this one's, paired, where it takes part."""

RATIO = "FDE / constant velocity"
ECE = "ECE"


def rows_of(
    judgement: Judgement, predictors: Mapping[str, Predictor], *, data: str, horizon_s: float
) -> list[Row]:
    """A row for each predictor, selection, subset and metric that has any value."""
    reference = {
        each.selection: each
        for each in judgement.judged
        if each.name == REFERENCE and each.metric == "FDE"
    }
    rows: list[Row] = []
    for name, predictor in predictors.items():
        found: list[tuple[str, str, str, Estimate]] = []
        for each in judgement.judged:
            if each.name == name:
                found += _estimates(each, judgement, reference.get(each.selection))
        for modes in judgement.modes:
            if modes.name == name:
                found += _calibration(modes, judgement)
        about = predictor.metadata
        rows += [
            Row(
                data=data,
                predictor=name,
                trained_on=about.get("trained_on", ""),
                view=about.get("view", ""),
                recipe=about.get("preset", ""),
                chaining=about.get("chaining", ""),
                horizon_s=horizon_s,
                selection=selection,
                subset=subset,
                metric=metric,
                value=estimate.value,
                low=estimate.low,
                high=estimate.high,
                n=estimate.n,
            )
            for selection, subset, metric, estimate in found
        ]
    return rows


def _estimates(
    each: Judged, judgement: Judgement, reference: Judged | None
) -> Iterator[tuple[str, str, str, Estimate]]:
    groups = judgement.recording
    compared = each.metric == "FDE" and each.name != REFERENCE
    for subset, keep in _kept(judgement, each.valid):
        yield each.selection, subset, each.metric, statistics.mean(each.values[keep], groups[keep])
        if compared and reference is not None and reference.values[keep].any():
            ratio = statistics.ratio(each.values[keep], reference.values[keep], groups[keep])
            yield each.selection, subset, RATIO, ratio


def _calibration(
    modes: ModeProbabilities, judgement: Judgement
) -> Iterator[tuple[str, str, str, Estimate]]:
    sums = calibration_sums(modes.probabilities, modes.nearest)
    for subset, keep in _kept(judgement, modes.valid):
        estimate = statistics.of_sums(sums[keep], judgement.recording[keep], calibration_error)
        yield ALL_MODES, subset, ECE, estimate


def _kept(
    judgement: Judgement, valid: Bool[np.ndarray, " n"]
) -> Iterator[tuple[str, Int[np.ndarray, " m"]]]:
    """Rows of every subset in which anything is valid."""
    for subset, member in judgement.subsets.items():
        keep = np.flatnonzero(member & valid)
        if len(keep):
            yield subset, keep


PICTURES = 6
"""Situations whose forecasts are shown."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Evaluate:
    """Judge predictors in open loop: their forecasts against what happened."""

    data: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="DATA")]
    """A folder in the inD/rounD or INTERACTION layout, `sample:…`, `synthetic:…` or
    `highway:…`."""
    out: Path
    """Folder to write; must not exist."""
    predictors: Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME[:RUN] …")] = (
        "constant-velocity",
        "constant-turn-rate",
    )
    """Predictors by name, trained ones with their folder."""
    horizon: float = 3.0
    """Seconds to forecast."""
    dt: float = DEFAULT_DT_S
    """Seconds per tick."""
    part: PartChoice = "auto"
    """Which part of DATA; auto takes what no named predictor has seen."""
    history: Literal["recorded", "causal"] = "recorded"
    """What predictors are shown: histories as recorded, which were smoothed with what came after,
    or filtered again by a filter that knows no later frame. The truth is as recorded."""
    best_by: ModeRule = "fde"
    """How the best of 3 is chosen: lowest final error, lowest mean error, or the paper's rule."""

    def run(self) -> None:
        """Evaluates, writes the folder, prints the table."""
        check_report_possible()
        with output_folder(self.out) as folder:
            result = evaluate(self)
            write_metrics(folder, result.rows)
            write_manifest(folder, "evaluate", **result.manifest)
            write_report(
                folder, title=f"Open loop on {Path(self.data).name}", examples=result.examples
            )
        console = Console()
        for table in open_loop_tables(result.rows, result.manifest["privileged"]):
            console.print(table)
        console.print(f"wrote {self.out}/report.html")


@dataclass(frozen=True, slots=True, kw_only=True)
class OpenLoop:
    """What an evaluation found."""

    rows: list[Row]
    manifest: dict[str, Any]
    judgement: Judgement
    """Every snippet's metrics, for comparisons in pairs."""
    examples: ForecastExamples


def evaluate(config: Evaluate) -> OpenLoop:
    """Runs every predictor on every snippet to be judged."""
    recordings = open_data(config.data)
    horizon = ticks(config.horizon, config.dt)
    predictors = load_predictors(config.predictors, horizon=horizon, dt_s=config.dt)
    allowed, part = ticks_to_judge(recordings, predictors, config.part, dt_s=config.dt)
    index = index_snippets(recordings, dt_s=config.dt, horizon_s=config.horizon)
    index = keep_within(index, allowed)
    named = dict(zip(config.predictors, predictors, strict=True))
    scenes: Sequence[Any] = recordings
    if config.history == "causal":
        scenes = causal_histories(recordings)
    judgement = judge(named, index, scenes=scenes, recorded=recordings, best_by=config.best_by)
    moving = judgement.subsets["moving"]
    return OpenLoop(
        rows=rows_of(judgement, named, data=config.data, horizon_s=config.horizon),
        manifest={
            "data": config.data,
            "data_hash": recordings.data_hash(),
            "predictors": {name: dict(p.metadata) for name, p in named.items()},
            "privileged": [name for name, p in named.items() if p.privileged],
            "horizon_s": config.horizon,
            "dt_s": config.dt,
            "part": part,
            "history": config.history,
            "recordings": len(np.unique(index.recording)),
            "snippets": len(index),
            "moving snippets": int(moving.sum()),
            "best_by": config.best_by,
            "best-of-3": f"of the three most probable modes, {MODE_RULES[config.best_by]}",
            "intervals": "95 %, bootstrap over recordings",
        },
        judgement=judgement,
        examples=_examples(scenes, recordings, index, moving, named),
    )


def _examples(
    scenes: Sequence[Any],
    recorded: Recordings,
    index: SnippetIndex,
    member: Bool[np.ndarray, " n"],
    predictors: Mapping[str, Predictor],
) -> ForecastExamples:
    """Some situations with moving targets, the same for the same index."""
    usable = np.flatnonzero(member) if member.any() else np.arange(len(index))
    keys = np.stack([index.recording[usable], index.tick[usable]], axis=-1)
    situations, counts = np.unique(keys, axis=0, return_counts=True)
    rich = np.flatnonzero(counts >= min(2, counts.max()))
    picked = situations[rich[np.linspace(0, len(rich) - 1, min(PICTURES, len(rich))).astype(int)]]
    shown = (keys[:, None] == picked[None]).all(axis=-1).any(axis=-1)
    some = index.select(usable[shown])
    scene, future = gather_scene(scenes, some), gather_future(recorded, some)
    where = [
        f"recording {recorded.names[recording]}, {tick * index.dt_s:.1f} s"
        for recording, tick in picked.tolist()
    ]
    return ForecastExamples(
        scene=scene,
        future=future,
        forecasts={
            name: ask(predictor, scene, future, index.horizon_ticks)
            for name, predictor in predictors.items()
        },
        captions=tuple(where),
    )
