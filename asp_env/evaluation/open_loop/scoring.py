"""All open-loop metrics of all snippets: predictors are compared with the ground truth in batches.

`score_forecasts` is the entry point. The values of every snippet are returned, so that means,
intervals and subsets are computed from the same arrays (`asp_env.evaluation.open_loop.evaluate`).
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, final

import numpy as np
from jaxtyping import Bool, Float, Int
from rich.progress import track

from asp_env.data.classes import AgentClass
from asp_env.data.predictor import Forecast, Predictor
from asp_env.data.recording import ticks
from asp_env.data.scene import Scene
from asp_env.data.snippets import (
    HISTORY_S,
    SNIPPET_INTERVAL_S,
    Future,
    SnippetIndex,
    gather_scene,
)
from asp_env.errors import AspEnvError
from asp_env.evaluation.open_loop.ground_truth import GroundTruth, gather_ground_truth
from asp_env.evaluation.results import FALLBACK
from asp_env.metrics.forecast.calibration import brier, mixture_nll, nearest_modes
from asp_env.metrics.forecast.errors import (
    SELECTIONS,
    Manoeuvre,
    ModeRule,
    errors_over_time,
    inconsistency,
    manoeuvres,
    open_loop_errors,
    select_mode,
)
from asp_env.metrics.forecast.feasibility import (
    infeasible_modes,
    off_road_modes,
    overlapping_modes,
)
from asp_env.metrics.masked import Masked

BATCH = 256
"""Number of snippets whose scenes are in memory at once. Chosen by hand; it changes no result."""

ALL_MODES = ""
"""The selection of metrics of all modes together."""


@dataclass(frozen=True, slots=True, kw_only=True)
class MetricValues:
    """One metric of one predictor on N snippets."""

    name: str
    """Name of the predictor."""
    selection: str
    metric: str
    values: Float[np.ndarray, " n"]
    valid: Bool[np.ndarray, " n"]


@dataclass(frozen=True, slots=True, kw_only=True)
class ModeProbabilities:
    """Probabilities of all M modes of one predictor on N snippets."""

    name: str
    """Name of the predictor."""
    probabilities: Float[np.ndarray, "n m"]
    nearest: Float[np.ndarray, "n m"]
    """1 for the mode whose final position is nearest to the recorded one, as `nearest_modes`."""
    valid: Bool[np.ndarray, " n"]


@dataclass(frozen=True, slots=True, kw_only=True)
class ForecastScores:
    """All metrics of all predictors on N snippets."""

    metrics: list[MetricValues]
    modes: list[ModeProbabilities]
    """Of the predictors with several modes."""
    subsets: dict[str, Bool[np.ndarray, " n"]]
    """Masks by name: `all`, `moving`, `standing`, and each `manoeuvre:…` and `class:…` that
    occurs."""
    recording: Int[np.ndarray, " n"]
    """Index of each snippet's recording, over which intervals are resampled."""

    def of(self, name: str, metric: str, selection: str) -> MetricValues:
        """One metric of one predictor.

        Raises:
            AspEnvError: there is no such metric.
        """
        for each in self.metrics:
            if (each.name, each.metric, each.selection) == (name, metric, selection):
                return each
        raise AspEnvError(
            f"{name}: no metric {metric!r} of {selection or 'all modes'} was computed"
        )


