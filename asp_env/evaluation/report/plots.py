"""Metrics as plotly figures in JSON; the page sets the colours of text and grids.

Plotly reads the text of labels as HTML, so names are escaped.
"""

import math
from collections.abc import Sequence
from html import escape

import plotly.graph_objects as go
from plotly.subplots import make_subplots

from asp_env.evaluation.report.results import (
    SELECTIONS,
    SUBSETS,
    MethodResult,
    Result,
    distinct,
    methods_of,
    metric_note,
)
from asp_env.evaluation.results import ORACLE_SHARE, SCORE, difference_of

COLOURS = ("#e8590c", "#7048e8", "#0ca678", "#1c7ed6", "#d6336c", "#c99700", "#5c7cfa", "#74b816")
PRIVILEGED_COLOUR = "#8a94a6"
PANELS_PER_ROW = 4


def colours(predictors: Sequence[str]) -> dict[str, str]:
    """A colour for each predictor, shared by plots and pictures."""
    return {name: COLOURS[number % len(COLOURS)] for number, name in enumerate(predictors)}


def final_errors(results: Sequence[Result], colour: dict[str, str]) -> str | None:
    """Bars of FDE with intervals by subset and method, a panel per selection.

    Args:
        results: Open-loop results; metrics other than FDE are ignored.
        colour: The colour of each predictor.

    Returns:
        The figure as JSON, None if there is nothing to show.
    """
    results = [r for r in results if r.metric == "FDE" and r.at_s is None and ":" not in r.subset]
    if not results:
        return None
    selections = distinct((r.selection for r in results), first=SELECTIONS)
    figure = _panels([escape(selection.replace("-", " ")) for selection in selections])
    for panel, selection in enumerate(selections, start=1):
        for method in methods_of(results):
            group = [r for r in results if (r.method, r.selection) == (method, selection)]
            group.sort(key=lambda r: SUBSETS.index(r.subset) if r.subset in SUBSETS else 9)
            bar = go.Bar(
                name=escape(method.label),
                legendgroup=escape(method.label),
                showlegend=panel == 1,
                x=[escape(r.subset) for r in group],
                y=_values(group),
                error_y=_whiskers(group),
                marker={"color": _colour(method, colour), "cornerradius": 3},
                hovertemplate="%{y:.2f} m",
            )
            figure.add_trace(bar, row=1, col=panel)
    figure.update_layout(barmode="group", bargap=0.28, bargroupgap=0.08, height=400)
    figure.update_yaxes(title_text="FDE, m", col=1)
    return _finish(figure)


def errors_over_time(results: Sequence[Result], colour: dict[str, str]) -> str | None:
    """Lines of metrics such as `L2@1s` over the time ahead, with intervals.

    The arguments and the return value are as for `final_errors`.
    """
    results = [r for r in results if r.at_s is not None]
    subset = next(iter(distinct((r.subset for r in results), first=("moving", "all"))), None)
    if subset is None:
        return None
    results = sorted((r for r in results if r.subset == subset), key=lambda r: r.at_s or 0.0)
    selections = distinct((r.selection for r in results), first=SELECTIONS)
    figure = _panels([escape(f"{s.replace('-', ' ')} · {subset} targets") for s in selections])
    for panel, selection in enumerate(selections, start=1):
        for method in methods_of(results):
            group = [r for r in results if (r.method, r.selection) == (method, selection)]
            line = go.Scatter(
                name=escape(method.label),
                legendgroup=escape(method.label),
                showlegend=panel == 1,
                x=[r.at_s for r in group],
                y=_values(group),
                error_y=_whiskers(group),
                mode="lines+markers",
                line={"color": _colour(method, colour), "width": 2.5},
                marker={"size": 7},
                hovertemplate="%{y:.2f} m",
            )
            figure.add_trace(line, row=1, col=panel)
    figure.update_layout(height=400, hovermode="x unified")
    figure.update_xaxes(title_text="time ahead, s", rangemode="tozero")
    figure.update_yaxes(rangemode="tozero")
    figure.update_yaxes(title_text="error, m", col=1)
    return _finish(figure)


