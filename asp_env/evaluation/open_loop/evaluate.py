"""`asp-env evaluate`: forecasts compared with the recorded future, on snippets of recordings."""

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
from asp_env.data.scenarios.scenario import find_scenarios
from asp_env.data.snippets import (
    HISTORY_S,
    SnippetIndex,
    gather_future,
    gather_scene,
    index_snippets,
)
from asp_env.data.source import Recordings, open_data
from asp_env.evaluation import statistics
from asp_env.evaluation.open_loop.scoring import (
    ALL_MODES,
    ForecastScores,
    MetricValues,
    ModeProbabilities,
    complete_forecast,
    score_forecasts,
)
from asp_env.evaluation.regret import RegretScores, load_candidate_planner, score_regrets
from asp_env.evaluation.report import ForecastExamples, check_report_possible, write_report
from asp_env.evaluation.results import Row, write_manifest, write_metrics
from asp_env.evaluation.selection import (
    PartChoice,
    load_predictors,
    snippets_within,
    ticks_to_evaluate,
)
from asp_env.evaluation.statistics import Estimate
from asp_env.evaluation.tables import open_loop_tables, regret_tables
from asp_env.files import atomic_folder
from asp_env.metrics.forecast.calibration import calibration_error, calibration_sums
from asp_env.metrics.forecast.errors import MODE_RULES, ModeRule
from asp_env.planning.planner import CandidatePlanner

REFERENCE = "constant-velocity"
"""If this predictor takes part, the FDE of the others is also stated as a ratio to its FDE."""

RATIO = "FDE / constant velocity"
ECE = "ECE"

NO_PLANNER = ("", "none")
"""Values of `--planner` that measure no planning regret."""

