"""Means with intervals by bootstrap over recordings: snippets of one recording are no new data."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from jaxtyping import Float, Shaped

RESAMPLES = 2000
LEVEL = 0.95


@dataclass(frozen=True, slots=True, kw_only=True)
class Estimate:
    """A mean or ratio of means, with its interval where there are at least two recordings."""

    value: float
    low: float | None
    high: float | None
    n: int


def mean(values: Shaped[np.ndarray, " n"], groups: Shaped[np.ndarray, " n"]) -> Estimate:
    """Mean over samples; its 95 % percentile interval from resampling groups.

    Args:
        values: one per sample; must not be empty.
        groups: which recording each sample is from.
    """
    return ratio(values, np.ones(len(values)), groups)


def ratio(
    numerators: Shaped[np.ndarray, " n"],
    denominators: Shaped[np.ndarray, " n"],
    groups: Shaped[np.ndarray, " n"],
) -> Estimate:
    """Sum over sum, both resampled together, so that a ratio of two methods is paired."""
    parts = np.stack([numerators, denominators], axis=-1)
    return of_sums(parts, groups, lambda sums: sums[..., 0] / sums[..., 1])


def of_sums(
    parts: Shaped[np.ndarray, "n ..."],
    groups: Shaped[np.ndarray, " n"],
    statistic: Callable[[np.ndarray], np.ndarray],
) -> Estimate:
    """Any function of sums over samples, and its interval from resampling groups.

    Args:
        parts: what each sample adds to the sums.
        groups: which recording each sample is from.
        statistic: from sums (…, *parts) to values (…).
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
    drawn = (_draws(len(names)) @ sums).reshape(RESAMPLES, *parts.shape[1:])
    with np.errstate(invalid="ignore", divide="ignore"):
        samples = statistic(drawn)
    tail = (1 - LEVEL) / 2
    low, high = np.nanquantile(samples, [tail, 1 - tail])
    return Estimate(value=value, low=float(low), high=float(high), n=len(parts))


@lru_cache(maxsize=64)
def _draws(groups: int) -> Float[np.ndarray, "resamples groups"]:
    """How often each group is drawn in each resample; the same for everybody, so paired."""
    rng = np.random.default_rng(0)
    drawn = rng.multinomial(groups, np.full(groups, 1 / groups), RESAMPLES).astype(float)
    drawn.flags.writeable = False
    return drawn
