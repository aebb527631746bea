"""Data: recordings, road maps, scenarios, scenes, forecasts and rollouts."""

from asp_env.data.causal import causal_histories
from asp_env.data.classes import AgentClass
from asp_env.data.histories import histories
from asp_env.data.predictor import (
    FeaturePredictor,
    Forecast,
    GuardablePlug,
    InteractivePredictor,
    Predictor,
    PredictorPlug,
    PresentPredictor,
    feature_size,
    fill_missing,
    load_predictor,
    make_forecast,
    reads_past,
)
from asp_env.data.recording import Recording
from asp_env.data.road_map import RoadMap
from asp_env.data.rollout import Rollout
from asp_env.data.scenarios import (
    Scenario,
    ScenarioFilter,
    ScenarioSet,
    find_scenarios,
)
from asp_env.data.scene import Scene
from asp_env.data.signals import SceneSignals, Signals, SignalState
from asp_env.data.snippets import Future, SnippetIndex, gather_future, gather_scene, index_snippets
from asp_env.data.source import Recordings, open_data
from asp_env.data.split import TrainedOn

__all__ = [
    "AgentClass",
    "FeaturePredictor",
    "Forecast",
    "Future",
    "GuardablePlug",
    "InteractivePredictor",
    "Predictor",
    "PredictorPlug",
    "PresentPredictor",
    "Recording",
    "Recordings",
    "RoadMap",
    "Rollout",
    "Scenario",
    "ScenarioFilter",
    "ScenarioSet",
    "Scene",
    "SceneSignals",
    "SignalState",
    "Signals",
    "SnippetIndex",
    "TrainedOn",
    "causal_histories",
    "feature_size",
    "fill_missing",
    "find_scenarios",
    "gather_future",
    "gather_scene",
    "histories",
    "index_snippets",
    "load_predictor",
    "make_forecast",
    "open_data",
    "reads_past",
]
