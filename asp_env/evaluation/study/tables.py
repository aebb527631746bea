"""Tables of a study for the terminal: methods by condition, and faults."""

from collections import Counter
from collections.abc import Collection, Iterator, Sequence

from rich import box
from rich.table import Table
from rich.text import Text

from asp_env.evaluation.closed_loop.scenario_table import DrivenScenarios
from asp_env.evaluation.results import SCORE, Row, difference_of
from asp_env.evaluation.selection import short_names
from asp_env.evaluation.statistics import is_resolved
from asp_env.evaluation.study.questions import Answer

SUBSETS = ("all", "interactive")
"""Subsets of the scenarios that are shown, the last that occurs."""

MOST_SENTENCES = 8
"""Number of sentences of an answer that are printed."""

NOT_RESOLVED = "~"
"""Mark of differences that are not resolved."""

PRIVILEGED = "*"
"""Mark of methods that use the recorded future."""


def condition_tables(rows: Sequence[Row], privileged: Collection[str]) -> list[Table]:
    """For each DATA, the score of every method by traffic and latency, less that of the reference.

    Rules without a score show no table.

    Args:
        rows: closed-loop rows of `metrics.csv`.
        privileged: names of the privileged planners and predictors, which are marked.
    """
    return [
        _table([row for row in rows if row.data == data], data, privileged)
        for data in dict.fromkeys(row.data for row in rows if row.metric == SCORE)
    ]


def _table(rows: Sequence[Row], data: str, privileged: Collection[str]) -> Table:
    subset = next(name for name in reversed(SUBSETS) if any(row.subset == name for row in rows))
    rows = [row for row in rows if row.subset == subset]
    conditions = dict.fromkeys((row.traffic, row.latency_ticks or 0) for row in rows)
    references = dict.fromkeys(pair[1] for row in rows if (pair := difference_of(row.metric)))
    count = max(row.n for row in rows)
    table = Table(
        title=f"{data}: score in {count} scenarios ({subset})",
        caption=f"in parentheses less that of {', '.join(references)} with the same planner in the "
        f"same condition; {NOT_RESOLVED} not resolved"
        + (f"; {PRIVILEGED} uses the recorded future" if privileged else ""),
        box=box.SIMPLE_HEAD,
        show_edge=False,
        padding=(0, 1, 0, 0),
    )
    table.add_column("method", min_width=18)
    for traffic, latency in conditions:
        table.add_column(traffic + (f"\n{latency} ticks" if latency else ""), justify="right")
    short = short_names(list(dict.fromkeys(row.predictor for row in rows)))
    for planner, predictor in dict.fromkeys((row.planner, row.predictor) for row in rows):
        name = " + ".join(part for part in (planner, short[predictor]) if part)
        mark = PRIVILEGED if {planner, predictor} & set(privileged) else ""
        own = [row for row in rows if (row.planner, row.predictor) == (planner, predictor)]
        table.add_row(name + mark, *(_cell(own, condition) for condition in conditions))
    return table


def _cell(rows: Sequence[Row], condition: tuple[str, int]) -> str:
    here = [row for row in rows if (row.traffic, row.latency_ticks or 0) == condition]
    score = next((row for row in here if row.metric == SCORE), None)
    if score is None:
        return ""
    text = f"{score.value:.3f}"
    for row in here:
        pair = difference_of(row.metric)
        if pair is not None and pair[0] == SCORE:
            mark = "" if is_resolved(row.value, row.low, row.high, row.mde) else NOT_RESOLVED
            text += f" ({row.value:+.3f}{mark})"
    return text


def answer_lines(answers: Sequence[Answer]) -> Iterator[str | Text]:
    """Each question, with the first sentences of its answer."""
    for answer in answers:
        if answer.sentences:
            yield Text(f"\n{answer.question}", style="bold")
            yield from (f"  {sentence}" for sentence in answer.sentences[:MOST_SENTENCES])
            if (more := len(answer.sentences) - MOST_SENTENCES) > 0:
                yield f"  {more} more in manifest.json and metrics.csv"


def fault_lines(driven: Sequence[DrivenScenarios]) -> Iterator[str]:
    """A line for each method and condition with faults, with an example."""
    for each in driven:
        for method in each.methods:
            faults = [f for scores in method.scores for f in scores.faults if f is not None]
            if not faults:
                continue
            drives = sum(len(scores.faults) for scores in method.scores)
            causes = Counter(f"{fault.socket} {fault.cause}" for fault in faults)
            counts = ", ".join(f"{cause} {count}" for cause, count in causes.items())
            first = str(faults[0])
            name = " + ".join(part for part in (method.planner, method.predictor) if part)
            yield (
                f"{name}, {each.condition.label}: faults in {len(faults)} of "
                f"{drives} drives, filled in by constant velocity ({counts}); first: {first}"
            )
