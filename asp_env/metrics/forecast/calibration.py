"""Whether probabilities of modes mean what they say. N targets, M modes, T ticks.

The event that a mode's probability speaks of is that this mode is the nearest to the truth at the
last tick.
"""

import math

import numpy as np
from jaxtyping import Bool, Float

from asp_env.metrics.masked import Masked

NLL_SIGMA_M = 1.0
"""Standard deviation of each mode's Gaussian in x and in y; the unit variance of l5kit's NLL."""

BINS = 10


def mixture_nll(
    ends: Float[np.ndarray, "n m 2"],
    log_probs: Float[np.ndarray, "n m"],
    true_end: Float[np.ndarray, "n 2"],
    valid: Bool[np.ndarray, " n"],
) -> Masked:
    """Per target, -log Σ_m p_m N(x; μ_m, s² I) at the last tick, nats; s = 1 m.

    x is where the target ends and μ_m where mode m does. A single sure mode that is right has
    log 2π = 1.84, and one that is off FDE² / 2 more. Any number of modes; missing where the end of
    the truth is not known.
    """
    off = ((ends - true_end[:, None]).astype(np.float64) ** 2).sum(axis=-1)
    exponents = log_probs - off / (2 * NLL_SIGMA_M**2)
    highest = exponents.max(axis=1, keepdims=True)
    total = highest[:, 0] + np.log(np.exp(exponents - highest).sum(axis=1))
    return Masked(value=math.log(2 * math.pi * NLL_SIGMA_M**2) - total, valid=valid)


def nearest_modes(
    ends: Float[np.ndarray, "n m 2"], true_end: Float[np.ndarray, "n 2"]
) -> Float[np.ndarray, "n m"]:
    """(n, m) 1 for the mode nearest to the truth at the end, 0 for others; k equals get 1/k."""
    off = np.linalg.vector_norm(ends - true_end[:, None], axis=-1)
    nearest = off == off.min(axis=1, keepdims=True)
    return nearest / nearest.sum(axis=1, keepdims=True)


def brier(
    log_probs: Float[np.ndarray, "n m"],
    nearest: Float[np.ndarray, "n m"],
    valid: Bool[np.ndarray, " n"],
) -> Masked:
    """Per target, Σ_m (p_m - y_m)² with y from `nearest_modes`: 0 is right and sure, 2 the worst.

    Missing where the end of the truth is not known, and for forecasts of a single mode, which are
    always sure and always right about it.
    """
    value = ((np.exp(log_probs) - nearest) ** 2).sum(axis=1)
    return Masked(value=value, valid=valid & (log_probs.shape[1] > 1))


def calibration_sums(
    probabilities: Float[np.ndarray, "n m"], nearest: Float[np.ndarray, "n m"]
) -> Float[np.ndarray, "n bins 3"]:
    """What each target adds to each bin: its modes' number, probabilities, and y.

    Ten bins of equal width by probability; the last one holds 1. Sums over targets of one
    recording, or of a resample, are what `calibration_error` takes.
    """
    at = np.minimum((probabilities * BINS).astype(np.int64), BINS - 1)
    sums = np.zeros((len(at), BINS, 3))
    rows = np.repeat(np.arange(len(at)), at.shape[1])
    whole = np.stack([np.ones_like(nearest), probabilities, nearest], axis=-1)
    np.add.at(sums, (rows, at.reshape(-1)), whole.reshape(-1, 3))
    return sums


def calibration_error(sums: Float[np.ndarray, "*batch bins 3"]) -> Float[np.ndarray, "*batch"]:
    """Expected calibration error of the modes of all targets together, from 0 to 1.

    Σ_b n_b / n · |mean p - mean y| over the bins of `calibration_sums`; NaN of no modes. Few
    targets overstate it, since chance differences add up whatever their sign. It does not apply to
    forecasts of a single mode.
    """
    count, said, came = np.moveaxis(sums, -1, 0)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(np.abs(said - came).sum(axis=-1) / count.sum(axis=-1))
