"""The figures of the page as JSON values that its script draws.

A figure of rows has a value with its interval in every row, on an axis of the range of these
values. Numbers are as printed: percentages are multiplied by 100.
"""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from asp_env.evaluation.ladder import BASELINE, rung
from asp_env.evaluation.report.answer import outcome, score_differences, under_test
from asp_env.evaluation.report.results import (
    SELECTIONS,
    SUBSETS,
    MethodResult,
    Result,
    distinct,
    methods_of,
    metric_note,
    short_labels,
)
from asp_env.evaluation.report.scenario_values import SAME, ScenarioValues
from asp_env.evaluation.results import SCORE, difference_of

APART = ("expert", "blind")
"""Planner and predictor of the methods that differ in nearly every metric; they do not decide
whether a metric varies."""

Payload = dict[str, Any]


def rankings(results: Sequence[Result]) -> list[Payload]:
    """Differences of the score by method with intervals, over the rungs of the ladder.

    Each planner has a figure with its own ladder, as the reference and the oracle are others with
    each planner. With several planners the first figure compares all methods by their score, the
    expert among them.

    Args:
        results: Closed-loop results of one condition.

    Returns:
        The figures; none if there are no differences.
    """
    scores = score_differences(results)
    planners = [p for p in distinct(r.method.planner for r in scores) if p not in APART]
    if len(planners) < 2:
        return [_ranking(scores)] if scores else []
    found = [_ranking([r for r in scores if r.method.planner == each]) for each in planners]
    for planner, figure in zip(planners, found, strict=True):
        figure["title"] = f"{planner}: {figure['title'][0].lower()}{figure['title'][1:]}"
    return [_all_scores(results), *found]


def _ranking(scores: Sequence[Result]) -> Payload:
    """The figure of one planner."""
    labels = _labels(scores)
    reference = _reference(scores[0])
    note = metric_note(scores[0].metric)
    rungs = [
        {"label": _rung_label(share), "value": _number(r.value, note.scale)}
        for r in scores
        if (share := rung(r.method.predictor)) is not None
    ]
    if reference == BASELINE and rungs:
        rungs.insert(0, {"label": _rung_label(0.0), "value": 0.0})
    return {
        "kind": "rows",
        "title": f"Score less that with {reference}",
        "axis": _axis(f"score less that with {reference}", note.unit),
        "rows": [_row(r, labels[r.method]) for r in scores],
        "rungs": rungs,
        "zero": reference,
        "decimals": 3,
    }


def _all_scores(results: Sequence[Result]) -> Payload:
    """The scores of all methods of several planners, the highest first."""
    scores = [r for r in results if (r.metric, r.subset) == (SCORE, "all") and r.value is not None]
    scores.sort(key=lambda r: -(r.value or 0.0))
    labels = _labels(scores)
    note = metric_note(SCORE)
    controls = {r.method for r in score_differences(results) if not under_test(r)}
    return {
        "kind": "rows",
        "title": "Score of all methods",
        "axis": _axis(note.label, note.unit),
        "rows": [
            row | {"control": row["control"] or r.method in controls}
            for r in scores
            for row in [_row(r, labels[r.method])]
        ],
        "zero": None,
        "decimals": 1 if note.unit == "%" else 3,
    }


def other_metrics(results: Sequence[Result]) -> tuple[list[Payload], str]:
    """A figure for each metric other than the score that varies, and a line on the others.

    The figures show differences to the reference where there are any, else values.

    Args:
        results: Closed-loop results of one condition.
    """
    labels = _labels(results)
    every = [r for r in results if r.subset == "all" and r.value is not None and r.at_s is None]
    differences = [r for r in every if (pair := difference_of(r.metric)) and pair[0] != SCORE]
    shown = differences or [r for r in every if not r.is_comparison and r.metric != SCORE]
    figures, same = [], []
    for metric in distinct(r.metric for r in shown):
        group = [r for r in shown if r.metric == metric]
        pair = difference_of(metric)
        note = metric_note(pair[0] if pair else metric)
        base = [r for r in every if r.metric == (pair[0] if pair else metric)]
        texts = {note.format(r.value or 0.0) for r in base or group if not _is_apart(r.method)}
        if len(texts) < 2:
            same.append(f"{note.label} {next(iter(texts), '')} {note.unit}".strip())
            continue
        title = f"{note.label} less that with {pair[1]}" if pair else note.label
        figures.append(
            {
                "kind": "rows",
                "title": title,
                "axis": _axis("" if pair else note.label, note.unit, note.better),
                "rows": [_row(r, labels[r.method]) for r in group],
                "zero": pair[1] if pair else None,
                "decimals": 1 if note.unit == "%" else 2,
            }
        )
    return figures, "; ".join(same)


