"""Scenarios: which episodes can be driven, with tags and measures by which they are selected."""

from asp_env.data.scenarios.scenario import Scenario, ScenarioFilter, ScenarioSet, find_scenarios
from asp_env.data.scenarios.selection import (
    choose_scenarios,
    load_scenarios,
    save_scenarios,
    scenario_of,
)
from asp_env.data.scenarios.tags import COLUMNS, TAGS

__all__ = [
    "COLUMNS",
    "TAGS",
    "Scenario",
    "ScenarioFilter",
    "ScenarioSet",
    "choose_scenarios",
    "find_scenarios",
    "load_scenarios",
    "save_scenarios",
    "scenario_of",
]
