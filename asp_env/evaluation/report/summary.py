"""The first glance: a few figures that say what came out, and what was run."""

from collections.abc import Iterator, Sequence
from html import escape
from typing import Any

from asp_env.evaluation.report.notes import note
from asp_env.evaluation.report.results import Result, Results, best, distinct

BASELINE = "constant-velocity"
DRIVING_METRICS = ("score", "nuplanscore", "pdms", "atfaultcollision", "collision", "progress")
SELECTIONS = ("most-probable", "best-of-3")


def cards(results: Results) -> str:
    """Cards: the best predictor beside constant velocity, the best driver beside the expert."""
    found = [*_forecast_cards(results.open_loop), *_driving_cards(results.driving)]
    return f"<div class='cards'>{''.join(found)}</div>" if found else ""


def _forecast_cards(results: Sequence[Result]) -> Iterator[str]:
    subset = _first_subset(results, "moving", "all")
    for selection in SELECTIONS:
        mine = [
            r
            for r in results
            if (r.subset, r.selection, r.metric.lower()) == (subset, selection, "fde")
        ]
        winner = best(mine, better="lower")
        if winner is None:
            continue
        horizon = f" at {winner.horizon_s} s" if winner.horizon_s else ""
        base = [
            f"{r.value:.2f} m for constant velocity"
            for r in mine
            if r.entrant.predictor == BASELINE
            and r.value is not None
            and (r.data, r.horizon_s) == (winner.data, winner.horizon_s)
        ]
        heading = f"FDE{horizon}, {selection.replace('-', ' ')}, {subset or 'all'} targets"
        yield _card(heading, winner, "".join(base[:1]))


def _driving_cards(results: Sequence[Result]) -> Iterator[str]:
    subset = _first_subset(results, "all")
    mine = [result for result in results if result.subset == subset]
    labels = [note(metric).label for metric in DRIVING_METRICS]
    told = distinct(r.metric for r in mine if note(r.metric).label in labels)
    told.sort(key=lambda metric: labels.index(note(metric).label))
    for metric in told[:2]:
        column = [result for result in mine if result.metric == metric]
        winner = best(column, better=note(metric).better)
        if winner is None:
            continue
        expert = [
            f"{note(metric).format(r.value)} {note(metric).unit} for the logged expert"
            for r in column
            if r.entrant.planner == "expert" and r.value is not None and r.data == winner.data
        ]
        yield _card(note(metric).label, winner, "".join(expert[:1]))


def _first_subset(results: Sequence[Result], *first: str) -> str:
    return next(iter(distinct((result.subset for result in results), first=first)), "")


def _card(heading: str, winner: Result, beside: str) -> str:
    told = note(winner.metric)
    return (
        f"<div class='card'><h3>{escape(heading)}</h3>"
        f"<p class='figure'>{told.format(winner.value or 0.0)}<small> {told.unit}</small></p>"
        f"<p>{escape(winner.entrant.name)}</p><p class='beside'>{escape(beside)}</p></div>"
    )


def manifest(found: dict[str, Any]) -> str:
    """The manifest as a list of definitions, nested ones folded."""
    return f"<dl class='manifest'>{''.join(_entry(*item) for item in found.items())}</dl>"


def _entry(name: str, value: Any) -> str:
    return f"<dt>{escape(name.replace('_', ' '))}</dt><dd>{_value(value)}</dd>"


def _value(value: Any) -> str:
    if isinstance(value, dict):
        inner = "".join(_entry(str(name), part) for name, part in value.items())
        many = "1 entry" if len(value) == 1 else f"{len(value)} entries"
        return f"<details><summary>{many}</summary><dl class='manifest'>{inner}</dl></details>"
    if isinstance(value, list):
        return ", ".join(_value(part) for part in value) or "-"
    return "-" if value is None or value == "" else escape(str(value))