def tags(results: Sequence[Result]) -> Payload | None:
    """Differences of the score by tag of the scenarios, with a choice of methods.

    Args:
        results: Closed-loop results of one condition.

    Returns:
        The figure, None if there are no differences by tag.
    """
    labels = _labels(results)
    rows = [
        r
        for r in results
        if r.value is not None and (pair := difference_of(r.metric)) and pair[0] == SCORE
    ]
    choices = []
    for overall in _tested_first(score_differences(results)):
        mine = [r for r in rows if r.method == overall.method and r.subset != "all"]
        if mine:
            mine.sort(key=lambda r: -(r.value or 0.0))
            of_tags = [_row(r, f"{r.subset} ({r.n or 0:.0f})") for r in mine]
            everything = _row(overall, f"all scenarios ({overall.n or 0:.0f})")
            choices.append({"label": labels[overall.method], "rows": [everything, *of_tags]})
    if not choices:
        return None
    reference = _reference(rows[0])
    return {
        "kind": "rows",
        "title": f"Score less that with {reference}, by tag",
        "axis": _axis(f"score less that with {reference}", metric_note(rows[0].metric).unit),
        "choices": choices,
        "zero": reference,
        "decimals": 3,
    }


def scenario_differences(
    results: Sequence[Result], values: ScenarioValues | None
) -> Payload | None:
    """The difference of the score in every scenario in which it is not 0, in descending order.

    Args:
        results: Closed-loop results of one condition.
        values: Scores of the condition by scenario.

    Returns:
        The figure with a choice of methods, None if the scores are not known.
    """
    labels, choices = _labels(results), []
    scores = _tested_first(score_differences(results))
    for overall in scores if values is not None else []:
        method = (overall.method.planner, overall.method.predictor)
        found = values.differences(method, _reference(overall)) if values else None
        if found is None or values is None:
            continue
        pairs = [
            (round(float(d), 4), name)
            for d, name in zip(found, values.names, strict=True)
            if abs(d) >= SAME
        ]
        pairs.sort(key=lambda pair: -pair[0])
        better = sum(d > 0 for d, _ in pairs)
        text = (
            f"The score differs by {SAME:g} or more in {len(pairs)} of {len(values.names)} "
            f"scenarios: {better} higher, {len(pairs) - better} lower."
        )
        choices.append({"label": labels[overall.method], "text": text, "bars": pairs})
    if not any(choice["bars"] for choice in choices):
        return None
    reference = _reference(scores[0])
    return {
        "kind": "bars",
        "title": f"Score less that with {reference}, by scenario",
        "choices": choices,
    }


def forecast_errors(results: Sequence[Result]) -> Iterator[Payload]:
    """FDE by predictor, a figure for each selection of modes.

    Args:
        results: Open-loop results of one condition.
    """
    labels = _labels(results)
    errors = [r for r in results if r.metric == "FDE" and r.at_s is None and r.value is not None]
    subset = next(iter(distinct((r.subset for r in errors), first=("moving", *SUBSETS))), None)
    for horizon_s in distinct(r.horizon_s for r in errors):
        for selection in distinct((r.selection for r in errors), first=SELECTIONS):
            group = [
                r
                for r in errors
                if (r.subset, r.selection, r.horizon_s) == (subset, selection, horizon_s)
            ]
            if len(group) > 1:
                group.sort(key=lambda r: r.value or 0.0)
                at = f" at {horizon_s} s" if horizon_s else ""
                kind = f"{selection.replace('-', ' ')} mode" if selection else "all modes"
                title = f"FDE{at}, {kind}, {subset} targets"
                yield {
                    "kind": "rows",
                    "title": title,
                    "axis": _axis(f"FDE{at}", "m", "lower"),
                    "rows": [_row(r, labels[r.method]) for r in group],
                    "zero": None,
                    "decimals": 2,
                }