EXAMPLES = 6
"""Number of situations whose forecasts the report shows."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Evaluate:
    """Evaluate predictors in open loop: compare forecasts with the recorded future."""

    data: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="DATA")]
    """Folder in the inD/rounD or INTERACTION layout, or sample:…, synthetic:… or highway:…."""
    out: Path
    """Folder to write; it must not exist, or be empty."""
    predictors: Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME[:RUN] …")] = (
        "constant-velocity",
        "constant-turn-rate",
    )
    """Predictors by name; trained ones with their run folder."""
    horizon: float = 3.0
    """Forecast horizon in seconds."""
    dt: float = DEFAULT_DT_S
    """Duration of a tick in seconds."""
    part: PartChoice = "auto"
    """Part of DATA; auto is all of it that no predictor was
    trained or selected on."""
    history: Literal["recorded", "causal"] = "recorded"
    """Histories that predictors observe: as recorded (smoothed
    with later frames), or filtered again without later frames.
    The ground truth is always as recorded."""
    best_by: ModeRule = "fde"
    """How the best of 3 modes is chosen: lowest final error,
    lowest mean error, or the rule of the paper."""
    planner: str = "sampling"
    """Planner whose planning regret is measured with each
    predictor at states of the logged ego; none for no regret."""
    max_states: int = 2000
    """Largest number of these states; chosen at even spacing."""

    def run(self) -> None:
        """Evaluates, writes the folder and prints the tables.

        Raises:
            AspEnvError: an option or the data are bad, or a package is missing.
        """
        check_report_possible()
        with atomic_folder(self.out) as folder:
            result = evaluate(self)
            write_metrics(folder, result.rows)
            write_manifest(folder, "evaluate", **result.manifest)
            write_report(
                folder, title=f"Open loop on {Path(self.data).name}", examples=result.examples
            )
        console = Console()
        privileged = result.manifest["privileged"]
        for table in (
            *open_loop_tables(result.rows, privileged),
            *regret_tables(result.rows, privileged, planner=self.planner),
        ):
            console.print(table)
        console.print(f"wrote {self.out}/report.html")


@dataclass(frozen=True, slots=True, kw_only=True)
class OpenLoopResult:
    """Result of `evaluate`."""

    rows: list[Row]
    """Lines of `metrics.csv`."""
    manifest: dict[str, Any]
    scores: ForecastScores
    """Metrics of every snippet, for paired comparisons."""
    examples: ForecastExamples
    """Forecasts that the report shows."""


def evaluate(config: Evaluate) -> OpenLoopResult:
    """Runs every predictor on every snippet of the chosen part of DATA; writes nothing.

    Raises:
        AspEnvError: an option or the data are bad.
    """
    recordings = open_data(config.data)
    horizon = ticks(config.horizon, config.dt)
    planner = None if config.planner in NO_PLANNER else load_candidate_planner(config.planner)
    loaded = load_predictors(config.predictors, horizon=horizon, dt_s=config.dt)
    allowed, part = ticks_to_evaluate(recordings, loaded, config.part, dt_s=config.dt)
    index = index_snippets(
        recordings,
        dt_s=config.dt,
        horizon_s=config.horizon,
        history_s=max(HISTORY_S, *(predictor.history * config.dt for predictor in loaded)),
    )
    index = snippets_within(index, allowed)
    predictors = dict(zip(config.predictors, loaded, strict=True))
    scenes: Sequence[Any] = recordings
    if config.history == "causal":
        scenes = causal_histories(recordings)
    scores = score_forecasts(
        predictors, index, scenes=scenes, recorded=recordings, best_by=config.best_by
    )
    moving = scores.subsets["moving"]
    regrets = (
        None
        if planner is None
        else _regrets(config, planner, predictors, recordings, scenes, allowed)
    )
    return OpenLoopResult(
        rows=make_rows(
            scores, predictors, data=config.data, horizon_s=config.horizon, regrets=regrets
        ),
        manifest={
            "data": config.data,
            "data_hash": recordings.data_hash(),
            "predictors": {name: dict(p.metadata) for name, p in predictors.items()},
            "privileged": [name for name, p in predictors.items() if p.privileged],
            "horizon_s": config.horizon,
            "dt_s": config.dt,
            "part": part,
            "history": config.history,
            "recordings": len(np.unique(index.recording)),
            "snippets": len(index),
            "moving snippets": int(moving.sum()),
            "planner": config.planner if regrets is not None else "none",
            "states": 0 if regrets is None else len(regrets.recording),
            "best_by": config.best_by,
            "best-of-3": f"of the three most probable modes, {MODE_RULES[config.best_by]}",
            "intervals": "95 %, bootstrap over recordings",
        },
        scores=scores,
        examples=_examples(scenes, recordings, index, moving, predictors),
    )


def _regrets(
    config: Evaluate,
    planner: CandidatePlanner[Any],
    predictors: Mapping[str, Predictor],
    recordings: Recordings,
    scenes: Sequence[Any],
    allowed: Sequence[Bool[np.ndarray, " _"]],
) -> RegretScores | None:
    """Planning regret at states of all scenarios within the allowed ticks; None without any."""
    scenarios = find_scenarios(
        recordings,
        source=config.data,
        dt_s=config.dt,
        history=ticks(HISTORY_S, config.dt),
        allowed=allowed,
    )
    if not len(scenarios):
        return None
    return score_regrets(
        predictors,
        scenarios,
        planner,
        scenes=scenes,
        recorded=recordings,
        horizon=ticks(config.horizon, config.dt),
        max_states=config.max_states,
    )


def make_rows(
    scores: ForecastScores,
    predictors: Mapping[str, Predictor],
    *,
    data: str,
    horizon_s: float,
    regrets: RegretScores | None = None,
) -> list[Row]:
    """Means with intervals: a row for each predictor, selection, subset and metric that occurs.

    Args:
        scores: metrics of all snippets.
        predictors: the predictors by name.
        data: DATA as given.
        horizon_s: forecast horizon in seconds.
        regrets: planning regret of the predictors, if it was measured.
    """
    reference = {
        each.selection: each
        for each in scores.metrics
        if each.name == REFERENCE and each.metric == "FDE"
    }
    rows: list[Row] = []
    for name, predictor in predictors.items():
        estimates: list[tuple[str, str, str, Estimate]] = []
        for each in scores.metrics:
            if each.name == name:
                estimates += _estimates(each, scores, reference.get(each.selection))
        for modes in scores.modes:
            if modes.name == name:
                estimates += _calibration(modes, scores)
        if regrets is not None:
            estimates += [(ALL_MODES, *each) for each in regrets.estimates(name)]
        metadata = predictor.metadata
        rows += [
            Row(
                data=data,
                predictor=name,
                trained_on=metadata.get("trained_on", ""),
                view=metadata.get("view", ""),
                recipe=metadata.get("preset", ""),
                chaining=metadata.get("chaining", ""),
                horizon_s=horizon_s,
                selection=selection,
                subset=subset,
                metric=metric,
                value=estimate.value,
                low=estimate.low,
                high=estimate.high,
                n=estimate.n,
            )
            for selection, subset, metric, estimate in estimates
        ]
    return rows


def _estimates(
    column: MetricValues, scores: ForecastScores, reference: MetricValues | None
) -> Iterator[tuple[str, str, str, Estimate]]:
    """(selection, subset, metric, estimate) of one metric and of its ratio to the reference."""
    groups, values, selection = scores.recording, column.values, column.selection
    compared = column.metric == "FDE" and column.name != REFERENCE
    for subset, rows in _subset_rows(scores, column.valid):
        yield selection, subset, column.metric, statistics.mean(values[rows], groups[rows])
        if compared and reference is not None and reference.values[rows].any():
            ratio = statistics.ratio(values[rows], reference.values[rows], groups[rows])
            yield selection, subset, RATIO, ratio


def _calibration(
    modes: ModeProbabilities, scores: ForecastScores
) -> Iterator[tuple[str, str, str, Estimate]]:
    sums = calibration_sums(modes.probabilities, modes.nearest)
    for subset, rows in _subset_rows(scores, modes.valid):
        estimate = statistics.from_sums(sums[rows], scores.recording[rows], calibration_error)
        yield ALL_MODES, subset, ECE, estimate


def _subset_rows(
    scores: ForecastScores, valid: Bool[np.ndarray, " n"]
) -> Iterator[tuple[str, Int[np.ndarray, " m"]]]:
    """Name and valid rows of every subset that has any."""
    for subset, member in scores.subsets.items():
        rows = np.flatnonzero(member & valid)
        if len(rows):
            yield subset, rows


def _examples(
    scenes: Sequence[Any],
    recorded: Recordings,
    index: SnippetIndex,
    moving: Bool[np.ndarray, " n"],
    predictors: Mapping[str, Predictor],
) -> ForecastExamples:
    """Forecasts in evenly spaced situations with at least two moving targets, if there are any."""
    usable = np.flatnonzero(moving) if moving.any() else np.arange(len(index))
    keys = np.stack([index.recording[usable], index.tick[usable]], axis=-1)
    situations, counts = np.unique(keys, axis=0, return_counts=True)
    rich = np.flatnonzero(counts >= min(2, counts.max()))
    spaced = np.linspace(0, len(rich) - 1, min(EXAMPLES, len(rich))).astype(int)
    chosen = situations[rich[spaced]]
    shown = (keys[:, None] == chosen[None]).all(axis=-1).any(axis=-1)
    snippets = index.select(usable[shown])
    scene, future = gather_scene(scenes, snippets), gather_future(recorded, snippets)
    captions = [
        f"recording {recorded.names[recording]}, {tick * index.dt_s:.1f} s"
        for recording, tick in chosen.tolist()
    ]
    return ForecastExamples(
        scene=scene,
        future=future,
        forecasts={
            name: complete_forecast(predictor, scene, future, index.horizon_ticks)
            for name, predictor in predictors.items()
        },
        captions=tuple(captions),
    )
