"""Means and ratios with confidence intervals by a bootstrap over recordings.

Snippets and episodes of one recording are not independent, so whole recordings are resampled (the
cluster bootstrap: Davison and Hinkley, "Bootstrap Methods and their Application", 1997, section
3.8). With n recordings, a resample draws n of them with replacement. An interval lies between the
2.5 % and the 97.5 % quantile of the statistic over 2000 resamples (the percentile interval: Efron
and Tibshirani, "An Introduction to the Bootstrap", 1993, chapter 13).

Every statistic is a function of sums over samples. If `S_g` is the sum over the samples of
recording g and `w_g` how often a resample contains g, the statistic of that resample is
`f(sum_g w_g S_g)`. Resamples depend on the number of recordings alone, so statistics of several
methods on the same recordings are paired.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from jaxtyping import Float, Shaped

RESAMPLES = 2000
"""Number of bootstrap resamples. Chosen by hand."""

LEVEL = 0.95
"""Confidence level of all intervals."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Estimate:
    """A statistic and its confidence interval."""

    value: float
    low: float | None
    """Lower bound; None if all samples are from one recording."""
    high: float | None
    """Upper bound; None if all samples are from one recording."""
    n: int
    """Number of samples."""


def mean(values: Shaped[np.ndarray, " n"], groups: Shaped[np.ndarray, " n"]) -> Estimate:
    """Mean over all samples.

    Args:
        values: one value for each of n > 0 samples.
        groups: recording that each sample is from, as numbers or names.
    """
    return ratio(values, np.ones(len(values)), groups)


def ratio(
    numerators: Shaped[np.ndarray, " n"],
    denominators: Shaped[np.ndarray, " n"],
    groups: Shaped[np.ndarray, " n"],
) -> Estimate:
    """Ratio of two sums, `sum(numerators) / sum(denominators)`.

    Both sums are of the same resample, so a ratio of two methods is paired.

    Args:
        numerators: one value for each of n > 0 samples.
        denominators: one value for each sample.
        groups: recording that each sample is from, as numbers or names.
    """
    parts = np.stack([numerators, denominators], axis=-1)
    return from_sums(parts, groups, lambda sums: sums[..., 0] / sums[..., 1])


def from_sums(
    parts: Shaped[np.ndarray, "n ..."],
    groups: Shaped[np.ndarray, " n"],
    statistic: Callable[[np.ndarray], np.ndarray],
) -> Estimate:
    """Any function of sums over samples.

    Args:
        parts: terms of the sums for each of n > 0 samples, of shape `(n, *sums)`.
        groups: recording that each sample is from, as numbers or names.
        statistic: maps sums of shape `(..., *sums)` to values of shape `(...)`.
    """
    names, index = np.unique(groups, return_inverse=True)
    flat = parts.reshape(len(parts), -1)
    columns = [
        np.bincount(index.reshape(-1), weights=flat[:, k], minlength=len(names))
        for k in range(flat.shape[1])
    ]
    sums = np.stack(columns, axis=-1)
    value = float(statistic(sums.sum(axis=0).reshape(parts.shape[1:])))
    if len(names) < 2:
        return Estimate(value=value, low=None, high=None, n=len(parts))
    resampled = (_resample_counts(len(names)) @ sums).reshape(RESAMPLES, *parts.shape[1:])
    with np.errstate(invalid="ignore", divide="ignore"):
        values = statistic(resampled)
    tail = (1 - LEVEL) / 2
    low, high = np.nanquantile(values, [tail, 1 - tail])
    return Estimate(value=value, low=float(low), high=float(high), n=len(parts))


@lru_cache(maxsize=64)
def _resample_counts(groups: int) -> Float[np.ndarray, "resamples groups"]:
    """How often each resample contains each group; the same for every call."""
    rng = np.random.default_rng(0)
    counts = rng.multinomial(groups, np.full(groups, 1 / groups), RESAMPLES).astype(float)
    counts.flags.writeable = False
    return counts
