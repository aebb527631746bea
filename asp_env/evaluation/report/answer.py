"""The answer that the page opens with: does a predictor make the planner drive better?"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from asp_env.evaluation.ladder import BASELINE, ORACLE, is_under_test
from asp_env.evaluation.report.results import (
    MethodResult,
    Result,
    distinct,
    metric_note,
    short_labels,
)
from asp_env.evaluation.results import ORACLE_SHARE, SCORE, difference_of
from asp_env.evaluation.statistics import LEVEL, is_resolved, samples_needed
from asp_env.evaluation.verdicts import oracle_phrase, share_text

RATIO = "FDE / constant velocity"
"""The metric that the answer in open loop is from."""

Verdict = Literal["yes", "no", "not resolved", "no method under test", "not compared"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Answer:
    """One sentence, what it follows from, and the method that it is about."""

    verdict: Verdict
    sentence: str
    """Follows the verdict, from which it is separated by a colon."""
    details: tuple[str, ...]
    method: MethodResult | None = None
    """The best method under test; None without one."""

    @property
    def heading(self) -> str:
        """The verdict as the first words of a sentence."""
        return self.verdict.capitalize()


def driving_answer(results: Sequence[Result], *, places: int | None = None) -> Answer | None:
    """Whether the planner drives better with one of the methods under test than with the reference.

    A method counts as better or worse if its difference is resolved and its p value, adjusted by
    Holm's method over all methods, is below 5 %. Of several better methods the answer is about the
    best.

    Args:
        results: Closed-loop results of one condition.
        places: Number of locations of the scenarios, if it is known.

    Returns:
        The answer, None without results.
    """
    scores = score_differences(results)
    if not results:
        return None
    if not scores:
        sentence = (
            f"the score of no method is compared with a reference; {_drives(results, places)}."
        )
        return Answer(verdict="not compared", sentence=sentence, details=())
    tested = [r for r in scores if under_test(r)]
    drives = _drives(scores, places)
    if not tested:
        return _answer_without_tests(scores, drives)
    better = [r for r in tested if _counts(r) and (r.value or 0.0) > 0]
    worse = [r for r in tested if _counts(r) and (r.value or 0.0) < 0]
    best = max(better or tested, key=lambda r: r.value or 0.0)
    predictor, planner = _subject(best, [r.method for r in results])
    subject = f"with {predictor} {planner}"
    share = next((r for r in results if r.metric == ORACLE_SHARE and _same(r, best)), None)
    details = _details(best, tested, better, worse, share)
    if better:
        phrase, _ = oracle_phrase(share)
        like = f", {phrase}" if phrase else ""
        verdict, sentence = "yes", f"{subject} drives better{_than(best)} by {gain(best)}{like}"
    elif len(worse) == len(tested):
        verdict, sentence = "no", f"{subject} drives worse{_than(best)} by {gain(best)}"
    elif all(r.value == 0.0 and r.mde == 0.0 for r in tested):
        verdict, sentence = "no", f"{subject} drives exactly as{_than(best).removeprefix(' than')}"
    else:
        verdict = "not resolved"
        sentence = (
            f"the score of {planner} with {predictor} less that with {_reference(best)} is "
            f"{gain(best)}"
        )
    return Answer(
        verdict=verdict, sentence=f"{sentence}; {drives}.", details=details, method=best.method
    )


def forecast_answer(results: Sequence[Result]) -> Answer | None:
    """Whether one of the predictors under test forecasts better than constant velocity.

    Args:
        results: Open-loop results of one condition.

    Returns:
        The answer, None if the results contain no ratio to constant velocity.
    """
    ratios = [r for r in results if r.metric == RATIO and r.selection == "most-probable"]
    subset = next(iter(distinct((r.subset for r in ratios), first=("moving", "all"))), None)
    ratios = [r for r in ratios if r.subset == subset and r.value is not None and r.at_s is None]
    if not ratios:
        return None
    tested = [r for r in ratios if under_test(r) and r.method.predictor != BASELINE]
    targets = f"{max(r.n or 0 for r in ratios):,.0f} {'moving ' * (subset == 'moving')}targets"
    if not tested:
        return Answer(
            verdict="no method under test",
            sentence=f"the predictors are controls; {targets}.",
            details=(),
        )
    best = min(tested, key=lambda r: r.value or 0.0)
    name = short_labels([r.method for r in results])[best.method]
    at = f" at {best.horizon_s} s" if best.horizon_s else ""
    verdict: Verdict = "not resolved"
    sentence = f"the FDE of {name}{at} is {interval_text(best)} times that of {BASELINE}"
    if best.low is not None and best.high is not None and not best.low <= 1 <= best.high:
        verdict, quality = ("yes", "better") if best.high < 1 else ("no", "worse")
        sentence = (
            f"{name} forecasts {quality} than {BASELINE}, with an FDE{at} that is "
            f"{interval_text(best)} times as large"
        )
    details = ["how it drives is measured by asp-env drive"]
    if len(tested) > 1:
        details.insert(
            0,
            f"the best of {len(tested)} predictors under test; intervals are not adjusted for this",
        )
    return Answer(
        verdict=verdict,
        sentence=f"{sentence}; {targets}.",
        details=tuple(details),
        method=best.method,
    )


def score_differences(results: Sequence[Result]) -> list[Result]:
    """The differences of the score over all scenarios, the best first."""
    rows = [
        r
        for r in results
        if r.subset == "all"
        and r.value is not None
        and (pair := difference_of(r.metric)) is not None
        and pair[0] == SCORE
    ]
    return sorted(rows, key=lambda r: -(r.value or 0.0))


def under_test(result: Result) -> bool:
    """Whether the method of a result is compared for its own sake, and not a control."""
    method = result.method
    return is_under_test(method.predictor, privileged=method.privileged)


def outcome(result: Result) -> str:
    """`better`, `worse`, `equal` or `open`, for the colour of a difference."""
    if result.value == 0.0 and result.mde == 0.0:
        return "equal"
    if not is_resolved(result.value or 0.0, result.low, result.high, result.mde):
        return "open"
    lower = metric_note(result.metric).better == "lower"
    return "better" if ((result.value or 0.0) > 0) != lower else "worse"


def gain(result: Result) -> str:
    """A difference with its sign, unit and interval, such as `+0.026 [0.002, 0.051]`."""
    note = metric_note(result.metric)
    text = f"{note.signed(result.value or 0.0)} {note.unit}".strip()
    if result.low is None or result.high is None:
        return text
    return f"{text} [{note.format(result.low)}, {note.format(result.high)}]"


def interval_text(result: Result) -> str:
    """A value with its interval, without sign and unit."""
    note = metric_note(result.metric)
    text = note.format(result.value or 0.0)
    if result.low is None or result.high is None:
        return text
    return f"{text} [{note.format(result.low)}, {note.format(result.high)}]"


def _counts(result: Result) -> bool:
    resolved = is_resolved(result.value or 0.0, result.low, result.high, result.mde)
    return resolved and (result.p_holm is None or result.p_holm < 1 - LEVEL)


def _same(one: Result, other: Result) -> bool:
    return (one.method, one.subset) == (other.method, other.subset)


def _drives(scores: Sequence[Result], places: int | None) -> str:
    text = f"{max(r.n or 0 for r in scores):,.0f} drives"
    if places is None:
        return text
    return f"{text}, {places:,} {'place' if places == 1 else 'places'}"


def _subject(best: Result, methods: Sequence[MethodResult]) -> tuple[str, str]:
    """The predictor and the planner of a method, as parts of a sentence."""
    planners = {method.planner for method in methods if method.predictor}
    planner = "this planner" if len(planners) == 1 else best.method.planner
    name = short_labels([*dict.fromkeys(methods)])[best.method]
    return name.removeprefix(f"{best.method.planner} + "), planner


def _reference(result: Result) -> str:
    pair = difference_of(result.metric)
    return "" if pair is None else pair[1]


def _than(result: Result) -> str:
    return f" than with {_reference(result)}"


def _details(
    best: Result,
    tested: Sequence[Result],
    better: Sequence[Result],
    worse: Sequence[Result],
    share: Result | None,
) -> tuple[str, ...]:
    """What the answer follows from: power, oracle share, number of methods."""
    note = metric_note(best.metric)
    details = []
    if len(tested) > 1:
        details.append(
            f"the best of {len(tested)} methods under test, of which {len(better)} "
            f"{'is' if len(better) == 1 else 'are'} resolved as better and {len(worse)} as worse"
        )
    if share is not None and share.value is not None:
        details.append(f"oracle share {share_text(share)}")
    if best.low is None:
        details.append("one recording, therefore no interval")
    if best.mde is not None:
        details.append(f"these drives resolve differences from {note.format(best.mde)} on (MDE)")
        needed = samples_needed(best.value or 0.0, best.mde, int(best.n or 0))
        if not _counts(best) and needed is not None and needed > (best.n or 0):
            details.append(f"a difference of this size needs about {_two_digits(needed):,} drives")
    if best.p_holm is not None:
        p = "< 0.001" if best.p_holm < 0.001 else f"= {best.p_holm:.3f}"
        over = "all methods of the table, controls included"
        details.append(f"p {p}, adjusted by Holm's method over {over}")
    return tuple(details)


def _answer_without_tests(scores: Sequence[Result], drives: str) -> Answer:
    """What the oracle gains, the most that any forecast can gain here."""
    oracle = [r for r in scores if r.method.predictor == ORACLE]
    if not oracle:
        sentence = f"only controls drive here; {drives}."
    else:
        sentence = (
            f"the oracle drives by {gain(oracle[0])} better{_than(oracle[0])}, which bounds what "
            f"forecasts can gain here; {drives}."
        )
    return Answer(verdict="no method under test", sentence=sentence, details=())


def _two_digits(number: int) -> int:
    """A number rounded up to two significant digits."""
    unit = 10 ** max(len(str(number)) - 2, 0)
    return -(-number // unit) * unit
