"""What a study answers: one function for each question, with rows for `metrics.csv` and a sentence.

All values are means over scenarios and training runs, differences are paired by scenario, and
intervals are over recordings and runs.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from zlib import crc32

import numpy as np
from jaxtyping import Bool, Float

from asp_env.evaluation.closed_loop.comparison import EXPERT
from asp_env.evaluation.closed_loop.forecast_quality import FORECAST_METRICS
from asp_env.evaluation.closed_loop.scenario_table import DrivenScenarios
from asp_env.evaluation.closed_loop.summary import MethodScores
from asp_env.evaluation.ladder import ORACLE
from asp_env.evaluation.rank_agreement import MetricColumn, RankAgreement, rank_agreement
from asp_env.evaluation.results import ANSWER, SCORE, Condition, Row, difference_name
from asp_env.evaluation.statistics import Difference, difference, interval, resampled_means

LOGGED = "logged states"
"""Reference of differences to the forecasts that are made while the expert is replayed."""

PER_TICK = f"{SCORE} per tick of latency"
"""Metric: slope of the score over latency."""

MIN_RANKED = 3
"""Smallest number of methods whose ranks are correlated."""

NO_HIT = "no hit from behind"


@dataclass(frozen=True, slots=True, kw_only=True)
class Answer:
    """The answer to one question."""

    question: str
    sentences: list[str]
    """The answer in words; empty if the study has too few conditions or methods for it."""
    rows: list[Row]
    """Its numbers."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Driven:
    """One method in one condition."""

    place: DrivenScenarios
    method: MethodScores

    @property
    def name(self) -> str:
        """The planner, and the predictor with which it drives."""
        return "+".join(part for part in (self.method.planner, self.method.predictor) if part)

    @property
    def condition(self) -> Condition:
        """What it was driven in."""
        return self.place.condition

    def row(self, metric: str, found: Difference) -> Row:
        """A row of `metrics.csv` for this method."""
        estimate = found.estimate
        return Row(
            data=self.condition.data,
            planner=self.method.planner,
            predictor=self.method.predictor,
            traffic=self.condition.traffic,
            latency_ticks=self.condition.latency_ticks,
            runs=len(self.method.runs) if self.method.predictor else None,
            subset=ANSWER,
            metric=metric,
            value=estimate.value,
            low=estimate.low,
            high=estimate.high,
            n=estimate.n,
            mde=found.mde,
        )


def answers(driven: Sequence[DrivenScenarios], privileged: Sequence[str]) -> list[Answer]:
    """The answers to all questions, in the order of the page.

    Args:
        driven: scores of all methods in every scenario, by condition and planner.
        privileged: names of the planners and predictors that use the recorded future.
    """
    methods = [Driven(place=each, method=method) for each in driven for method in each.methods]
    return [
        oracle_regret(methods),
        latency_slope(methods, privileged),
        static_and_dynamic(methods, privileged),
        open_to_closed(methods, privileged),
        traffic_ranking(methods, privileged),
        replay_artefacts(methods),
    ]


def oracle_regret(methods: Sequence[Driven]) -> Answer:
    """What the recorded future would add: the score of each method less the oracle's.

    Where traffic reacts, the recorded future need not come true, and the oracle may be worse.

    Args:
        methods: all methods in all conditions.
    """
    rows, sentences = [], []
    for place, planner, group in _by_planner(methods):
        oracle = next((each for each in group if each.method.predictor == ORACLE), None)
        if oracle is None or SCORE not in oracle.method.scores[0].metrics:
            continue
        for each in group:
            found = None if each is oracle else _less(each, oracle, SCORE)
            if found is not None:
                rows.append(each.row(difference_name(SCORE, ORACLE), found))
                sentences.append(
                    f"{place.condition.label}, {planner}: {each.method.predictor} less the oracle "
                    f"{found:+.3f}"
                )
    return Answer(question="What would a perfect forecast add?", sentences=sentences, rows=rows)


def latency_slope(methods: Sequence[Driven], privileged: Sequence[str]) -> Answer:
    """What a tick of latency costs: the slope of the score over latency, by least squares.

    Args:
        methods: all methods in all conditions.
        privileged: names of the planners and predictors that use the recorded future.
    """
    series: dict[tuple[str, str, str, str], list[Driven]] = {}
    for each in methods:
        if each.method.predictor and each.method.planner != EXPERT:
            key = (each.condition.data, each.condition.traffic, *_names(each))
            series.setdefault(key, []).append(each)
    rows, sentences = [], []
    for group in series.values():
        late = np.array([each.condition.latency_ticks for each in group], dtype=np.float64)
        if len(set(late.tolist())) < 2 or SCORE not in group[0].method.scores[0].metrics:
            continue
        rows_of = np.all([_valid(each, SCORE) for each in group], axis=0)
        draws = np.stack([_draws(each, SCORE, rows_of) for each in group], axis=-1)
        centred = late - late.mean()
        found = difference(draws @ centred / (centred**2).sum(), n=int(rows_of.sum()))
        rows.append(replace(group[0].row(PER_TICK, found), latency_ticks=None))
        if group[0].method.predictor not in privileged:
            first = replace(group[0].condition, latency_ticks=0)
            sentences.append(f"{first.label}: {group[0].name} {found:+.4f} per tick")
    return Answer(question="What does latency cost?", sentences=sentences, rows=rows)


