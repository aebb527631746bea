"""The ground floor: how a vehicle moves. One definition for NumPy and torch."""

from asp_env.dynamics.bicycle import forward, inverse, rollout, wrap_angle
from asp_env.dynamics.limits import MAX_ACCELERATION_MPS2, MAX_STEERING_RAD, clip_actions

__all__ = [
    "MAX_ACCELERATION_MPS2",
    "MAX_STEERING_RAD",
    "clip_actions",
    "forward",
    "inverse",
    "rollout",
    "wrap_angle",
]
