"""Agreement of metrics on the order of methods: rank correlations and inversions."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from jaxtyping import Bool, Float, Shaped

from asp_env.errors import AspEnvError
from asp_env.evaluation.statistics import RESAMPLES, Estimate, interval, resampled_sums


@dataclass(frozen=True, slots=True, kw_only=True)
class MetricColumn:
    """A metric of M methods on its own samples: snippets, logged states or scenarios."""

    name: str
    """Name of the metric."""
    higher_is_better: bool
    values: Float[np.ndarray, "m n"]
    """The metric on every sample, averaged over training runs; NaN where it is not defined."""
    groups: Shaped[np.ndarray, " n"]
    """Recording of each sample; the same recordings have the same numbers or names in all
    columns."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Inversion:
    """Two methods that two metrics order differently."""

    better_by_first: str
    """The method that is better by the first metric."""
    better_by_second: str
    """The method that is better by the second metric."""
    share: float | None
    """Share of resamples in which the metrics order the two methods in exactly this way; None if
    there is one recording. An inversion that is not an accident of the recordings has a share near
    1."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RankAgreement:
    """Agreement of two metrics on the order of methods."""

    first: str
    """Name of the first metric."""
    second: str
    """Name of the second metric."""
    spearman: Estimate
    """Spearman's rank correlation, 1 if both metrics order the methods equally; n is the number of
    methods."""
    kendall: Estimate
    """Kendall's tau-b."""
    inversions: tuple[Inversion, ...]
    """Pairs of methods in the order of `methods`; equal values are no inversion."""


def rank_agreement(methods: Sequence[str], columns: Sequence[MetricColumn]) -> list[RankAgreement]:
    """Rank correlations over methods of every two metrics, with the pairs that they invert.

    A metric is averaged over the samples of each resample of recordings, methods are ranked by the
    averages, the best first, and the ranks of two metrics are correlated. All metrics have the same
    resamples, whatever their samples are.

    Args:
        methods: names of the M methods.
        columns: the metrics; a recording without a sample of a metric does not contribute to it.

    Returns:
        An agreement for every two columns, in the order of `columns`.

    Raises:
        AspEnvError: there are fewer than two methods, or a method has no value of a metric.
    """
    if len(methods) < 2:
        raise AspEnvError(f"{len(methods)} methods: a rank correlation needs at least two")
    recordings = np.unique(np.concatenate([column.groups for column in columns]))
    merits = [_merits(column, methods, recordings) for column in columns]
    agreements = []
    for (first, x), (second, y) in combinations(zip(columns, merits, strict=True), 2):
        agreements.append(
            RankAgreement(
                first=first.name,
                second=second.name,
                spearman=interval(_correlations(_ranks(x), _ranks(y)), n=len(methods)),
                kendall=interval(_kendall(x, y), n=len(methods)),
                inversions=_inversions(methods, x, y),
            )
        )
    return agreements


def _merits(
    column: MetricColumn, methods: Sequence[str], recordings: Shaped[np.ndarray, " g"]
) -> Float[np.ndarray, "draws m"]:
    """Means of the methods in the samples and in all resamples, negated if lower is better."""
    defined = ~np.isnan(column.values)
    for name, known in zip(methods, defined, strict=True):
        if not known.any():
            raise AspEnvError(f"{name} has no value of {column.name}; leave one of them out")
    parts = np.stack([np.where(defined, column.values, 0.0), defined], axis=-1).swapaxes(0, 1)
    absent = np.setdiff1d(recordings, column.groups)
    parts = np.concatenate([parts, np.zeros((len(absent), *parts.shape[1:]))])
    sums = resampled_sums(parts[None], np.concatenate([column.groups, absent]))
    with np.errstate(invalid="ignore", divide="ignore"):
        means = sums[..., 0] / sums[..., 1]
    return means if column.higher_is_better else -means


def _ranks(values: Float[np.ndarray, "draws m"]) -> Float[np.ndarray, "draws m"]:
    """Number of methods below each method; equal methods share their mean rank."""
    below = values[:, None] < values[..., None]
    equal = values[:, None] == values[..., None]
    return below.sum(axis=-1) + 0.5 * equal.sum(axis=-1)


def _correlations(
    x: Float[np.ndarray, "draws m"], y: Float[np.ndarray, "draws m"]
) -> Float[np.ndarray, " draws"]:
    """Pearson's correlation, NaN where one side does not vary."""
    x = x - x.mean(axis=-1, keepdims=True)
    y = y - y.mean(axis=-1, keepdims=True)
    with np.errstate(invalid="ignore", divide="ignore"):
        return (x * y).sum(axis=-1) / np.sqrt((x**2).sum(axis=-1) * (y**2).sum(axis=-1))


def _kendall(
    x: Float[np.ndarray, "draws m"], y: Float[np.ndarray, "draws m"]
) -> Float[np.ndarray, " draws"]:
    """Kendall's tau-b, NaN where one side does not vary."""
    first, second = np.triu_indices(x.shape[-1], k=1)
    sign_x = np.sign(x[:, first] - x[:, second])
    sign_y = np.sign(y[:, first] - y[:, second])
    with np.errstate(invalid="ignore", divide="ignore"):
        untied = np.abs(sign_x).sum(axis=-1) * np.abs(sign_y).sum(axis=-1)
        return (sign_x * sign_y).sum(axis=-1) / np.sqrt(untied)


def _inversions(
    methods: Sequence[str], x: Float[np.ndarray, "draws m"], y: Float[np.ndarray, "draws m"]
) -> tuple[Inversion, ...]:
    found = []
    for one, other in combinations(range(len(methods)), 2):
        if x[0, one] < x[0, other]:
            one, other = other, one
        inverted: Bool[np.ndarray, " draws"] = (x[:, one] > x[:, other]) & (y[:, one] < y[:, other])
        if inverted[0]:
            found.append(
                Inversion(
                    better_by_first=methods[one],
                    better_by_second=methods[other],
                    share=float(inverted[1:].mean()) if len(x) == 1 + RESAMPLES else None,
                )
            )
    return tuple(found)