def static_and_dynamic(methods: Sequence[Driven], privileged: Sequence[str]) -> Answer:
    """Whether forecasts are as good on the states that a planner visits as on logged ones.

    Args:
        methods: all methods in all conditions, with those of the replayed expert.
        privileged: names of the planners and predictors that use the recorded future.
    """
    static = {
        (each.condition.data, each.condition.latency_ticks, each.method.predictor): each
        for each in methods
        if each.method.planner == EXPERT and each.method.predictor
    }
    rows, sentences = [], []
    for each in methods:
        logged = static.get(
            (each.condition.data, each.condition.latency_ticks, each.method.predictor)
        )
        if logged is None or each.method.planner == EXPERT:
            continue
        for metric in FORECAST_METRICS:
            found = _less(each, logged, metric)
            if found is None:
                continue
            rows.append(each.row(difference_name(metric, LOGGED), found))
            if metric == "forecast FDE" and each.method.predictor not in privileged:
                sentences.append(
                    f"{each.condition.label}: FDE of {each.method.predictor} on the states "
                    f"that {each.method.planner} visits less that on logged states, in m: "
                    f"{found:+.2f}"
                )
    return Answer(
        question="Do forecasts hold on the states that the planner visits?",
        sentences=sentences,
        rows=rows,
    )


def open_to_closed(methods: Sequence[Driven], privileged: Sequence[str]) -> Answer:
    """Whether errors of forecasts rank predictors as driving does.

    Args:
        methods: all methods in all conditions, with those of the replayed expert.
        privileged: names of the planners and predictors that use the recorded future, which are
            left out.
    """
    rows, sentences = [], []
    for place, planner, everything in _by_planner(methods):
        left_out = {*privileged, "blind"}
        group = [each for each in everything if each.method.predictor not in left_out]
        static = [s for each in group if (s := _static_of(each, methods)) is not None]
        if len(group) < MIN_RANKED or len(static) < len(group):
            continue
        columns = [
            _column("forecast FDE at logged states", static, "forecast FDE"),
            _column("forecast minFDE at logged states", static, "forecast minFDE"),
            _column("forecast FDE", group, "forecast FDE"),
            _column(SCORE, group, SCORE, higher_is_better=True),
        ]
        names = [each.method.predictor for each in group]
        for agreement in _agreements(names, columns):
            if agreement.second == SCORE:
                rows.append(_agreement_row(group[0], agreement, planner=planner, predictor=""))
                sentences.append(
                    f"{place.condition.label}, {planner}: {_agreement_text(agreement)}"
                )
    return Answer(
        question="Do open-loop errors rank predictors as driving does?",
        sentences=sentences,
        rows=rows,
    )


def traffic_ranking(methods: Sequence[Driven], privileged: Sequence[str]) -> Answer:
    """Whether methods have the same rank in replayed and in reactive traffic.

    Args:
        methods: all methods in all conditions.
        privileged: names of the planners and predictors that use the recorded future, which are
            left out.
    """
    places: dict[tuple[str, int], dict[str, dict[tuple[str, str], Driven]]] = {}
    for each in methods:
        if not {*_names(each)} & set(privileged) and SCORE in each.method.scores[0].metrics:
            by_traffic = places.setdefault((each.condition.data, each.condition.latency_ticks), {})
            by_traffic.setdefault(each.condition.traffic, {})[_names(each)] = each
    rows, sentences = [], []
    for by_traffic in places.values():
        first, *others = by_traffic
        for other in others:
            names = [name for name in by_traffic[first] if name in by_traffic[other]]
            if len(names) < MIN_RANKED:
                continue
            columns = [
                _column(
                    f"{SCORE} in {traffic}",
                    [by_traffic[traffic][name] for name in names],
                    SCORE,
                    higher_is_better=True,
                )
                for traffic in (first, other)
            ]
            labels = ["+".join(part for part in name if part) for name in names]
            for agreement in _agreements(labels, columns):
                of = by_traffic[other][names[0]]
                rows.append(_agreement_row(of, agreement, planner="", predictor=""))
                both = replace(of.condition, traffic=f"{first} and {other}")
                sentences.append(f"{both.label}: {_agreement_text(agreement)}")
    return Answer(
        question="Does the ranking hold in traffic that reacts?", sentences=sentences, rows=rows
    )