def score_forecasts(
    predictors: Mapping[str, Predictor],
    index: SnippetIndex,
    *,
    scenes: Sequence[Any],
    recorded: Sequence[Any],
    best_by: ModeRule = "fde",
) -> ForecastScores:
    """Runs every predictor on every snippet and computes all metrics.

    Args:
        predictors: predictors by the names that results have.
        index: the snippets; each must have its full history and horizon.
        scenes: the recordings that scenes are made from, as predictors observe them.
        recorded: the same recordings as ground truth, which also defines the subsets.
        best_by: rule by which the best mode is selected.

    Raises:
        AspEnvError: a predictor omits targets or forecasts less than the horizon.
    """
    count = len(index)
    table = _MetricTable(count)
    modes: dict[str, ModeProbabilities] = {}
    history = ForecastHistory(index)
    subsets = _Subsets(count, index.dt_s)
    for rows, scene, truth in batches(scenes, recorded, index, "evaluating"):
        subsets.put(rows, truth)
        on_road = stays_on_road(truth)
        for name, predictor in predictors.items():
            forecast = complete_forecast(predictor, scene, truth.future, index.horizon_ticks)
            sample = ForecastSample(
                states=forecast.states[:, :, : index.horizon_ticks],
                log_probs=forecast.log_probs,
                now=scene.target_states,
            )
            metrics = forecast_metrics(sample, truth, best_by, on_road, dt_s=index.dt_s)
            table.put(name, rows, metrics)
            table.put(name, rows, _inconsistency(history, name, rows, sample))
            table.put(name, rows, _fallback(forecast))
            if sample.log_probs.shape[1] > 1:
                _put_modes(modes, name, count, rows, sample, truth)
    return ForecastScores(
        metrics=table.columns(),
        modes=list(modes.values()),
        subsets=subsets.masks(),
        recording=index.recording,
    )


def batches(
    scenes: Sequence[Any], recorded: Sequence[Any], index: SnippetIndex, description: str
) -> Iterator[tuple[slice, Scene, GroundTruth]]:
    """Rows, scene and ground truth of `BATCH` snippets at a time, with a progress bar.

    Args:
        scenes: the recordings that scenes are made from.
        recorded: the same recordings as ground truth.
        index: the snippets.
        description: text before the bar.
    """
    for start in track(range(0, len(index), BATCH), description=description, transient=True):
        rows = slice(start, min(start + BATCH, len(index)))
        chosen = index.select(np.arange(rows.start, rows.stop))
        yield rows, gather_scene(scenes, chosen), gather_ground_truth(recorded, chosen)


def complete_forecast(predictor: Predictor, scene: Scene, future: Future, horizon: int) -> Forecast:
    """The forecast of all targets of a scene, for at least `horizon` ticks.

    Args:
        predictor: the predictor; only privileged ones receive the future.
        scene: the scene.
        future: recorded future of the targets.
        horizon: number of ticks.

    Raises:
        AspEnvError: the forecast omits a target, so that predictors would be compared on
            different targets, or it is too short.
    """
    forecast = predictor.predict(scene, future if predictor.privileged else None)
    if not forecast.valid.all():
        raise AspEnvError(f"{predictor.name} omits targets that have a full history")
    if forecast.states.shape[2] < horizon:
        raise AspEnvError(f"{predictor.name} forecasts less than {horizon} ticks")
    return forecast


@dataclass(frozen=True, slots=True, kw_only=True)
class ForecastSample:
    """Forecasts of N targets in M modes of T ticks, cut to the horizon."""

    states: Float[np.ndarray, "n m t 4"]
    log_probs: Float[np.ndarray, "n m"]
    now: Float[np.ndarray, "n 4"]
    """Observed present states, which the forecasts start from."""


def forecast_metrics(
    sample: ForecastSample,
    truth: GroundTruth,
    best_by: ModeRule,
    on_road: Bool[np.ndarray, " n"],
    *,
    dt_s: float,
) -> dict[tuple[str, str], Masked]:
    """Metrics of a batch of forecasts, by selection and name.

    Args:
        sample: the forecasts.
        truth: the ground truth of the same targets.
        best_by: rule by which the best mode is selected.
        on_road: mask of the targets for which the off-road rate is defined, see `stays_on_road`.
        dt_s: duration of a tick in seconds.
    """
    future, origin = truth.future, truth.present[:, None, :2]
    known = future.valid[:, -1]
    local = sample.states[..., :2] - origin[:, None]
    true = future.states[..., :2] - origin
    nearest = nearest_modes(local[:, :, -1], true[:, -1])
    metrics = {
        (ALL_MODES, "NLL"): mixture_nll(local[:, :, -1], sample.log_probs, true[:, -1], known),
        (ALL_MODES, "Brier"): brier(sample.log_probs, nearest, known),
    }
    violations = mode_violations(sample, truth, on_road, dt_s=dt_s)
    for metric, (violates, applies) in violations.items():
        metrics[ALL_MODES, metric] = Masked(value=violates.mean(axis=1), valid=applies)
    for selection in SELECTIONS:
        shown = (local, sample.log_probs, true, future.valid, selection, best_by)
        errors = open_loop_errors(*shown) | errors_over_time(*shown, dt_s=dt_s)
        metrics |= {(selection, metric): error for metric, error in errors.items()}
        chosen = select_mode(local, sample.log_probs, true, selection, best_by)
        for metric, (violates, applies) in violations.items():
            value = violates[np.arange(len(violates)), chosen].astype(np.float32)
            metrics[selection, metric] = Masked(value=value, valid=applies)
    return metrics


