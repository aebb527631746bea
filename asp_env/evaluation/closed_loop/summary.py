"""Rows of `metrics.csv` from the scores of all methods in all scenarios.

Every statistic is paired by scenario. With several training runs, a method's value is the mean over
its runs, each of which drives all scenarios.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Bool, Float, Int

from asp_env.data.predictor import Predictor
from asp_env.data.scenarios.scenario import ScenarioSet
from asp_env.data.scenarios.tags import TAGS
from asp_env.evaluation import ladder, statistics
from asp_env.evaluation.closed_loop.comparison import EpisodeScores, Methods
from asp_env.evaluation.results import HEADROOM, ORACLE_SHARE, SCORE, Row, difference_name
from asp_env.evaluation.selection import shared_metadata
from asp_env.evaluation.statistics import Difference, Estimate
from asp_env.metrics.masked import Masked


@dataclass(frozen=True, slots=True, kw_only=True)
class MethodScores:
    """Scores of a method in N scenarios, by training run."""

    planner: str
    predictor: str
    """Name of the predictor as given; empty if the planner uses no forecasts."""
    runs: Mapping[str, Predictor | None]
    """The predictor of each training run by the name of the run; None without forecasts."""
    scores: Sequence[EpisodeScores]
    """Scores of each run in all scenarios."""
    stream: int
    """Position among the methods, by which its runs are resampled."""

    def metric(self, name: str) -> Masked:
        """Values and mask of a metric, of shape (runs, N)."""
        each = [scores.metrics[name] for scores in self.scores]
        return Masked(
            value=np.stack([metric.value for metric in each]),
            valid=np.stack([metric.valid for metric in each]),
        )

    def metadata(self, key: str) -> str:
        """An entry of the predictors' metadata; empty without forecasts."""
        return shared_metadata([each for each in self.runs.values() if each is not None], key)


def scores_by_method(methods: Methods, by_run: Sequence[EpisodeScores]) -> list[MethodScores]:
    """The scores of all runs, grouped by method.

    Args:
        methods: the methods.
        by_run: scores of each of `methods.all` in all scenarios.
    """
    groups: dict[tuple[str, str], list[int]] = {}
    for number, method in enumerate(methods.all):
        groups.setdefault((method.planner.name, method.predictor_name), []).append(number)
    return [
        MethodScores(
            planner=planner,
            predictor=predictor,
            runs={
                methods.all[i].run: methods.all[i].predictor if predictor else None for i in numbers
            },
            scores=[by_run[i] for i in numbers],
            stream=position,
        )
        for position, ((planner, predictor), numbers) in enumerate(groups.items())
    ]


@dataclass(frozen=True, slots=True, kw_only=True)
class Comparison:
    """All methods of a drive, and what their rows state."""

    methods: Sequence[MethodScores]
    scenarios: ScenarioSet
    common: Row
    """A row with the cells that all rows share."""
    compared: Sequence[str]
    """Metrics of which differences are stated, with the score if the rules have one."""
    reference: str | None
    """Predictor that differences refer to, None for no differences."""
    replayed: bool
    """Whether all other agents replay their logs, so that the oracle's forecasts come true."""


@dataclass(slots=True)
class _Table:
    """Estimates of one subset by method and metric, in the order of the rows."""

    estimates: dict[tuple[int, str], Estimate] = field(default_factory=dict)
    differences: dict[tuple[int, str], Difference] = field(default_factory=dict)
    p_holm: dict[tuple[int, str], float] = field(default_factory=dict)


def comparison_rows(comparison: Comparison) -> list[Row]:
    """Rows of every method, for all scenarios and for those with each tag.

    After its metrics, a method has its differences to the reference, its oracle share and its
    headroom score, as far as they are defined.

    Args:
        comparison: the methods and their scores.
    """
    scenarios = comparison.scenarios
    subsets = {"all": np.ones(len(scenarios), dtype=bool)}
    subsets |= {tag: scenarios.has(tag) for tag in TAGS}
    tables = {name: _table(comparison, member) for name, member in subsets.items()}
    rows = []
    for number, method in enumerate(comparison.methods):
        common = _method_row(comparison, method)
        for subset, table in tables.items():
            rows += _rows(replace(common, subset=subset), number, table)
    return rows


def _method_row(comparison: Comparison, method: MethodScores) -> Row:
    return replace(
        comparison.common,
        planner=method.planner,
        predictor=method.predictor,
        trained_on=method.metadata("trained_on"),
        view=method.metadata("view"),
        recipe=method.metadata("preset"),
        runs=len(method.runs) if method.predictor else None,
    )


