"""`asp-env evaluate`: forecasts compared with the recorded future, on snippets of recordings."""

import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tyro
from jaxtyping import Bool, Int

from asp_env.console import text_console
from asp_env.data.histories import History, histories
from asp_env.data.predictor import Predictor
from asp_env.data.recording import DEFAULT_DT_S, ticks
from asp_env.data.scenarios.scenario import SHORT_HISTORY_S, all_shorter, find_scenarios
from asp_env.data.snippets import (
    HISTORY_S,
    SnippetIndex,
    gather_future,
    gather_scene,
    index_snippets,
)
from asp_env.data.source import Recordings, open_readable
from asp_env.errors import AspEnvError
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
from asp_env.evaluation.results import (
    Row,
    fallback_sentences,
    fallback_shares,
    write_manifest,
    write_metrics,
)
from asp_env.evaluation.selection import (
    PartChoice,
    expand_runs,
    load_predictors,
    shared_metadata,
    snippets_within,
    ticks_to_evaluate,
    with_fallback,
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
    """Predictors by name; trained ones with their run folder.
    A pattern in quotes, such as 'ffw-asp:runs/*', is one method of several runs."""
    horizon: float = 3.0
    """Forecast horizon in seconds."""
    dt: float = DEFAULT_DT_S
    """Duration of a tick in seconds."""
    part: PartChoice = "auto"
    """Part of DATA; auto is all of it that no predictor was
    trained or selected on."""
    history: History = "recorded"
    """Histories that predictors observe: as recorded (smoothed
    with later frames); filtered again without later frames
    (causal); or as recorded, with the accelerations of the
    files in past actions (accelerations). The ground truth is
    always as recorded."""
    parked: bool = False
    """Count parked vehicles as targets, too."""
    best_by: ModeRule = "fde"
    """How the best of 3 modes is chosen: lowest final error,
    lowest mean error, or the rule of the paper."""
    planner: str = "sampling"
    """Planner whose planning regret is measured with each
    predictor at states of the logged ego; none for no regret."""
    max_states: int = 2000
    """Largest number of these states; chosen at even spacing."""
    fallback: bool = False
    """Guard every trained predictor: where a scene lies outside
    of what it learned, its forecast is blended to constant
    velocity. As naming it guarded:NAME:RUN."""

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
        console = text_console()
        privileged = result.manifest["privileged"]
        for table in (
            *open_loop_tables(result.rows, privileged),
            *regret_tables(result.rows, privileged, planner=self.planner),
        ):
            console.print(table)
        for sentence in fallback_sentences(result.manifest["fallback"], "targets"):
            console.print(sentence)
        console.print(f"wrote {self.out}/report.html")


@dataclass(frozen=True, slots=True, kw_only=True)
class OpenLoopResult:
    """Result of `evaluate`."""

    rows: list[Row]
    """Lines of `metrics.csv`."""
    manifest: dict[str, Any]
    scores: ForecastScores
    """Metrics of every snippet by the name of the run, for paired comparisons."""
    examples: ForecastExamples
    """Forecasts that the report shows; of a method of several runs those of the first run."""


def evaluate(config: Evaluate) -> OpenLoopResult:
    """Runs every predictor on every snippet of the chosen part of DATA; writes nothing.

    Raises:
        AspEnvError: an option or the data are bad.
    """
    if config.max_states < 1:
        raise AspEnvError(f"--max-states {config.max_states}: expected at least 1")
    recordings = open_readable(config.data, dt_s=config.dt)
    horizon = ticks(config.horizon, config.dt)
    planner = None if config.planner in NO_PLANNER else load_candidate_planner(config.planner)
    named = with_fallback(config.predictors) if config.fallback else config.predictors
    runs = expand_runs(named)
    names = [run for members in runs.values() for run in members]
    loaded = load_predictors(names, horizon=horizon, dt_s=config.dt)
    allowed, part = ticks_to_evaluate(recordings, loaded, config.part, dt_s=config.dt)
    index = snippets_within(_snippets(config, recordings, loaded), allowed)
    predictors = dict(zip(names, loaded, strict=True))
    scenes = histories(recordings, config.history)
    scores = score_forecasts(
        predictors, index, scenes=scenes, recorded=recordings, best_by=config.best_by
    )
    moving = scores.subsets["moving"]
    regrets = (
        None
        if planner is None
        else _regrets(config, planner, predictors, recordings, scenes, allowed)
    )
    rows = make_rows(
        scores, predictors, runs, data=config.data, horizon_s=config.horizon, regrets=regrets
    )
    return OpenLoopResult(
        rows=rows,
        manifest={
            "data": config.data,
            "data_hash": recordings.data_hash(),
            "resampled": recordings.resampled(),
            "predictors": {name: dict(p.metadata) for name, p in predictors.items()},
            "runs": {name: list(members) for name, members in runs.items() if members != (name,)},
            "privileged": [name for name, (run, *_) in runs.items() if predictors[run].privileged],
            "horizon_s": config.horizon,
            "dt_s": config.dt,
            "part": part,
            "history": config.history,
            "parked": config.parked,
            "recordings": len(np.unique(index.recording)),
            "snippets": len(index),
            "moving snippets": int(moving.sum()),
            "planner": config.planner if regrets is not None else "none",
            "states": 0 if regrets is None else len(regrets.recording),
            "fallback": fallback_shares(rows),
            "best_by": config.best_by,
            "best-of-3": f"of the three most probable modes, {MODE_RULES[config.best_by]}",
            "intervals": "95 %, bootstrap over recordings and, with several, over training runs",
        },
        scores=scores,
        examples=_examples(
            scenes,
            recordings,
            index,
            moving,
            {name: predictors[run] for name, (run, *_) in runs.items()},
        ),
    )


def _snippets(
    config: Evaluate, recordings: Recordings, predictors: Sequence[Predictor]
) -> SnippetIndex:
    """All snippets; of recordings that are all too short those with the shortest usual history.

    Raises:
        AspEnvError: a predictor needs a longer history than all recordings have.
    """
    needed_s = max(predictor.history * config.dt for predictor in predictors)
    history_s = max(HISTORY_S, needed_s)
    if all_shorter(recordings, history_s + config.horizon):
        history_s = max(SHORT_HISTORY_S, needed_s)
        if all_shorter(recordings, history_s + config.horizon):
            longest_s = max((each.num_frames - 1) / each.frame_rate_hz for each in recordings)
            raise AspEnvError(
                f"data {config.data!r}: no recording lasts {history_s + config.horizon:g} s, for "
                f"{history_s:g} s of history and --horizon {config.horizon:g}; the longest lasts "
                f"{longest_s:g} s: give a shorter --horizon, or other predictors or data"
            )
        warnings.warn(
            f"data {config.data!r}: no recording lasts {HISTORY_S + config.horizon:g} s, so that "
            f"predictors observe {history_s:g} s of history instead of {HISTORY_S:g} s",
            stacklevel=3,
        )
    return index_snippets(
        recordings,
        dt_s=config.dt,
        horizon_s=config.horizon,
        history_s=history_s,
        parked=config.parked,
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
    runs: Mapping[str, Sequence[str]],
    *,
    data: str,
    horizon_s: float,
    regrets: RegretScores | None = None,
) -> list[Row]:
    """Means with intervals: a row for each predictor, selection, subset and metric that occurs.

    Args:
        scores: metrics of all snippets, by the name of the run.
        predictors: the predictors by the name of their run.
        runs: names of the runs that are averaged, by the name of the row.
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
    for stream, (name, members) in enumerate(runs.items()):
        estimates: list[tuple[str, str, str, Estimate]] = []
        columns: dict[tuple[str, str], list[MetricValues]] = {}
        for each in scores.metrics:
            if each.name in members:
                columns.setdefault((each.selection, each.metric), []).append(each)
        for group in columns.values():
            estimates += _estimates(group, scores, reference.get(group[0].selection), stream)
        modes = [each for each in scores.modes if each.name in members]
        if modes:
            estimates += _calibration(modes, scores, stream)
        if regrets is not None:
            estimates += [(ALL_MODES, *each) for each in regrets.estimates(*members, stream=stream)]
        loaded = [predictors[run] for run in members]
        rows += [
            Row(
                data=data,
                predictor=name,
                trained_on=shared_metadata(loaded, "trained_on"),
                view=shared_metadata(loaded, "view"),
                recipe=shared_metadata(loaded, "preset"),
                chaining=shared_metadata(loaded, "chaining"),
                horizon_s=horizon_s,
                selection=selection,
                subset=subset,
                metric=metric,
                value=estimate.value,
                low=estimate.low,
                high=estimate.high,
                n=estimate.n,
                runs=len(members),
            )
            for selection, subset, metric, estimate in estimates
        ]
    return rows


def _estimates(
    runs: Sequence[MetricValues],
    scores: ForecastScores,
    reference: MetricValues | None,
    stream: int,
) -> Iterator[tuple[str, str, str, Estimate]]:
    """(selection, subset, metric, estimate) of one metric and of its ratio to the reference."""
    selection, metric = runs[0].selection, runs[0].metric
    values = np.stack([each.values for each in runs])
    valid = np.stack([each.valid for each in runs])
    compared = metric == "FDE" and runs[0].name != REFERENCE
    for subset, rows in _subset_rows(scores, np.asarray(valid.any(axis=0))):
        groups, known = scores.recording[rows], valid[:, rows]
        sums = np.where(known, values[:, rows], 0)
        mean = statistics.ratio_over_runs(sums, known, groups, stream=stream)
        yield selection, subset, metric, mean
        if compared and reference is not None and reference.values[rows].any():
            ratio = statistics.ratio_over_runs(
                values[:, rows], reference.values[rows], groups, stream=stream
            )
            yield selection, subset, RATIO, ratio


def _calibration(
    runs: Sequence[ModeProbabilities], scores: ForecastScores, stream: int
) -> Iterator[tuple[str, str, str, Estimate]]:
    """The calibration error, which is computed for every run and then averaged."""
    sums = np.stack([calibration_sums(each.probabilities, each.nearest) for each in runs])
    valid = np.all([each.valid for each in runs], axis=0)
    for subset, rows in _subset_rows(scores, valid):
        by_run = statistics.run_sums(sums[:, rows], scores.recording[rows])
        with np.errstate(invalid="ignore", divide="ignore"):
            errors = calibration_error(by_run)
        draws = statistics.average_runs(errors, stream=stream)
        yield ALL_MODES, subset, ECE, statistics.interval(draws, n=len(rows))


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
