"""A report that people look at: one self-contained file of HTML per run folder."""

from asp_env.evaluation.report.page import check_report_possible, write_report
from asp_env.evaluation.report.payload import ForecastExamples

__all__ = ["ForecastExamples", "check_report_possible", "write_report"]
