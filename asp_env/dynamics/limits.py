"""Limits of actions that somebody chooses; actions inferred from logs may exceed the first."""

import math
from types import ModuleType
from typing import Any

import numpy as np
from jaxtyping import Float

MAX_ACCELERATION_MPS2 = 5.0
MAX_STEERING_RAD = math.pi / 4


def namespace(array: object) -> ModuleType:
    """The module whose functions take `array`: torch for tensors, else NumPy."""
    if type(array).__module__.partition(".")[0] == "torch":
        import torch

        return torch
    return np


def clip_actions(actions: Float[Any, "*batch 2"]) -> Float[Any, "*batch 2"]:
    """Actions [acceleration m/s², steering rad] moved to the nearest that is allowed."""
    xp = namespace(actions)
    acceleration = xp.clip(actions[..., 0], -MAX_ACCELERATION_MPS2, MAX_ACCELERATION_MPS2)
    steering = xp.clip(actions[..., 1], -MAX_STEERING_RAD, MAX_STEERING_RAD)
    return xp.stack([acceleration, steering], axis=-1)
