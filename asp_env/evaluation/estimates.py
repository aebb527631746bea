"""From every snippet's metrics to rows of a table: means and their intervals, by subset."""

from collections.abc import Iterator, Mapping

import numpy as np
from jaxtyping import Bool, Int

from asp_env.data.predictor import Predictor
from asp_env.evaluation import intervals
from asp_env.evaluation.forecast_errors import ALL_MODES
from asp_env.evaluation.intervals import Estimate
from asp_env.evaluation.judging import Judged, Judgement, ModeProbabilities
from asp_env.evaluation.output import Row
from asp_env.metrics.calibration import calibration_error, calibration_sums

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
        about = predictor.about
        rows += [
            Row(
                data=data,
                predictor=name,
                trained_on=about.get("trained_on", ""),
                view=about.get("view", ""),
                preset=about.get("preset", ""),
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
        yield each.selection, subset, each.metric, intervals.mean(each.values[keep], groups[keep])
        if compared and reference is not None and reference.values[keep].any():
            ratio = intervals.ratio(each.values[keep], reference.values[keep], groups[keep])
            yield each.selection, subset, RATIO, ratio


def _calibration(
    modes: ModeProbabilities, judgement: Judgement
) -> Iterator[tuple[str, str, str, Estimate]]:
    sums = calibration_sums(modes.probabilities, modes.nearest)
    for subset, keep in _kept(judgement, modes.valid):
        estimate = intervals.of_sums(sums[keep], judgement.recording[keep], calibration_error)
        yield ALL_MODES, subset, ECE, estimate


def _kept(
    judgement: Judgement, valid: Bool[np.ndarray, " n"]
) -> Iterator[tuple[str, Int[np.ndarray, " m"]]]:
    """Rows of every subset in which anything is valid."""
    for subset, member in judgement.subsets.items():
        keep = np.flatnonzero(member & valid)
        if len(keep):
            yield subset, keep