def replay_artefacts(methods: Sequence[Driven]) -> Answer:
    """How often the ego is hit from behind, by traffic.

    Agents that replay their log do not brake for the ego, so such hits need not be its fault.

    Args:
        methods: all methods in all conditions.
    """
    rows, sentences = [], []
    by_traffic: dict[tuple[str, str], list[float]] = {}
    for each in methods:
        metric = each.method.scores[0].metrics.get(NO_HIT)
        if metric is None or each.method.planner == EXPERT:
            continue
        member = _valid(each, NO_HIT)
        if member.any():
            draws = 1 - _draws(each, NO_HIT, member)
            found = Difference(estimate=interval(draws, n=int(member.sum())), mde=None, p=None)
            rows.append(each.row("hit from behind", found))
            key = (each.condition.data, each.condition.traffic)
            by_traffic.setdefault(key, []).append(float(draws[0]))
    sentences = [
        f"{data} · traffic {traffic}: the ego is hit from behind in {np.mean(shares):.1%} of drives"
        for (data, traffic), shares in by_traffic.items()
    ]
    return Answer(question="How much is an artefact of replay?", sentences=sentences, rows=rows)


def _names(each: Driven) -> tuple[str, str]:
    return each.method.planner, each.method.predictor


def _by_planner(
    methods: Sequence[Driven],
) -> list[tuple[DrivenScenarios, str, list[Driven]]]:
    """The methods with forecasts, by condition and planner."""
    groups: dict[tuple[int, str], tuple[DrivenScenarios, str, list[Driven]]] = {}
    for each in methods:
        place, planner = each.place, each.method.planner
        if each.method.predictor and planner != EXPERT:
            groups.setdefault((id(place), planner), (place, planner, []))[2].append(each)
    return [*groups.values()]


def _static_of(each: Driven, methods: Sequence[Driven]) -> Driven | None:
    """The forecasts of the same predictor while the expert is replayed."""
    wanted = (
        each.condition.data,
        each.condition.latency_ticks,
        EXPERT,
        each.method.predictor,
    )
    return next(
        (
            other
            for other in methods
            if (other.condition.data, other.condition.latency_ticks, *_names(other)) == wanted
        ),
        None,
    )


def _valid(each: Driven, metric: str) -> Bool[np.ndarray, " n"]:
    """Scenarios in which all runs have a metric."""
    return np.asarray(each.method.metric(metric).valid.all(axis=0))


def _draws(
    each: Driven, metric: str, member: Bool[np.ndarray, " n"]
) -> Float[np.ndarray, " draws"]:
    return resampled_means(
        each.method.metric(metric).value[:, member],
        each.place.scenarios.recording[member],
        stream=_stream(each),
    )


def _stream(each: Driven) -> int:
    """Methods with the same runs have the same stream, so that their runs are paired."""
    return crc32(each.method.predictor.encode())


def _less(one: Driven, other: Driven, metric: str) -> Difference | None:
    """The paired difference of two methods; None if no scenario has the metric in both."""
    if any(metric not in each.method.scores[0].metrics for each in (one, other)):
        return None
    member = _valid(one, metric) & _valid(other, metric)
    if not member.any():
        return None
    return difference(
        _draws(one, metric, member) - _draws(other, metric, member), n=int(member.sum())
    )


def _column(
    name: str, methods: Sequence[Driven], metric: str, *, higher_is_better: bool = False
) -> MetricColumn:
    values = []
    for each in methods:
        masked = each.method.metric(metric)
        valid = masked.valid.all(axis=0)
        values.append(np.where(valid, masked.value.mean(axis=0), np.nan))
    return MetricColumn(
        name=name,
        higher_is_better=higher_is_better,
        values=np.stack(values),
        groups=methods[0].place.scenarios.recording,
    )


def _agreements(names: Sequence[str], columns: Sequence[MetricColumn]) -> list[RankAgreement]:
    """Rank agreements; none if a method has no value of a metric."""
    if any(np.isnan(column.values).all(axis=1).any() for column in columns):
        return []
    return rank_agreement(names, columns)


def _agreement_row(of: Driven, agreement: RankAgreement, *, planner: str, predictor: str) -> Row:
    found = Difference(estimate=agreement.spearman, mde=None, p=None)
    row = of.row(f"rank correlation: {agreement.first}, {agreement.second}", found)
    return replace(row, planner=planner, predictor=predictor, runs=None)


def _agreement_text(agreement: RankAgreement) -> str:
    pairs = [f"{each.better_by_first}, {each.better_by_second}" for each in agreement.inversions]
    inverted = f"; ordered the other way round: {' / '.join(pairs)}" if pairs else ""
    correlation = "not defined, since one of them does not vary"
    if not np.isnan(agreement.spearman.value):
        correlation = f"{agreement.spearman:.2f} over {agreement.spearman.n} methods"
    return f"rank correlation of {agreement.first} and {agreement.second} {correlation}{inverted}"
