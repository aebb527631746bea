"""Open-loop evaluation: forecasts are compared with the recorded future."""

from asp_env.evaluation.open_loop.ground_truth import GroundTruth, gather_ground_truth
from asp_env.evaluation.open_loop.scoring import ForecastScores, MetricValues, score_forecasts

__all__ = [
    "ForecastScores",
    "GroundTruth",
    "MetricValues",
    "gather_ground_truth",
    "score_forecasts",
]