def regret(results: Sequence[Result]) -> Payload | None:
    """Planning regret removed by predictor, over all scenarios.

    Args:
        results: Open-loop results of one condition.

    Returns:
        The figure, None if there is no planning regret.
    """
    labels = _labels(results)
    group = [
        r
        for r in results
        if (r.metric, r.subset) == ("regret removed", "all") and r.value is not None
    ]
    if len(group) < 2:
        return None
    note = metric_note(group[0].metric)
    return {
        "kind": "rows",
        "title": "Planning regret removed, all scenarios",
        "axis": _axis(note.label, note.unit),
        "rows": [_row(r, labels[r.method]) for r in sorted(group, key=lambda r: -(r.value or 0.0))],
        "zero": None,
        "decimals": 1,
    }


def errors_over_time(results: Sequence[Result], colours: Mapping[str, int]) -> Iterator[Payload]:
    """Lines of metrics such as `L2@1s` over the time ahead, a figure for each selection.

    Args:
        results: Open-loop results of one condition.
        colours: Number of the colour of each predictor.
    """
    labels = _labels(results)
    results = [r for r in results if r.at_s is not None and r.value is not None]
    subset = next(iter(distinct((r.subset for r in results), first=("moving", "all"))), None)
    results = sorted((r for r in results if r.subset == subset), key=lambda r: r.at_s or 0.0)
    for selection in distinct((r.selection for r in results), first=SELECTIONS):
        group = [r for r in results if r.selection == selection]
        kind = f"{selection.replace('-', ' ')} mode" if selection else "all modes"
        yield {
            "kind": "lines",
            "title": f"Error over the time ahead, {kind}, {subset} targets",
            "axis": "time ahead, s",
            "vertical": "error, m",
            "series": [
                {
                    "label": labels[method],
                    "colour": colours.get(method.predictor, -1),
                    "points": [
                        [r.at_s, *(_number(v, 1.0) for v in (r.value, r.low, r.high))]
                        for r in group
                        if r.method == method
                    ],
                }
                for method in methods_of(group)
            ],
        }


def _labels(results: Sequence[Result]) -> dict[MethodResult, str]:
    return short_labels(methods_of(results))


def _reference(result: Result) -> str:
    pair = difference_of(result.metric)
    return pair[1] if pair else ""


def _tested_first(results: Sequence[Result]) -> list[Result]:
    return sorted(results, key=lambda r: not under_test(r))


def _is_apart(method: MethodResult) -> bool:
    return method.planner in APART or method.predictor in APART


def _rung_label(share: float) -> str:
    return {0.0: "CV", 1.0: "oracle"}.get(share, f"{100 * share:.0f} %")


def _axis(text: str, unit: str, better: str = "higher") -> str:
    arrow = {"lower": "better to the left", "higher": "better to the right"}.get(better, "")
    return ", ".join(part for part in (text, unit, arrow) if part)


def _row(result: Result, label: str) -> Payload:
    """A row of a figure; its class selects its colour."""
    note = metric_note(result.metric)
    test = under_test(result) or difference_of(result.metric) is None
    return {
        "label": label,
        "value": _number(result.value, note.scale),
        "low": _number(result.low, note.scale),
        "high": _number(result.high, note.scale),
        "mde": _number(result.mde, note.scale),
        "class": outcome(result) if difference_of(result.metric) else "plain",
        "control": result.method.privileged or not test,
    }


def _number(value: float | None, scale: float) -> float | None:
    return None if value is None else round(scale * value, 4)
