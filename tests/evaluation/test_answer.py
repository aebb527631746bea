"""The sentence that the report opens with, worked out by hand from rows."""

import pytest

from asp_env.evaluation.report.answer import driving_answer, forecast_answer
from asp_env.evaluation.report.results import MethodResult, Result
from asp_env.evaluation.results import Condition

SCORE = "score - constant-velocity"


def row(predictor: str, metric: str, value: float | None, **cells: object) -> Result:
    """A result of the planner `sampling` in 480 scenarios."""
    given: dict[str, object] = {
        "method": MethodResult(
            planner="sampling", predictor=predictor, privileged=predictor == "oracle"
        ),
        "condition": Condition(data="d", traffic="log", latency_ticks=0),
        "horizon_s": "3",
        "fixed": (),
        "selection": "",
        "subset": "all",
        "metric": metric,
        "at_s": None,
        "value": value,
        "low": None,
        "high": None,
        "n": 480.0,
    }
    return Result(**given | cells)  # pyright: ignore[reportArgumentType]


def test_yes_states_gain_interval_oracle_share_drives_and_places() -> None:
    """0.05 is beyond the MDE of 0.03; 60 % is the position on the ladder."""
    results = [
        row("ffw-asp", SCORE, 0.05, low=0.03, high=0.07, mde=0.03, p_holm=1e-5),
        row("ffw-asp", "oracle share", 0.6, low=0.4, high=0.8),
        row("oracle", SCORE, 0.08, low=0.05, high=0.11, mde=0.04, p_holm=1e-6),
    ]
    answer = driving_answer(results, places=60)
    assert answer is not None
    assert f"{answer.heading}: {answer.sentence}" == (
        "Yes: with ffw-asp this planner drives better than with constant-velocity by +0.050 "
        "[0.030, 0.070], like a 60 % oracle; 480 drives, 60 places."
    )
    assert "oracle share 60 % [40, 80]" in answer.details
    assert any(each.startswith("p < 0.001, adjusted by Holm's") for each in answer.details)
    assert answer.method == results[0].method


def test_of_several_methods_the_best_resolved_one_is_named() -> None:
    """`a` gains most but is not resolved; `b` is; `c` is resolved as worse."""
    results = [
        row("a", SCORE, 0.09, low=-0.01, high=0.2, mde=0.15, p_holm=0.3),
        row("b", SCORE, 0.04, low=0.02, high=0.06, mde=0.03, p_holm=0.002),
        row("c", SCORE, -0.04, low=-0.06, high=-0.02, mde=0.03, p_holm=0.002),
    ]
    answer = driving_answer(results)
    assert answer is not None
    assert answer.verdict == "yes"
    assert answer.sentence.startswith("with b this planner drives better")
    assert answer.details[0] == (
        "the best of 3 methods under test, of which 1 is resolved as better and 1 as worse"
    )


@pytest.mark.parametrize(
    ("cells", "verdict", "sentence"),
    [
        (
            {"value": 0.011, "low": -0.002, "high": 0.021, "mde": 0.0247, "p_holm": 0.2},
            "not resolved",
            "the score of this planner with m less that with constant-velocity is +0.011 "
            "[-0.002, 0.021]; 480 drives.",
        ),
        (
            {"value": -0.05, "low": -0.07, "high": -0.03, "mde": 0.03, "p_holm": 0.0},
            "no",
            "with m this planner drives worse than with constant-velocity by -0.050 "
            "[-0.070, -0.030]; 480 drives.",
        ),
        (
            {"value": 0.0, "low": 0.0, "high": 0.0, "mde": 0.0, "p_holm": 1.0},
            "no",
            "with m this planner drives exactly as with constant-velocity; 480 drives.",
        ),
        (  # resolved by its interval, but not after the adjustment for several methods
            {"value": 0.05, "low": 0.03, "high": 0.07, "mde": 0.03, "p_holm": 0.06},
            "not resolved",
            "the score of this planner with m less that with constant-velocity is +0.050 "
            "[0.030, 0.070]; 480 drives.",
        ),
        (
            {"value": 0.05},
            "not resolved",
            "the score of this planner with m less that with constant-velocity is +0.050; "
            "480 drives.",
        ),
    ],
)
def test_verdicts(cells: dict[str, float], verdict: str, sentence: str) -> None:
    answer = driving_answer([row("m", SCORE, **cells)])
    assert answer is not None
    assert (answer.verdict, answer.sentence) == (verdict, sentence)


def test_needed_drives_are_stated_where_a_difference_is_not_resolved() -> None:
    """480 (2.47 / 1.1)² = 2420.2 drives, in two digits 2,500."""
    answer = driving_answer([row("m", SCORE, 0.011, low=-0.002, high=0.021, mde=0.0247)])
    assert answer is not None
    assert "a difference of this size needs about 2,500 drives" in answer.details


def test_controls_alone_bound_what_forecasts_can_gain() -> None:
    answer = driving_answer([row("oracle", SCORE, 0.02, low=0.01, high=0.03, mde=0.01)])
    assert answer is not None
    assert answer.verdict == "no method under test"
    assert answer.sentence.startswith("the oracle drives by +0.020 [0.010, 0.030] better")


def test_methods_without_a_reference_are_not_compared() -> None:
    answer = driving_answer([row("m", "score", 0.9)], places=1)
    assert answer is not None
    assert f"{answer.heading}: {answer.sentence}" == (
        "Not compared: the score of no method is compared with a reference; 480 drives, 1 place."
    )
    assert driving_answer([]) is None


def test_forecasts_are_compared_by_their_ratio_to_constant_velocity() -> None:
    ratio, kind = "FDE / constant velocity", {"selection": "most-probable", "subset": "moving"}
    results = [
        row("constant-velocity", ratio, 1.0, low=1.0, high=1.0, **kind),
        row("ffw-asp", ratio, 0.5, low=0.45, high=0.55, **kind),
    ]
    answer = forecast_answer(results)
    assert answer is not None
    assert f"{answer.heading}: {answer.sentence}" == (
        "Yes: ffw-asp forecasts better than constant-velocity, with an FDE at 3 s that is 0.50 "
        "[0.45, 0.55] times as large; 480 moving targets."
    )
