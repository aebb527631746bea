"""Means, ratios and paired differences with confidence intervals by a bootstrap over recordings.

Snippets and episodes of one recording are not independent, so whole recordings are resampled (the
cluster bootstrap: Davison and Hinkley, "Bootstrap Methods and their Application", 1997, section
3.8). With n recordings, a resample draws n of them with replacement. An interval lies between the
2.5 % and the 97.5 % quantile of the statistic over 2000 resamples (the percentile interval: Efron
and Tibshirani, "An Introduction to the Bootstrap", 1993, chapter 13).

Every statistic is a function of sums over samples. If `S_g` is the sum over the samples of
recording g and `w_g` how often a resample contains g, the statistic of that resample is
`f(sum_g w_g S_g)`. Resamples depend on the number of recordings alone, so statistics of several
methods on the same recordings are paired.

**Several training runs.** Every run of a method is evaluated on every sample. Runs and recordings
are crossed, and both are resampled independently (Owen, "The pigeonhole bootstrap", Annals of
Applied Statistics, 2007): `f(sum_g w_g sum_r v_r S_rg)`, where `v_r` is the share of run r among
R - 1 runs that are drawn with replacement from all R. With R - 1 draws instead of R the variance
over runs is unbiased (Rao and Wu, "Resampling inference with complex survey data", JASA, 1988),
which matters for three runs. Runs of different methods are resampled independently of each other.

**Differences.** The standard error of a paired difference is the standard deviation of the
resamples. The minimal detectable effect (MDE) is 2.8 standard errors: the true difference that a
two-sided test at 5 % finds with a probability of 80 %, since 1.96 + 0.84 = 2.8. A difference is
*resolved* if its interval excludes 0 and its absolute value is at least the MDE.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Shaped

from asp_env.data.bounded_cache import BoundedCache

RESAMPLES = 2000
"""Number of bootstrap resamples. Chosen by hand."""

LEVEL = 0.95
"""Confidence level of all intervals."""

DETECTABLE = 2.8
"""Minimal detectable effect in standard errors: the sum of the 97.5 % and the 80 % quantile of the
standard normal distribution, 1.96 + 0.84."""


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

    def __format__(self, form: str) -> str:
        """The value and its interval as text, each formatted by `form`."""
        if self.low is None or self.high is None:
            return format(self.value, form)
        return f"{self.value:{form}} [{self.low:{form}}, {self.high:{form}}]"


@dataclass(frozen=True, slots=True, kw_only=True)
class Difference:
    """A paired difference of two methods, with what the samples can resolve."""

    estimate: Estimate
    mde: float | None
    """Minimal detectable effect, in the unit of the difference; None without an interval."""
    p: float | None
    """Two-sided p value of `value / standard error` under the standard normal distribution; None
    without an interval."""

    def __format__(self, form: str) -> str:
        """The difference and its interval as text, and the MDE if it is not resolved."""
        estimate, mde = self.estimate, self.mde
        if is_resolved(estimate.value, estimate.low, estimate.high, mde):
            return format(estimate, form)
        seen = "" if mde is None else f" (smallest that could be seen {mde:{form.lstrip('+')}})"
        return f"{estimate:{form}}, not resolved{seen}"


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


def ratio_over_runs(
    numerators: Shaped[np.ndarray, "runs n"],
    denominators: Shaped[np.ndarray, "*runs n"],
    groups: Shaped[np.ndarray, " n"],
    *,
    stream: int = 0,
) -> Estimate:
    """Ratio of two sums over the samples of all training runs.

    Args:
        numerators: one value for each run and each of n > 0 samples.
        denominators: one value for each sample, of every run or shared by all runs; with the mask
            of the samples that have a value, the ratio is the mean.
        groups: recording that each sample is from, as numbers or names.
        stream: number of the sequence of random numbers, as for `resampled_sums`.
    """
    parts = np.stack(np.broadcast_arrays(numerators, denominators), axis=-1)
    sums = resampled_sums(parts, groups, stream=stream)
    with np.errstate(invalid="ignore", divide="ignore"):
        return interval(sums[:, 0] / sums[:, 1], n=len(groups))


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
    with np.errstate(invalid="ignore", divide="ignore"):
        values = statistic(resampled_sums(parts[None], groups))
    return interval(values, n=len(parts))


def resampled_sums(
    parts: Shaped[np.ndarray, "runs n ..."], groups: Shaped[np.ndarray, " n"], *, stream: int = 0
) -> Float[np.ndarray, "draws ..."]:
    """Sums over samples, averaged over runs: of the samples as they are, then of every resample.

    Arrays of several methods with the same `groups` are paired, draw by draw.

    Args:
        parts: terms of the sums of each run for each of n > 0 samples, of shape `(runs, n, *sums)`.
        groups: recording that each sample is from, as numbers or names.
        stream: number of the sequence of random numbers that resamples runs. Methods that are
            compared have different ones, so that their runs are resampled independently.

    Returns:
        Sums of shape `(1 + RESAMPLES, *sums)`. If all samples are from one recording, there are no
        resamples and the shape is `(1, *sums)`.
    """
    return average_runs(run_sums(parts, groups), stream=stream)


def resampled_means(
    values: Shaped[np.ndarray, "runs n"], groups: Shaped[np.ndarray, " n"], *, stream: int = 0
) -> Float[np.ndarray, " draws"]:
    """Means over samples and runs: of the samples as they are, then of every resample.

    Args:
        values: values of each run for each of n > 0 samples.
        groups: recording that each sample is from, as numbers or names.
        stream: number of the sequence of random numbers, as for `resampled_sums`.
    """
    sums = resampled_sums(np.stack([values, np.ones_like(values)], axis=-1), groups, stream=stream)
    return sums[:, 0] / sums[:, 1]


def run_sums(
    parts: Shaped[np.ndarray, "runs n ..."], groups: Shaped[np.ndarray, " n"]
) -> Float[np.ndarray, "draws runs ..."]:
    """Sums over samples of each run: of the samples as they are, then of every resample.

    Args:
        parts: terms of the sums of each run for each of n > 0 samples, of shape `(runs, n, *sums)`.
        groups: recording that each sample is from, as numbers or names.

    Returns:
        Sums of shape `(1 + RESAMPLES, runs, *sums)`, or `(1, runs, *sums)` if all samples are from
        one recording.
    """
    names, index = np.unique(groups, return_inverse=True)
    runs, samples, *shape = parts.shape
    by_sample = np.moveaxis(parts.reshape(runs, samples, -1), 1, 0).reshape(samples, -1)
    by_group = np.stack(
        [
            np.bincount(index.reshape(-1), weights=column, minlength=len(names))
            for column in by_sample.T
        ],
        axis=-1,
    )
    sums = by_group.sum(axis=0)[None]
    if len(names) > 1:
        sums = np.concatenate([sums, _resample_counts(len(names)) @ by_group])
    return sums.reshape(len(sums), runs, *shape)


def average_runs(
    values: Float[np.ndarray, "draws runs ..."], *, stream: int = 0
) -> Float[np.ndarray, "draws ..."]:
    """Means over runs; those of resamples over resampled runs.

    Args:
        values: values of each run, of the samples as they are, then of every resample.
        stream: number of the sequence of random numbers, as for `resampled_sums`.
    """
    draws, runs = values.shape[:2]
    if runs == 1:
        return values[:, 0]
    sample = values[:1].mean(axis=1)
    if draws == 1:
        return sample
    return np.concatenate(
        [sample, np.einsum("br,br...->b...", _run_shares(runs, stream), values[1:])]
    )


def interval(draws: Float[np.ndarray, " draws"], *, n: int) -> Estimate:
    """The percentile interval of a statistic.

    Args:
        draws: the statistic of the samples as they are, then of every resample, as computed from
            `resampled_sums`; resamples for which it is not defined are NaN.
        n: number of samples.
    """
    value, resamples = float(draws[0]), draws[1:]
    resamples = resamples[~np.isnan(resamples)]
    if not len(resamples):
        return Estimate(value=value, low=None, high=None, n=n)
    tail = (1 - LEVEL) / 2
    low, high = np.quantile(resamples, [tail, 1 - tail])
    return Estimate(value=value, low=float(low), high=float(high), n=n)


def difference(draws: Float[np.ndarray, " draws"], *, n: int) -> Difference:
    """A paired difference with its minimal detectable effect and its p value.

    Args:
        draws: the difference for the samples as they are, then for every resample.
        n: number of samples.
    """
    estimate = interval(draws, n=n)
    if len(draws) == 1:
        return Difference(estimate=estimate, mde=None, p=None)
    error = float(draws[1:].std(ddof=1))
    return Difference(
        estimate=estimate, mde=DETECTABLE * error, p=_two_sided_p(estimate.value, error)
    )


def _two_sided_p(value: float, error: float) -> float:
    if error == 0.0:
        return 1.0 if value == 0.0 else 0.0
    return math.erfc(abs(value) / error / math.sqrt(2))


def holm(p_values: Sequence[float]) -> list[float]:
    """Adjusts p values for several comparisons by Holm's step-down method.

    Holm, "A simple sequentially rejective multiple test procedure", Scandinavian Journal of
    Statistics, 1979: the k-th smallest of m values is multiplied by m - k + 1, is at least as large
    as the adjusted value before it, and at most 1.

    Args:
        p_values: the p values of one family of tests.

    Returns:
        The adjusted values in the same order.
    """
    order = np.argsort(p_values)
    factors = len(p_values) - np.arange(len(p_values))
    adjusted = np.minimum(np.maximum.accumulate(factors * np.asarray(p_values)[order]), 1.0)
    back = np.empty(len(p_values))
    back[order] = adjusted
    return back.tolist()


def is_resolved(value: float, low: float | None, high: float | None, mde: float | None) -> bool:
    """Whether a difference is resolved.

    Args:
        value: the difference.
        low: lower bound of its interval; None without an interval.
        high: upper bound of its interval; None without an interval.
        mde: minimal detectable effect; None without an interval.

    Returns:
        True if the interval excludes 0 and the absolute difference is at least the MDE.
    """
    if low is None or high is None or mde is None:
        return False
    return (low > 0 or high < 0) and abs(value) >= mde


def samples_needed(value: float, mde: float, n: int) -> int | None:
    """Number of samples at which the MDE equals a difference, so that this would be resolved.

    The standard error decreases with the square root of the number of samples, so the number is
    `n (mde / value)²`, rounded up. Recordings must increase in proportion, and the share of the
    error that is due to few training runs does not decrease.

    Args:
        value: the difference.
        mde: minimal detectable effect with n samples.
        n: number of samples.

    Returns:
        The number, or None if the difference is 0, which no number of samples resolves.
    """
    return None if value == 0.0 else math.ceil(n * (mde / value) ** 2)


_resamples = BoundedCache[np.ndarray](64 * 2**20)
"""Chosen by hand: comparisons have many subsets of different numbers of recordings; those of 40
recordings have 0.6 MB."""


def _resample_counts(groups: int) -> Float[np.ndarray, "resamples groups"]:
    """How often each resample contains each group; the same for every call."""

    def make() -> np.ndarray:
        rng = np.random.default_rng(0)
        counts = rng.multinomial(groups, np.full(groups, 1 / groups), RESAMPLES).astype(float)
        counts.flags.writeable = False
        return counts

    return _resamples.get(groups, make)


def _run_shares(runs: int, stream: int) -> Float[np.ndarray, "resamples runs"]:
    """Share of each of R > 1 runs among the R - 1 runs of each resample."""

    def make() -> np.ndarray:
        rng = np.random.default_rng((1, stream))
        shares = rng.multinomial(runs - 1, np.full(runs, 1 / runs), RESAMPLES) / (runs - 1)
        shares.flags.writeable = False
        return shares

    return _resamples.get((runs, stream), make)
