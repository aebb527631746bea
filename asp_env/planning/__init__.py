"""Planners: they decide what the ego does, given a scene and a forecast of the other agents."""

from asp_env.planning.idm import IDMPlanner
from asp_env.planning.planner import (
    CandidatePlanner,
    Candidates,
    Expert,
    Plan,
    Planner,
    load_planner,
)
from asp_env.planning.regret import planning_regret
from asp_env.planning.sampling import SamplingPlanner, SamplingWeights

__all__ = [
    "CandidatePlanner",
    "Candidates",
    "Expert",
    "IDMPlanner",
    "Plan",
    "Planner",
    "SamplingPlanner",
    "SamplingWeights",
    "load_planner",
    "planning_regret",
]
