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
from asp_env.dynamics.car_following import IDM, follow_paths, speed_limits

__all__ = [
    "IDM",
    "MAX_ACCELERATION_MPS2",
    "MAX_STEERING_RAD",
    "clip_actions",
    "denormalize_actions",
    "follow_paths",
    "forward",
    "inverse",
    "normalize_actions",
    "rollout",
    "speed_limits",
]
