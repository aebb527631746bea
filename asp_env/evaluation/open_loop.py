"""`asp-env evaluate`: forecasts against what happened, on snippets of recordings."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tyro
from jaxtyping import Bool, Shaped
from rich.console import Console
from rich.progress import track

from asp_env.data.clock import DEFAULT_DT_S, ticks
from asp_env.data.forecast import Forecast
from asp_env.data.predictor import Predictor
from asp_env.data.scene import Scene
from asp_env.data.snippets import (
    Future,
    SnippetIndex,
    gather_future,
    gather_scene,
    index_snippets,
)
from asp_env.data.source import Recordings, open_data
from asp_env.errors import AspEnvError
from asp_env.evaluation import intervals
from asp_env.evaluation.entrants import load_predictors
from asp_env.evaluation.output import Row, output_folder, write_manifest, write_metrics
from asp_env.evaluation.report import ForecastExamples, check_report_possible, write_report
from asp_env.evaluation.tables import open_loop_tables
from asp_env.evaluation.unseen import PartChoice, keep_within, ticks_to_judge
from asp_env.metrics.open_loop import SELECTIONS, errors_over_time, moving, open_loop_errors

BATCH = 256
"""Snippets whose scenes are held at once."""

PICTURES = 6
"""Situations whose forecasts are shown."""

REFERENCE = "constant-velocity"
"""Every predictor's FDE is also given as a ratio to this one's, paired, where it takes part."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Evaluate:
    """Judge predictors in open loop: their forecasts against what happened."""

    data: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="DATA")]
    """A folder in the inD/rounD layout, `sample:…` or `synthetic:…`."""
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
    examples: ForecastExamples


@dataclass(frozen=True, slots=True, kw_only=True)
class Judged:
    """One predictor's errors on every snippet."""

    name: str
    selection: str
    metric: str
    values: Shaped[np.ndarray, " n"]
    valid: Bool[np.ndarray, " n"]


def evaluate(config: Evaluate) -> OpenLoop:
    """Runs every predictor on every snippet to be judged."""
    recordings = open_data(config.data)
    horizon = ticks(config.horizon, config.dt)
    predictors = load_predictors(config.predictors, horizon=horizon, dt_s=config.dt)
    allowed, part = ticks_to_judge(recordings, predictors, config.part, dt_s=config.dt)
    index = index_snippets(recordings, dt_s=config.dt, horizon_s=config.horizon)
    index = keep_within(index, allowed)
    judged, subset = _judge(recordings, index, predictors, config.predictors)
    named = dict(zip(config.predictors, predictors, strict=True))
    return OpenLoop(
        rows=_rows(config, named, judged, subset, index.recording),
        manifest={
            "data": config.data,
            "data_hash": recordings.data_hash(),
            "predictors": {name: dict(p.about) for name, p in named.items()},
            "privileged": [name for name, p in named.items() if p.privileged],
            "horizon_s": config.horizon,
            "dt_s": config.dt,
            "part": part,
            "recordings": len(np.unique(index.recording)),
            "snippets": len(index),
            "moving snippets": int(subset["moving"].sum()),
            "best-of-3": "the lowest final error among the three most probable modes",
            "intervals": "95 %, bootstrap over recordings",
        },
        examples=_examples(recordings, index, subset["moving"], predictors, config.predictors),
    )


def batches(
    recordings: Recordings, index: SnippetIndex, description: str
) -> Iterator[tuple[slice, Scene, Future]]:
    """Scenes and futures of the snippets, some at a time, with a progress bar."""
    for start in track(range(0, len(index), BATCH), description=description, transient=True):
        rows = slice(start, min(start + BATCH, len(index)))
        some = index.select(np.arange(rows.start, rows.stop))
        yield rows, gather_scene(recordings, some), gather_future(recordings, some)


def ask(predictor: Predictor, scene: Scene, future: Future, horizon: int) -> Forecast:
    """The forecast; only privileged predictors are handed the future.

    Raises:
        AspEnvError: a target is left out, so that tables would compare different targets.
    """
    forecast = predictor.predict(scene, future if predictor.privileged else None)
    if not forecast.valid.all():
        raise AspEnvError(f"{predictor.name} leaves out targets with a full history")
    if forecast.states.shape[2] < horizon:
        raise AspEnvError(f"{predictor.name} forecasts less than {horizon} ticks")
    return forecast


