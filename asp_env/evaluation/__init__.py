"""Evaluation of predictors and planners: runs, statistics, tables and reports.

The two runs can be called from Python as well; options have the names of the commands' options:

    from asp_env.evaluation import Drive, drive

    result = drive(Drive(data="sample:intersection", out=Path("unused"), jobs=2))
"""

from asp_env.evaluation.closed_loop.drive import ClosedLoopResult, Drive, drive
from asp_env.evaluation.open_loop.evaluate import Evaluate, OpenLoopResult, evaluate
from asp_env.evaluation.results import Row
from asp_env.evaluation.statistics import Estimate

__all__ = [
    "ClosedLoopResult",
    "Drive",
    "Estimate",
    "Evaluate",
    "OpenLoopResult",
    "Row",
    "drive",
    "evaluate",
]