def mode_violations(
    sample: ForecastSample, truth: GroundTruth, on_road: Bool[np.ndarray, " n"], *, dt_s: float
) -> dict[str, tuple[Bool[np.ndarray, "n m"], Bool[np.ndarray, " n"]]]:
    """Which modes cannot be driven: `off-road`, `overlap` and `infeasible`.

    Args:
        sample: the forecasts.
        truth: the ground truth of the same targets.
        on_road: mask of the targets for which the off-road rate is defined, see `stays_on_road`.
        dt_s: duration of a tick in seconds.

    Returns:
        For each rule, a mask of the modes that violate it and one of the targets it applies to.
    """
    future = truth.future
    known = np.asarray(future.valid.all(axis=1))
    off_road, _ = off_road_modes(truth.maps, truth.map_index, sample.states[..., :2])
    overlap = overlapping_modes(
        sample.states,
        future.states,
        truth.sizes,
        situation=truth.situation,
        slot=truth.slot,
        others=truth.agents,
        others_valid=truth.agents_valid,
        others_sizes=truth.agents_sizes,
    )
    infeasible = infeasible_modes(sample.now, sample.states, dt_s=dt_s)
    return {
        "off-road": (off_road, on_road),
        "overlap": (overlap, known),
        "infeasible": (infeasible, np.ones(len(known), dtype=bool)),
    }


def stays_on_road(truth: GroundTruth) -> Bool[np.ndarray, " n"]:
    """Mask of the targets that stay on the drivable area from now to the end of the horizon.

    A target that leaves it, as on the way to a parking space, cannot be forecast well and stay on
    it. False for maps without drivable area.
    """
    positions = truth.states[:, None, truth.now :, :2]
    off, known = off_road_modes(truth.maps, truth.map_index, positions)
    return known & ~off[:, 0] & truth.valid[:, truth.now :].all(axis=1)


def _inconsistency(
    history: "ForecastHistory", name: str, rows: slice, sample: ForecastSample
) -> dict[tuple[str, str], Masked]:
    modes = sample.log_probs.argmax(axis=1)
    positions = sample.states[np.arange(len(sample.now)), modes, :, :2]
    earlier, paired = history.update(name, rows, positions)
    value = inconsistency(earlier, positions, paired, apart=history.apart_ticks)
    return {("most-probable", "inconsistency"): value}


def _fallback(forecast: Forecast) -> dict[tuple[str, str], Masked]:
    """Whether each target's forecast is blended to constant velocity; nothing without a guard."""
    if forecast.fallback is None:
        return {}
    blended = (forecast.fallback > 0).astype(np.float32)
    return {(ALL_MODES, FALLBACK): Masked(value=blended, valid=np.isfinite(forecast.fallback))}


def _put_modes(
    modes: dict[str, ModeProbabilities],
    name: str,
    count: int,
    rows: slice,
    sample: ForecastSample,
    truth: GroundTruth,
) -> None:
    shape = (count, sample.log_probs.shape[1])
    arrays = modes.get(name) or ModeProbabilities(
        name=name,
        probabilities=np.zeros(shape, dtype=np.float32),
        nearest=np.zeros(shape, dtype=np.float32),
        valid=np.zeros(count, dtype=bool),
    )
    future = truth.future
    arrays.probabilities[rows] = np.exp(sample.log_probs)
    arrays.nearest[rows] = nearest_modes(sample.states[:, :, -1, :2], future.states[:, -1, :2])
    arrays.valid[rows] = future.valid[:, -1]
    modes[name] = arrays


