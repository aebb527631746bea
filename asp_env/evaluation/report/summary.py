"""The first glance: a few figures that say what came out, and what was run."""

from collections.abc import Iterator, Sequence
from html import escape
from typing import Any

from asp_env.evaluation.report.notes import note
from asp_env.evaluation.report.results import Result, Results, best, distinct

BASELINE = "constant-velocity"
RATIO = "FDE / constant velocity"
DRIVING_METRICS = ("score", "no at-fault collision")
LONG_LIST = 12
"""Longer lists of the manifest are folded."""

SELECTIONS = ("most-probable", "best-of-3")


def cards(results: Results) -> str:
    """Cards: the best predictor beside constant velocity, the best driver beside the expert."""
    found = [*_forecast_cards(results.open_loop), *_driving_cards(results.driving)]
    return f"<div class='cards'>{''.join(found)}</div>" if found else ""


def _forecast_cards(results: Sequence[Result]) -> Iterator[str]:
    subset = _first_subset(results, "moving", "all")
    for selection in SELECTIONS:
        mine = [
            r for r in results if (r.subset, r.selection) == (subset, selection) and r.at_s is None
        ]
        winner = best([r for r in mine if r.metric == "FDE"], better="lower")
        if winner is None:
            continue
        horizon = f" at {winner.horizon_s} s" if winner.horizon_s else ""
        heading = f"FDE{horizon}, {selection.replace('-', ' ')}, {subset or 'all'} targets"
        yield _card(heading, winner, _beside_baseline(winner, mine))


def _beside_baseline(winner: Result, results: Sequence[Result]) -> str:
    """What constant velocity does there, and the paired ratio to it if it was computed."""
    where = (winner.data, winner.horizon_s)
    here = [r for r in results if (r.data, r.horizon_s) == where and r.value is not None]
    base = [r for r in here if r.metric == "FDE" and r.entrant.predictor == BASELINE]
    ratio = [r for r in here if r.metric == RATIO and r.entrant == winner.entrant]
    if not base or winner.entrant.predictor == BASELINE:
        return ""
    told = f"constant velocity: {base[0].value:.2f} m"
    if not ratio:
        return told
    between = (
        ""
        if ratio[0].low is None or ratio[0].high is None
        else f" ({ratio[0].low:.2f} to {ratio[0].high:.2f})"
    )
    return f"{told}; ratio {ratio[0].value:.2f}{between}"


def _driving_cards(results: Sequence[Result]) -> Iterator[str]:
    subset = _first_subset(results, "all")
    mine = [result for result in results if result.subset == subset]
    for metric in DRIVING_METRICS:
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
    if isinstance(value, list) and len(value) > LONG_LIST:
        inner = ", ".join(_value(part) for part in value)
        return f"<details><summary>{len(value)} entries</summary>{inner}</details>"
    if isinstance(value, list):
        return ", ".join(_value(part) for part in value) or "&ndash;"
    return "&ndash;" if value is None or value == "" else escape(str(value))
