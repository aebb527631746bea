"""Environments with highway-env's traffic and small observations."""

from typing import Any

import numpy as np

from asp_env.envs.replay import ReplayEnv


def make(data: str, **options: Any) -> ReplayEnv:
    """An environment that observes the ego's state and its past actions."""
    return ReplayEnv(data, **{"observations": ("state", "actions"), **options})


def ego(env: ReplayEnv) -> np.ndarray:
    """[x m, y m, heading rad, speed m/s] now."""
    return env.scene().states[0, 0, -1]
