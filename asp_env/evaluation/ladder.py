"""The ladder of controls: forecasts of known quality, to which methods are compared.

A rung of the ladder is a forecast between constant velocity (share 0) and the recorded future
(share 1): `constant-velocity`, `blend:0.25`, `blend:0.5`, `blend:0.75`, `oracle`. The *oracle
share* of a method is the share at which the ladder has the method's score. The *headroom* score is
the method's gain over constant velocity as a share of the oracle's.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from asp_env.evaluation.statistics import Estimate, interval

BASELINE = "constant-velocity"
"""The rung of share 0."""

ORACLE = "oracle"
"""The rung of share 1."""

CONTROLS = ("blind", BASELINE, "blend:0.25", "blend:0.5", "blend:0.75", ORACLE)
"""Predictors that `drive --controls` adds to a comparison."""

MIN_RUNGS = 3
"""An oracle share needs the baseline, the oracle and at least one rung between them."""

_ROUNDING = 1e-9
"""Scores that differ by less are equal. Chosen by hand: above the rounding of means of scores."""


def rung(predictor: str) -> float | None:
    """The share of the recorded future in the forecasts of a predictor.

    Args:
        predictor: name of the predictor as given, such as `blend:0.25`.

    Returns:
        The share from 0 to 1, or None if the predictor is not on the ladder.
    """
    if predictor in (BASELINE, ORACLE):
        return float(predictor == ORACLE)
    kind, _, argument = predictor.partition(":")
    if kind != "blend":
        return None
    try:
        share = float(argument)
    except ValueError:
        return None
    return share if 0 < share < 1 else None


def isotonic(values: Float[np.ndarray, "... rungs"]) -> Float[np.ndarray, "... rungs"]:
    """The non-decreasing sequence that is nearest to a sequence in least squares.

    The result is that of pooling adjacent violators, in the closed form
    `max over a <= i of min over b >= i of mean(values[a..b])` (Robertson, Wright and Dykstra,
    "Order Restricted Statistical Inference", 1988, chapter 1).

    Args:
        values: any number of sequences.
    """
    count = values.shape[-1]
    sums = np.concatenate([np.zeros((*values.shape[:-1], 1)), np.cumsum(values, axis=-1)], axis=-1)
    first, last = np.arange(count)[:, None], np.arange(count)
    means = (sums[..., None, 1:] - sums[..., :-1, None]) / np.maximum(last - first + 1, 1)
    fitted = [means[..., : i + 1, i:].min(axis=-1).max(axis=-1) for i in range(count)]
    return np.stack(fitted, axis=-1)


def oracle_shares(
    scores: Float[np.ndarray, " draws"],
    ladder: Float[np.ndarray, "draws rungs"],
    shares: Float[np.ndarray, " rungs"],
) -> Float[np.ndarray, " draws"]:
    """Position of a method's score on the ladder, draw by draw.

    The scores of the ladder are made monotone by isotonic regression and interpolated linearly
    between the rungs. A score that the ladder has over a range of shares gives the middle of the
    range. The share is clipped to the ladder: 0 below constant velocity and 1 above the oracle.

    Args:
        scores: mean score of the method, in the samples and in each resample.
        ladder: mean scores of the rungs in the same samples and resamples.
        shares: share of each rung, in increasing order.
    """
    fitted = isotonic(ladder)
    below = (fitted < scores[:, None] - _ROUNDING).sum(axis=-1)
    not_above = (fitted <= scores[:, None] + _ROUNDING).sum(axis=-1)
    return (
        _crossing(scores, fitted, shares, below) + _crossing(scores, fitted, shares, not_above)
    ) / 2


def _crossing(
    scores: Float[np.ndarray, " draws"],
    fitted: Float[np.ndarray, "draws rungs"],
    shares: Float[np.ndarray, " rungs"],
    upper: np.ndarray,
) -> Float[np.ndarray, " draws"]:
    """The share at which the line between the rungs `upper - 1` and `upper` has the score.

    Args:
        scores: the scores.
        fitted: non-decreasing scores of the rungs.
        shares: share of each rung.
        upper: index of the upper rung; 0 is before the first rung, the number of rungs is after
            the last.
    """
    top = len(shares) - 1
    left, right = np.clip(upper - 1, 0, top), np.clip(upper, 0, top)
    draw = np.arange(len(scores))
    rise = fitted[draw, right] - fitted[draw, left]
    part = np.where(rise > 0, (scores - fitted[draw, left]) / np.where(rise > 0, rise, 1.0), 0.0)
    return shares[left] + np.clip(part, 0.0, 1.0) * (shares[right] - shares[left])


def headroom(
    scores: Float[np.ndarray, " draws"],
    baseline: Float[np.ndarray, " draws"],
    oracle: Float[np.ndarray, " draws"],
    *,
    n: int,
) -> Estimate:
    """The headroom score `(S - S_cv) / (S_oracle - S_cv)`, a ratio of sums.

    Args:
        scores: mean score of the method, in the samples and in each resample.
        baseline: mean score of constant velocity, in the same samples and resamples.
        oracle: mean score of the oracle.
        n: number of samples.

    Returns:
        The score with its interval. It is NaN without an interval if the interval of the
        denominator contains 0 or does not exist: the ratio is then not resolved.
    """
    gain = interval(oracle - baseline, n=n)
    if gain.low is None or gain.high is None or gain.low <= 0 <= gain.high:
        return Estimate(value=np.nan, low=None, high=None, n=n)
    with np.errstate(invalid="ignore", divide="ignore"):
        return interval((scores - baseline) / (oracle - baseline), n=n)


def is_under_test(predictor: str, *, privileged: bool) -> bool:
    """Whether a predictor is compared for its own sake, and not a control.

    Args:
        predictor: name of the predictor as given; empty for a method without forecasts.
        privileged: whether the method is given the recorded future.
    """
    return bool(predictor) and not privileged and predictor not in CONTROLS


def missing_controls(predictors: Sequence[str]) -> tuple[str, ...]:
    """The controls that a comparison lacks, in the order of `CONTROLS`.

    Args:
        predictors: names of the predictors that take part.
    """
    return tuple(name for name in CONTROLS if name not in predictors)
