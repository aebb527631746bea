"""Dynamics: the kinematic bicycle model, for NumPy and torch, and the intelligent driver model."""

from asp_env.dynamics.bicycle import (
    MAX_ACCELERATION_MPS2,
    MAX_STEERING_RAD,
    clip_actions,
    forward,
    inverse,
    rollout,
)

__all__ = [
    "MAX_ACCELERATION_MPS2",
    "MAX_STEERING_RAD",
    "clip_actions",
    "forward",
    "inverse",
    "rollout",
]
