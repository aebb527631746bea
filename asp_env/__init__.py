"""Does this trajectory predictor make the car drive better?

Importing this package registers the Gymnasium environment `asp_env/Replay-v0`.
"""

import gymnasium

from asp_env.data.source import load
from asp_env.envs.entry import parallel_env, sb3_vec_env
from asp_env.envs.flat import FlatParts
from asp_env.envs.prediction_features import PredictionFeatures, VectorPredictionFeatures
from asp_env.errors import AspEnvError

__all__ = [
    "AspEnvError",
    "FlatParts",
    "PredictionFeatures",
    "VectorPredictionFeatures",
    "load",
    "parallel_env",
    "sb3_vec_env",
]

gymnasium.register(
    id="asp_env/Replay-v0",
    entry_point="asp_env.envs.replay:ReplayEnv",
    vector_entry_point="asp_env.envs.vector:ReplayVectorEnv",
)