@final
class ForecastHistory:
    """Forecasts of earlier snippets of the same targets, stored as long as later ones need them.

    Attributes:
        apart_ticks: number of ticks between consecutive snippets of a target.
    """

    def __init__(self, index: SnippetIndex) -> None:
        """Pairs every snippet with that of the same track `SNIPPET_INTERVAL_S` seconds earlier."""
        self.apart_ticks = ticks(SNIPPET_INTERVAL_S, index.dt_s)
        count = len(index)
        order = np.lexsort((index.tick, index.track, index.recording))
        before, after = order[:-1], order[1:]
        follows = (index.recording[before] == index.recording[after]) & (before < after)
        follows &= index.track[before] == index.track[after]
        follows &= index.tick[before] + self.apart_ticks == index.tick[after]
        self._earlier_rows = np.full(count, -1)
        self._earlier_rows[after[follows]] = before[follows]
        needed = np.where(self._earlier_rows >= 0, self._earlier_rows, count)
        self._needed_from = np.append(np.minimum.accumulate(needed[::-1])[::-1], count)
        self._stored: dict[str, tuple[int, np.ndarray]] = {}

    def update(
        self, name: str, rows: slice, positions: Float[np.ndarray, "n t 2"]
    ) -> tuple[Float[np.ndarray, "n t 2"], Bool[np.ndarray, " n"]]:
        """Stores the forecasts of the next rows and returns those made before.

        Args:
            name: name of the predictor.
            rows: the rows that follow those of its previous call.
            positions: positions of the most probable modes, in metres.

        Returns:
            The earlier forecast of each row's target, and a mask of the rows that have one.
        """
        first, stored = self._stored.get(name, (rows.start, positions[:0]))
        stored = np.concatenate([stored, positions])
        earlier = self._earlier_rows[rows]
        paired = earlier >= 0
        before = stored[np.where(paired, earlier - first, 0)]
        start = min(int(self._needed_from[rows.stop]), rows.stop)
        self._stored[name] = (start, stored[start - first :].copy())
        return before, paired


@final
class _MetricTable:
    """Metrics of all snippets, filled batch by batch."""

    def __init__(self, count: int) -> None:
        self._count = count
        self._columns: dict[tuple[str, str, str], MetricValues] = {}

    def put(self, name: str, rows: slice, metrics: Mapping[tuple[str, str], Masked]) -> None:
        for (selection, metric), values in metrics.items():
            key = (name, selection, metric)
            if key not in self._columns:
                self._columns[key] = MetricValues(
                    name=name,
                    selection=selection,
                    metric=metric,
                    values=np.zeros(self._count, dtype=np.float32),
                    valid=np.zeros(self._count, dtype=bool),
                )
            self._columns[key].values[rows] = np.where(values.valid, values.value, 0)
            self._columns[key].valid[rows] = values.valid

    def columns(self) -> list[MetricValues]:
        """All metrics, in the order of their first values."""
        return list(self._columns.values())


@final
class _Subsets:
    """Manoeuvre and class of each snippet's target, filled batch by batch."""

    def __init__(self, count: int, dt_s: float) -> None:
        self._past_ticks = round(HISTORY_S / dt_s)
        self._manoeuvre = np.zeros(count, dtype=np.int8)
        self._class = np.zeros(count, dtype=np.int8)

    def put(self, rows: slice, truth: GroundTruth) -> None:
        first = max(0, truth.now - self._past_ticks)  # snippets may have a longer history
        self._manoeuvre[rows] = manoeuvres(
            truth.states[:, first:], truth.valid[:, first:], now=truth.now - first
        )
        self._class[rows] = truth.classes

    def masks(self) -> dict[str, Bool[np.ndarray, " n"]]:
        """`all`, `moving` and `standing`, then the manoeuvres and classes that occur."""
        standing = self._manoeuvre == Manoeuvre.STANDING
        masks = {"all": np.ones(len(standing), dtype=bool), "moving": ~standing}
        masks["standing"] = standing
        for prefix, kinds, values in (
            ("manoeuvre", Manoeuvre, self._manoeuvre),
            ("class", AgentClass, self._class),
        ):
            for kind in kinds:
                if (values == kind).any():
                    masks[f"{prefix}:{kind.name.lower()}"] = values == kind
        return masks
