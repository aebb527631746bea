"""Does this trajectory predictor make the car drive better?

Importing this package registers the Gymnasium environments `asp_env/Replay-v0`,
`asp_env/HighwayIntersection-v0` and `asp_env/HighwayRoundabout-v0`, and of each one with light
observations, such as `asp_env/ReplayVectors-v0` and `asp_env/ReplayState-v0`. The public names are
imported on first use, so that `import asp_env` stays cheap.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

import gymnasium

if TYPE_CHECKING:
    from asp_env.data.predictor import Forecast, Predictor
    from asp_env.data.rollout import Rollout
    from asp_env.data.scenarios.scenario import Scenario
    from asp_env.data.scene import Scene
    from asp_env.data.source import load, open_data
    from asp_env.dynamics import denormalize_actions, normalize_actions
    from asp_env.envs import (
        FlatParts,
        ForecastOptions,
        PredictionFeatures,
        ReplayEnv,
        ReplayVectorEnv,
        VectorPredictionFeatures,
        parallel_env,
        sb3_vec_env,
    )
    from asp_env.errors import AspEnvError
    from asp_env.planning.planner import Plan, Planner

__all__ = [
    "AspEnvError",
    "FlatParts",
    "Forecast",
    "ForecastOptions",
    "Plan",
    "Planner",
    "PredictionFeatures",
    "Predictor",
    "ReplayEnv",
    "ReplayVectorEnv",
    "Rollout",
    "Scenario",
    "Scene",
    "VectorPredictionFeatures",
    "denormalize_actions",
    "load",
    "normalize_actions",
    "open_data",
    "parallel_env",
    "sb3_vec_env",
]

_MODULES = {
    "asp_env.data.predictor": ("Forecast", "Predictor"),
    "asp_env.data.rollout": ("Rollout",),
    "asp_env.data.scenarios.scenario": ("Scenario",),
    "asp_env.data.scene": ("Scene",),
    "asp_env.data.source": ("load", "open_data"),
    "asp_env.dynamics": ("denormalize_actions", "normalize_actions"),
    "asp_env.envs": (
        "FlatParts",
        "ForecastOptions",
        "PredictionFeatures",
        "ReplayEnv",
        "ReplayVectorEnv",
        "VectorPredictionFeatures",
        "parallel_env",
        "sb3_vec_env",
    ),
    "asp_env.errors": ("AspEnvError",),
    "asp_env.planning.planner": ("Plan", "Planner"),
}
_MODULE_OF = {name: module for module, names in _MODULES.items() for name in names}

_SUBMODULES = frozenset({"data", "dynamics", "envs", "errors", "metrics", "registry", "sim"})
"""Sub-modules that `import asp_env` alone makes available as attributes, imported on first use."""


def __getattr__(name: str) -> Any:
    """Imports a public name or a sub-module on first use."""
    if name in _SUBMODULES:
        return import_module(f"{__name__}.{name}")
    if name not in _MODULE_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(import_module(_MODULE_OF[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    """Lists the public names, imported or not."""
    return sorted({*globals(), *__all__, *_SUBMODULES})


_WORLDS = {
    "Replay": {},
    "HighwayIntersection": {"data": "highway:intersection"},
    "HighwayRoundabout": {"data": "highway:roundabout"},
}
_OBSERVATIONS = {
    "": {},
    "Vectors": {"observations": ("vectors", "state", "route"), "flatten": "parts"},
    "State": {"observations": ("state", "route", "nearest"), "flatten": True},
}

for _world, _data in _WORLDS.items():
    for _suffix, _options in _OBSERVATIONS.items():
        gymnasium.register(
            id=f"asp_env/{_world}{_suffix}-v0",
            entry_point="asp_env.envs.replay:ReplayEnv",
            vector_entry_point="asp_env.envs.vector:ReplayVectorEnv",
            kwargs={**_data, **_options},
        )