def driving_metrics(results: Sequence[Result], colour: dict[str, str]) -> str | None:
    """A panel per metric with a point and an interval for each method.

    The arguments and the return value are as for `final_errors`, with closed-loop results.
    """
    subset = next(iter(distinct((r.subset for r in results), first=SUBSETS)), None)
    results = [r for r in results if r.subset == subset and r.value is not None and r.at_s is None]
    results = [r for r in results if not r.is_comparison or r.metric in _compared(results)]
    metrics = distinct(r.metric for r in results)
    if not metrics:
        return None
    methods = methods_of(results)
    columns = min(PANELS_PER_ROW, len(metrics))
    rows = math.ceil(len(metrics) / columns)
    height = rows * (95 + 30 * len(methods)) + 20
    figure = make_subplots(
        rows=rows,
        cols=columns,
        shared_yaxes=True,
        horizontal_spacing=0.025,
        vertical_spacing=75 / height if rows > 1 else 0,
        subplot_titles=[escape(_panel_title(metric)) for metric in metrics],
    )
    for number, metric in enumerate(metrics):
        row, column = number // columns + 1, number % columns + 1
        note = metric_note(metric)
        percent = note.unit == "%"
        for method in methods:
            group = [r for r in results if (r.method, r.metric) == (method, metric)]
            scale = 100.0 if percent else 1.0
            point = go.Scatter(
                x=_values(group, scale),
                y=[escape(method.label)] * len(group),
                error_x=_whiskers(group, scale),
                mode="markers",
                marker={"color": _colour(method, colour), "size": 10},
                hovertemplate="%{x:.2f}<extra>%{y}</extra>",
                showlegend=False,
            )
            figure.add_trace(point, row=row, col=column)
        if percent and note.better == "higher" and difference_of(metric) is None:
            figure.update_xaxes(range=[-4, 104], tickvals=[0, 50, 100], row=row, col=column)
        else:
            figure.update_xaxes(rangemode="tozero", nticks=5, row=row, col=column)
    figure.update_yaxes(autorange="reversed", ticks="")
    figure.update_layout(height=height)
    return _finish(figure, top_px=40)


def _compared(results: Sequence[Result]) -> set[str]:
    """The comparisons that have a panel: differences of the score, and oracle shares."""
    pairs = {r.metric: difference_of(r.metric) for r in results}
    return {
        ORACLE_SHARE,
        *(metric for metric, pair in pairs.items() if pair and pair[0] == SCORE),
    }


def _panel_title(metric: str) -> str:
    arrow = {"lower": "↓", "higher": "↑", "neither": ""}[metric_note(metric).better]
    return " ".join(
        part for part in (metric_note(metric).label, metric_note(metric).unit, arrow) if part
    )


def _panels(titles: Sequence[str]) -> go.Figure:
    return make_subplots(
        cols=len(titles), shared_yaxes=True, horizontal_spacing=0.03, subplot_titles=list(titles)
    )


def _colour(method: MethodResult, colour: dict[str, str]) -> str:
    return colour.get(method.predictor, PRIVILEGED_COLOUR)


def _values(results: Sequence[Result], scale: float = 1.0) -> list[float | None]:
    """Python numbers, which plotly writes as text rather than as packed arrays."""
    return [None if r.value is None else round(scale * r.value, 4) for r in results]


def _whiskers(results: Sequence[Result], scale: float = 1.0) -> dict:
    up = [scale * max((r.high or 0.0) - (r.value or 0.0), 0.0) for r in results]
    down = [
        scale * max((r.value or 0.0) - r.low, 0.0) if r.low is not None else 0.0 for r in results
    ]
    return {
        "type": "data",
        "symmetric": False,
        "array": [round(length, 4) for length in up],
        "arrayminus": [round(length, 4) for length in down],
        "thickness": 1.4,
        "width": 4,
    }


def _finish(figure: go.Figure, *, top_px: int = 72) -> str:
    figure.update_layout(
        template="none",
        margin={"l": 60, "r": 14, "t": top_px, "b": 54},
        legend={"orientation": "h", "yref": "container", "y": 0.99, "yanchor": "top", "x": 0},
        paper_bgcolor="rgba(0,0,0,0)",
        plot_bgcolor="rgba(0,0,0,0)",
    )
    return str(figure.to_json())
