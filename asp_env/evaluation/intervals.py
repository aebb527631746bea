"""Means with intervals by bootstrap over recordings: snippets of one recording are no new data."""

from dataclasses import dataclass

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
    _, index = np.unique(groups, return_inverse=True)
    top = np.bincount(index.reshape(-1), weights=numerators)
    bottom = np.bincount(index.reshape(-1), weights=denominators)
    value = float(top.sum() / bottom.sum())
    if len(top) < 2:
        return Estimate(value=value, low=None, high=None, n=len(numerators))
    drawn = _draws(len(top))
    with np.errstate(invalid="ignore", divide="ignore"):
        samples = (drawn @ top) / (drawn @ bottom)
    tail = (1 - LEVEL) / 2
    low, high = np.nanquantile(samples, [tail, 1 - tail])
    return Estimate(value=value, low=float(low), high=float(high), n=len(numerators))


def _draws(groups: int) -> Float[np.ndarray, "resamples groups"]:
    """How often each group is drawn in each resample; the same for everybody, so paired."""
    rng = np.random.default_rng(0)
    return rng.multinomial(groups, np.full(groups, 1 / groups), RESAMPLES).astype(float)
