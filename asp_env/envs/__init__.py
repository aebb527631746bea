"""The Gymnasium, PettingZoo and stable-baselines3 environments, and their wrappers.

`ParallelReplayEnv` and `ReplayVecEnv` need PettingZoo and stable-baselines3. They are not part of
`from asp_env.envs import *`.
"""

from typing import TYPE_CHECKING, Any

from asp_env.envs.constructors import parallel_env, sb3_vec_env
from asp_env.envs.forecasts import ForecastOptions
from asp_env.envs.options import ReplayOptions, UnknownOptionError
from asp_env.envs.replay import EnvSnapshot, ReplayEnv
from asp_env.envs.vector import ReplayVectorEnv, VectorSnapshot
from asp_env.envs.wrappers import FlatParts, PredictionFeatures, VectorPredictionFeatures

if TYPE_CHECKING:
    from asp_env.envs.parallel import ParallelReplayEnv as ParallelReplayEnv
    from asp_env.envs.sb3 import ReplayVecEnv as ReplayVecEnv

__all__ = [
    "EnvSnapshot",
    "FlatParts",
    "ForecastOptions",
    "PredictionFeatures",
    "ReplayEnv",
    "ReplayOptions",
    "ReplayVectorEnv",
    "UnknownOptionError",
    "VectorPredictionFeatures",
    "VectorSnapshot",
    "parallel_env",
    "sb3_vec_env",
]


def __getattr__(name: str) -> Any:
    """Imports the environments that need PettingZoo or stable-baselines3 on first use."""
    if name == "ParallelReplayEnv":
        from asp_env.envs.parallel import ParallelReplayEnv

        return ParallelReplayEnv
    if name == "ReplayVecEnv":
        from asp_env.envs.sb3 import ReplayVecEnv

        return ReplayVecEnv
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
