"""Dynamics: the kinematic bicycle model, for NumPy and torch, and the intelligent driver model."""

from asp_env.dynamics.bicycle import (
    MAX_ACCELERATION_MPS2,
    MAX_STEERING_RAD,
    clip_actions,
    denormalize_actions,
    forward,
    inverse,
    normalize_actions,
    rollout,
)

__all__ = [
    "MAX_ACCELERATION_MPS2",
    "MAX_STEERING_RAD",
    "clip_actions",
    "denormalize_actions",
    "forward",
    "inverse",
    "normalize_actions",
    "rollout",
]
