"""Does this trajectory predictor make the car drive better?

Importing this package registers the Gymnasium environments `asp_env/Replay-v0`,
`asp_env/HighwayIntersection-v0` and `asp_env/HighwayRoundabout-v0`.
"""

import gymnasium

from asp_env.data.source import load
from asp_env.envs.registration import parallel_env, sb3_vec_env
from asp_env.envs.wrappers import FlatParts, PredictionFeatures, VectorPredictionFeatures
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

for _id, _given in (
    ("Replay", {}),
    ("HighwayIntersection", {"data": "highway:intersection"}),
    ("HighwayRoundabout", {"data": "highway:roundabout"}),
):
    gymnasium.register(
        id=f"asp_env/{_id}-v0",
        entry_point="asp_env.envs.replay:ReplayEnv",
        vector_entry_point="asp_env.envs.vector:ReplayVectorEnv",
        kwargs=_given,
    )
