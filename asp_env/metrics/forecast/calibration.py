"""Calibration of the probabilities of modes.

The probability of a mode is understood as that of being the mode nearest to the ground truth at the
last tick. Shapes: N targets, M modes.
"""

import math

import numpy as np
from jaxtyping import Bool, Float

from asp_env.metrics.masked import Masked

NLL_SIGMA_M = 1.0
"""Standard deviation of each mode's Gaussian in x and in y: the unit variance of l5kit's NLL."""

BINS = 10
"""Number of bins of equal width of the expected calibration error. Chosen by hand."""


def mixture_nll(
    ends: Float[np.ndarray, "n m 2"],
    log_probs: Float[np.ndarray, "n m"],
    true_end: Float[np.ndarray, "n 2"],
    valid: Bool[np.ndarray, " n"],
) -> Masked:
    """Negative log-likelihood of the true end, -log Σ_m p_m N(x; μ_m, s² I) with s = 1 m, nats.

    x is the end of the ground truth and μ_m that of mode m. A single certain mode has log 2π = 1.84
    if it is right, and FDE² / 2 more otherwise.

    Args:
        ends: last positions of the modes, metres.
        log_probs: log-probabilities of any number of modes.
        true_end: last position of the ground truth, metres.
        valid: targets whose true end is known.

    Returns:
        (n,) nats; missing where the true end is not known.
    """
    square = ((ends - true_end[:, None]).astype(np.float64) ** 2).sum(axis=-1)
    exponents = log_probs - square / (2 * NLL_SIGMA_M**2)
    highest = exponents.max(axis=1, keepdims=True)
    total = highest[:, 0] + np.log(np.exp(exponents - highest).sum(axis=1))
    return Masked(value=math.log(2 * math.pi * NLL_SIGMA_M**2) - total, valid=valid)


def nearest_modes(
    ends: Float[np.ndarray, "n m 2"], true_end: Float[np.ndarray, "n 2"]
) -> Float[np.ndarray, "n m"]:
    """1 for the mode that ends nearest to the ground truth, 0 for others; 1/k for k equal ones.

    Args:
        ends: last positions of the modes, metres.
        true_end: last position of the ground truth, metres.
    """
    distance = np.linalg.vector_norm(ends - true_end[:, None], axis=-1)
    nearest = distance == distance.min(axis=1, keepdims=True)
    return nearest / nearest.sum(axis=1, keepdims=True)


def brier(
    log_probs: Float[np.ndarray, "n m"],
    nearest: Float[np.ndarray, "n m"],
    valid: Bool[np.ndarray, " n"],
) -> Masked:
    """Brier score Σ_m (p_m - y_m)² of each target, from 0 (certain and right) to 2.

    Args:
        log_probs: log-probabilities of the modes.
        nearest: y, the value of `nearest_modes`.
        valid: targets whose true end is known.

    Returns:
        (n,); missing where the true end is not known, and for forecasts of a single mode, which is
        always certain and always the nearest.
    """
    value = ((np.exp(log_probs) - nearest) ** 2).sum(axis=1)
    return Masked(value=value, valid=valid & (log_probs.shape[1] > 1))


def calibration_sums(
    probabilities: Float[np.ndarray, "n m"], nearest: Float[np.ndarray, "n m"]
) -> Float[np.ndarray, "n bins 3"]:
    """Contribution of each target to each bin of the calibration error.

    The ten bins have equal widths by probability; the last one contains 1. `calibration_error`
    takes the sums over the targets of a recording or of a resample.

    Args:
        probabilities: of the modes.
        nearest: y, the value of `nearest_modes`.

    Returns:
        Number of modes, sum of their probabilities and sum of their y.
    """
    bins = np.minimum((probabilities * BINS).astype(np.int64), BINS - 1)
    sums = np.zeros((len(bins), BINS, 3))
    rows = np.repeat(np.arange(len(bins)), bins.shape[1])
    terms = np.stack([np.ones_like(nearest), probabilities, nearest], axis=-1)
    np.add.at(sums, (rows, bins.reshape(-1)), terms.reshape(-1, 3))
    return sums


def calibration_error(sums: Float[np.ndarray, "*batch bins 3"]) -> Float[np.ndarray, "*batch"]:
    """Expected calibration error of the modes of all targets together, from 0 to 1.

    This is Σ_b n_b / n · |mean p - mean y| over the bins. It is overestimated for few targets,
    since random differences add up regardless of their sign, and does not apply to forecasts of a
    single mode.

    Args:
        sums: sums of `calibration_sums` over targets.

    Returns:
        The error; NaN without modes.
    """
    count, probability, frequency = np.moveaxis(sums, -1, 0)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(np.abs(probability - frequency).sum(axis=-1) / count.sum(axis=-1))