def _rows(common: Row, number: int, table: _Table) -> Iterator[Row]:
    for (method, metric), estimate in table.estimates.items():
        if method == number:
            difference = table.differences.get((method, metric))
            yield replace(
                common,
                metric=metric,
                value=estimate.value,
                low=estimate.low,
                high=estimate.high,
                n=estimate.n,
                mde=difference.mde if difference else None,
                p_holm=table.p_holm.get((method, metric)),
            )


def _table(comparison: Comparison, member: Bool[np.ndarray, " n"]) -> _Table:
    table = _Table()
    for number, method in enumerate(comparison.methods):
        for metric in method.scores[0].metrics:
            estimate = _mean(method, metric, member, comparison.scenarios.recording)
            if estimate is not None:
                table.estimates[number, metric] = estimate
    _add_differences(comparison, member, table)
    if SCORE in comparison.compared and comparison.replayed:
        _add_ladder(comparison, member, table)
    return table


def _mean(
    method: MethodScores,
    metric: str,
    member: Bool[np.ndarray, " n"],
    recording: Int[np.ndarray, " n"],
) -> Estimate | None:
    """Mean over scenarios and runs; None if the metric is defined nowhere."""
    masked = method.metric(metric)
    rows = member & masked.valid.any(axis=0)
    if not rows.any():
        return None
    valid = masked.valid[:, rows]
    return statistics.ratio_over_runs(
        np.where(valid, masked.value[:, rows], 0.0), valid, recording[rows], stream=method.stream
    )


def _means(
    methods: Sequence[MethodScores],
    metric: str,
    member: Bool[np.ndarray, " n"],
    recording: Int[np.ndarray, " n"],
) -> tuple[Float[np.ndarray, "draws methods"], int]:
    """Means of a metric in the scenarios in which all methods have it, and their number.

    The means are those of the scenarios as they are, then of every resample.
    """
    masked = [method.metric(metric) for method in methods]
    rows = member & np.all([each.valid.all(axis=0) for each in masked], axis=0)
    count = int(rows.sum())
    if not count:
        return np.zeros((1, len(methods))), 0
    ones = np.ones((1, count))
    sums = statistics.resampled_sums(ones, recording[rows])
    draws = [
        statistics.resampled_sums(each.value[:, rows], recording[rows], stream=method.stream)
        for method, each in zip(methods, masked, strict=True)
    ]
    return np.stack(draws, axis=-1) / sums[:, None], count


def _add_differences(comparison: Comparison, member: Bool[np.ndarray, " n"], table: _Table) -> None:
    """Adds the paired differences to the reference, with p values adjusted over the methods."""
    reference = next(
        (m for m in comparison.methods if m.predictor == comparison.reference and m.predictor), None
    )
    if reference is None:
        return
    for metric in comparison.compared:
        name = difference_name(metric, reference.predictor)
        for number, method in enumerate(comparison.methods):
            if method is reference:
                continue
            pair = (method, reference)
            means, n = _means(pair, metric, member, comparison.scenarios.recording)
            if n:
                found = statistics.difference(means[:, 0] - means[:, 1], n=n)
                table.differences[number, name] = found
                table.estimates[number, name] = found.estimate
        tested = {
            key: found.p
            for key, found in table.differences.items()
            if key[1] == name and found.p is not None
        }
        adjusted = statistics.holm(list(tested.values()))
        table.p_holm |= dict(zip(tested, adjusted, strict=True))


def _add_ladder(comparison: Comparison, member: Bool[np.ndarray, " n"], table: _Table) -> None:
    """Adds the oracle shares and the headroom scores of the methods that have a predictor."""
    numbers = [i for i, method in enumerate(comparison.methods) if method.predictor]
    methods = [comparison.methods[number] for number in numbers]
    rungs = {m.predictor: share for m in methods if (share := ladder.rung(m.predictor)) is not None}
    if ladder.BASELINE not in rungs or ladder.ORACLE not in rungs:
        return
    means, n = _means(methods, SCORE, member, comparison.scenarios.recording)
    if not n:
        return
    of = dict(zip((m.predictor for m in methods), means.T, strict=True))
    ordered = sorted(rungs, key=rungs.__getitem__)
    scale = np.stack([of[name] for name in ordered], axis=-1)
    shares = np.array([rungs[name] for name in ordered])
    for number, method in zip(numbers, methods, strict=True):
        scores = of[method.predictor]
        if method.predictor not in rungs and len(rungs) >= ladder.MIN_RUNGS:
            draws = ladder.oracle_shares(scores, scale, shares)
            table.estimates[number, ORACLE_SHARE] = statistics.interval(draws, n=n)
        if method.predictor not in (ladder.BASELINE, ladder.ORACLE):
            table.estimates[number, HEADROOM] = ladder.headroom(
                scores, of[ladder.BASELINE], of[ladder.ORACLE], n=n
            )
