"""The questions of a study, on scores by hand."""

import numpy as np
import pytest

from asp_env.evaluation.closed_loop.scenario_table import DrivenScenarios
from asp_env.evaluation.closed_loop.summary import MethodScores
from asp_env.evaluation.results import Condition, Row
from asp_env.evaluation.study.questions import LOGGED, PER_TICK, Answer, answers
from tests.evaluation.made_up import made_method, made_scenarios, made_scores

RECORDINGS = (0, 0, 1, 2)
PRIVILEGED = ("expert", "oracle")


def driven(*methods: MethodScores, traffic: str = "log", latency_ticks: int = 0) -> DrivenScenarios:
    return DrivenScenarios(
        condition=Condition(data="d", traffic=traffic, latency_ticks=latency_ticks),
        scenarios=made_scenarios(*RECORDINGS),
        methods=methods,
    )


def method(predictor: str, score: float, *, planner: str = "pdm", **metrics: float) -> MethodScores:
    """A method with equal values in all scenarios; underscores in names stand for blanks."""
    count = len(RECORDINGS)
    more = {name.replace("_", " "): [value] * count for name, value in metrics.items()}
    return made_method(predictor, made_scores([score] * count, **more), planner=planner)


def rows_of(found: list[Answer], metric: str) -> list[Row]:
    return [row for answer in found for row in answer.rows if row.metric == metric]


def test_oracle_regret_is_the_difference_to_the_oracle_of_the_same_planner() -> None:
    scores = made_scores([0.5, 0.7, 0.6, 0.8])
    best = made_scores([1.0, 1.0, 1.0, 0.9])
    found = answers(
        [driven(made_method("a", scores), made_method("oracle", best)), driven(method("b", 0.1))],
        PRIVILEGED,
    )
    (row,) = rows_of(found, "score - oracle")
    assert (row.predictor, row.n) == ("a", 4)
    assert row.value == pytest.approx(-(0.5 + 0.3 + 0.4 + 0.1) / 4)
    assert row.low is not None
    assert row.mde is not None
    assert found[0].sentences[0].startswith("d · traffic log, sampling: a less the oracle -0.325 [")


def test_slope_of_latency_by_hand() -> None:
    """Scores of 1.0, 0.9 and 0.5 at 0, 1 and 3 ticks: the line of least squares has -0.8 * 9 / 42.

    The mean latency is 4/3; the deviations are -4/3, -1/3 and 5/3 with a sum of squares of 42/9,
    and the products with the scores sum to (-4 - 0.9 + 2.5) / 3 = -0.8.
    """
    places = [
        driven(method("a", score), latency_ticks=late)
        for late, score in ((0, 1.0), (1, 0.9), (3, 0.5))
    ]
    (row,) = rows_of(answers(places, PRIVILEGED), PER_TICK)
    assert row.value == pytest.approx(-0.8 * 9 / 42)
    assert row.latency_ticks is None
    assert not rows_of(answers(places[:1], PRIVILEGED), PER_TICK)


def test_dynamic_errors_are_paired_with_those_at_logged_states() -> None:
    found = answers(
        [
            driven(method("a", 1.0, forecast_FDE=3.0)),
            driven(method("a", 0.5, forecast_FDE=3.5), traffic="idm"),
            driven(method("a", 1.0, planner="expert", forecast_FDE=2.0)),
            driven(method("b", 1.0, forecast_FDE=3.0)),
        ],
        PRIVILEGED,
    )
    rows = rows_of(found, f"forecast FDE - {LOGGED}")
    assert [(row.traffic, row.predictor, row.value) for row in rows] == [
        ("log", "a", 1.0), ("idm", "a", 1.5),
    ]  # fmt: skip


def test_open_loop_ranks_of_the_predictors_without_privileged_ones() -> None:
    """FDE orders a, b, c as 1, 2, 3 m; the score orders them b, a, c: a correlation of 0.5."""
    fde_m, score = {"a": 1.0, "b": 2.0, "c": 3.0}, {"a": 0.8, "b": 0.9, "c": 0.1}
    closed = [
        method(name, score[name], forecast_FDE=fde_m[name], forecast_minFDE=1.0) for name in fde_m
    ]
    static = [
        method(name, 1.0, planner="expert", forecast_FDE=fde_m[name], forecast_minFDE=1.0)
        for name in fde_m
    ]
    oracle = method("oracle", 1.0, forecast_FDE=0.0, forecast_minFDE=0.0)
    found = answers([driven(*closed, oracle), driven(*static)], PRIVILEGED)
    (row,) = rows_of(found, "rank correlation: forecast FDE at logged states, score")
    assert (row.value, row.n) == (pytest.approx(0.5), 3)
    (answer,) = [each for each in found if "open-loop" in each.question]
    assert "ordered the other way round: a, b" in answer.sentences[0]
    (undefined,) = rows_of(found, "rank correlation: forecast minFDE at logged states, score")
    assert np.isnan(undefined.value)


def test_ranking_in_two_traffics() -> None:
    """Three methods whose order is reversed, and one privileged that is left out."""
    log = [method("a", 0.9), method("b", 0.8), method("c", 0.7), method("oracle", 1.0)]
    idm = [method("a", 0.7), method("b", 0.8), method("c", 0.9), method("oracle", 0.0)]
    found = answers([driven(*log), driven(*idm, traffic="idm")], PRIVILEGED)
    (row,) = rows_of(found, "rank correlation: score in log, score in idm")
    assert (row.value, row.n) == (-1.0, 3)
    assert not rows_of(answers([driven(*log)], PRIVILEGED), row.metric)


def test_hits_from_behind_by_traffic() -> None:
    found = answers(
        [
            driven(method("a", 1.0, no_hit_from_behind=0.75)),
            driven(method("a", 1.0, no_hit_from_behind=1.0), traffic="idm"),
        ],
        PRIVILEGED,
    )
    assert [row.value for row in rows_of(found, "hit from behind")] == [0.25, 0.0]
    assert found[-1].sentences == [
        "d · traffic log: the ego is hit from behind in 25.0% of drives",
        "d · traffic idm: the ego is hit from behind in 0.0% of drives",
    ]
