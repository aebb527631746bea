"""The report of a run: results read from its folder, and one self-contained page of HTML."""

from asp_env.evaluation.report.episodes import Episode, find_episodes
from asp_env.evaluation.report.page import check_report_possible, write_report
from asp_env.evaluation.report.payload import ForecastExamples
from asp_env.evaluation.report.results import (
    MethodResult,
    MetricNote,
    Result,
    Results,
    metric_note,
    read_results,
)

__all__ = [
    "Episode",
    "ForecastExamples",
    "MethodResult",
    "MetricNote",
    "Result",
    "Results",
    "check_report_possible",
    "find_episodes",
    "metric_note",
    "read_results",
    "write_report",
]
