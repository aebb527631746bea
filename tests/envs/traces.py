"""Hashes of all that an environment returns, for comparisons between instances and processes."""

import hashlib
from typing import Any

import gymnasium
import numpy as np

from asp_env.envs.replay import ReplayEnv
from asp_env.envs.vector import ReplayVectorEnv

PARTS = ("raster", "vectors", "actions", "state", "route")


def make(data: str, **options: Any) -> ReplayEnv:
    """With every kind of observation and small pictures."""
    return ReplayEnv(data, **{"raster_px": (45, 30), "observations": PARTS, **options})


def digest(value: object, into: Any) -> None:
    """Feeds every bit of an observation, a reward or an info to a hash."""
    if isinstance(value, dict):
        for name in sorted(value):
            into.update(str(name).encode())
            digest(value[name], into)
    elif isinstance(value, tuple):
        for each in value:
            digest(each, into)
    elif isinstance(value, np.ndarray) and value.dtype != object:
        into.update(f"{value.dtype}{value.shape}".encode() + value.tobytes())
    else:
        into.update(repr(value).encode())


def trace(env: gymnasium.Env, *, seed: int = 5, steps: int = 60) -> str:
    """A hash of all that an environment returns over several episodes."""
    seen, rng = hashlib.sha256(), np.random.default_rng(seed)
    digest(env.reset(seed=seed), seen)
    for _ in range(steps):
        told = env.step(rng.uniform((-0.5, -0.3), (1.0, 0.3)))
        digest(told, seen)
        if told[2] or told[3]:
            digest(env.reset(), seen)
    return seen.hexdigest()


def trace_vector(data: str, *, steps: int, **options: Any) -> str:
    """A hash of all that three environments side by side return."""
    envs = ReplayVectorEnv(3, data, **{"raster_px": (45, 30), "observations": PARTS, **options})
    seen, rng = hashlib.sha256(), np.random.default_rng(0)
    digest(envs.reset(seed=5), seen)
    for _ in range(steps):
        digest(envs.step(rng.uniform((-0.5, -0.3), (1.0, 0.3), size=(3, 2))), seen)
    return seen.hexdigest()
