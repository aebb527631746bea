"""Planners: they decide what the ego does, given a scene and a forecast of the other agents."""

from asp_env.planning.contingency import ContingencyPlanner, ContingencyWeights
from asp_env.planning.idm import IDMPlanner
from asp_env.planning.pdm import PDMPlanner, PDMWeights
from asp_env.planning.planner import (
    CandidatePlanner,
    Expert,
    Plan,
    Planner,
    load_planner,
    planning_regret,
)
from asp_env.planning.sampling import SamplingPlanner, SamplingWeights

__all__ = [
    "CandidatePlanner",
    "ContingencyPlanner",
    "ContingencyWeights",
    "Expert",
    "IDMPlanner",
    "PDMPlanner",
    "PDMWeights",
    "Plan",
    "Planner",
    "SamplingPlanner",
    "SamplingWeights",
    "load_planner",
    "planning_regret",
]