def _judge(
    recordings: Recordings,
    index: SnippetIndex,
    predictors: Sequence[Predictor],
    names: Sequence[str],
) -> tuple[list[Judged], dict[str, Bool[np.ndarray, " n"]]]:
    values: dict[tuple[str, str, str], np.ndarray] = {}
    masks: dict[tuple[str, str, str], np.ndarray] = {}
    subset = {"all": np.ones(len(index), dtype=bool), "moving": np.zeros(len(index), dtype=bool)}
    for rows, scene, future in batches(recordings, index, "evaluating"):
        truth = future.states[..., :2]
        subset["moving"][rows] = moving(scene.target_states, truth, future.valid)
        for predictor, name in zip(predictors, names, strict=True):
            forecast = ask(predictor, scene, future, index.horizon)
            modes = forecast.states[:, :, : index.horizon, :2]
            for selection in SELECTIONS:
                said = (modes, forecast.log_probs, truth, future.valid, selection)
                errors = open_loop_errors(*said) | errors_over_time(*said, dt_s=index.dt_s)
                for metric, error in errors.items():
                    key = (name, selection, metric)
                    values.setdefault(key, np.zeros(len(index)))[rows] = error.value
                    masks.setdefault(key, np.zeros(len(index), dtype=bool))[rows] = error.valid
    judged = [
        Judged(name=key[0], selection=key[1], metric=key[2], values=found, valid=masks[key])
        for key, found in values.items()
    ]
    return judged, subset


def _rows(
    config: Evaluate,
    predictors: Mapping[str, Predictor],
    judged: Sequence[Judged],
    subsets: dict[str, Bool[np.ndarray, " n"]],
    groups: Shaped[np.ndarray, " n"],
) -> list[Row]:
    reference = {
        each.selection: each.values
        for each in judged
        if each.name == REFERENCE and each.metric == "FDE"
    }
    rows: list[Row] = []
    for each in judged:
        for subset, member in subsets.items():
            keep = member & each.valid
            if not keep.any():
                continue
            estimates = {each.metric: intervals.mean(each.values[keep], groups[keep])}
            compared = each.metric == "FDE" and reference and each.name != REFERENCE
            if compared and (standard := reference[each.selection][keep]).any():
                estimates["FDE / constant velocity"] = intervals.ratio(
                    each.values[keep], standard, groups[keep]
                )
            rows += [
                Row(
                    data=config.data,
                    predictor=each.name,
                    trained_on=predictors[each.name].about.get("trained_on", ""),
                    view=predictors[each.name].about.get("view", ""),
                    preset=predictors[each.name].about.get("preset", ""),
                    horizon_s=config.horizon,
                    selection=each.selection,
                    subset=subset,
                    metric=metric,
                    value=estimate.value,
                    low=estimate.low,
                    high=estimate.high,
                    n=estimate.n,
                )
                for metric, estimate in estimates.items()
            ]
    return rows


def _examples(
    recordings: Recordings,
    index: SnippetIndex,
    member: Bool[np.ndarray, " n"],
    predictors: Sequence[Predictor],
    names: Sequence[str],
) -> ForecastExamples:
    """Some situations with moving targets, the same for the same index."""
    usable = np.flatnonzero(member) if member.any() else np.arange(len(index))
    keys = np.stack([index.recording[usable], index.tick[usable]], axis=-1)
    situations, counts = np.unique(keys, axis=0, return_counts=True)
    rich = np.flatnonzero(counts >= min(2, counts.max()))
    picked = situations[rich[np.linspace(0, len(rich) - 1, min(PICTURES, len(rich))).astype(int)]]
    shown = (keys[:, None] == picked[None]).all(axis=-1).any(axis=-1)
    some = index.select(usable[shown])
    scene, future = gather_scene(recordings, some), gather_future(recordings, some)
    where = [
        f"recording {recordings.names[recording]}, {tick * index.dt_s:.1f} s"
        for recording, tick in picked.tolist()
    ]
    return ForecastExamples(
        scene=scene,
        future=future,
        forecasts={
            name: ask(predictor, scene, future, index.horizon)
            for name, predictor in zip(names, predictors, strict=True)
        },
        captions=tuple(where),
    )
