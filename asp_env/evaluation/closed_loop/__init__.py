"""Closed-loop evaluation: a planner drives the ego with the forecasts of a predictor."""

from asp_env.evaluation.closed_loop.comparison import EpisodeScores, Method, Methods
from asp_env.evaluation.closed_loop.episodes import (
    DrivenEpisodes,
    EpisodeSettings,
    drive_episodes,
)

__all__ = [
    "DrivenEpisodes",
    "EpisodeScores",
    "EpisodeSettings",
    "Method",
    "Methods",
    "drive_episodes",
]
