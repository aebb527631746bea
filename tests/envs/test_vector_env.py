"""`ReplayVectorEnv` compared with Gymnasium's `SyncVectorEnv` over single environments."""

from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode, SyncVectorEnv, VectorEnv

from tests.envs.same import same_through_ends

ALL = ("raster", "vectors", "actions", "state", "route")
COUNT = 4


def _batched(data: str, **options: Any) -> VectorEnv:
    return gymnasium.make_vec(
        "asp_env/Replay-v0",
        num_envs=COUNT,
        vectorization_mode="vector_entry_point",
        data=data,
        **{"raster_px": (45, 30), **options},
    )


def _singles(data: str, mode: AutoresetMode, **options: Any) -> SyncVectorEnv:
    envs = gymnasium.make_vec(
        "asp_env/Replay-v0",
        num_envs=COUNT,
        vectorization_mode="sync",
        vector_kwargs={"autoreset_mode": mode},
        data=data,
        **{"raster_px": (45, 30), **options},
    )
    assert isinstance(envs, SyncVectorEnv)
    return envs


def _actions(rng: np.random.Generator) -> np.ndarray:
    """Full acceleration and random steering, which lead to all kinds of endings."""
    return rng.uniform((0.0, -0.5), (1.0, 0.5), size=(COUNT, 2)).astype(np.float32)


@pytest.mark.parametrize("mode", list(AutoresetMode), ids=lambda mode: mode.value)
@pytest.mark.parametrize("traffic", ["log", "log-actions", "idm"])
def test_returns_the_bits_of_single_environments(crossing, traffic, mode):
    """Observations, rewards, endings and infos through many autoresets."""
    one = _batched(crossing, traffic=traffic, observations=ALL, autoreset_mode=mode)
    other = _singles(crossing, mode, traffic=traffic, observations=ALL)
    rng = np.random.default_rng(0)
    assert same_through_ends(one, other, mode, [_actions(rng) for _ in range(100)]) > 2 * COUNT
