"""Hashes of everything that an environment returns, to compare instances and processes."""

import hashlib
from typing import Any

import gymnasium
import numpy as np

from asp_env.envs.replay import ReplayEnv
from asp_env.envs.vector import ReplayVectorEnv

COMPONENTS = ("raster", "vectors", "actions", "state", "route")


def make(data: str, **options: Any) -> ReplayEnv:
    """Makes an environment with all components of the observation and small rasters."""
    return ReplayEnv(data, **{"raster_px": (45, 30), "observations": COMPONENTS, **options})


def digest(value: object, into: Any) -> None:
    """Updates a hash with every bit of an observation, a reward or an info."""
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
    """Returns a hash of everything that an environment returns over several episodes."""
    seen, rng = hashlib.sha256(), np.random.default_rng(seed)
    digest(env.reset(seed=seed), seen)
    for _ in range(steps):
        returned = env.step(rng.uniform((-0.5, -0.3), (1.0, 0.3)))
        digest(returned, seen)
        if returned[2] or returned[3]:
            digest(env.reset(), seen)
    return seen.hexdigest()


def trace_vector(data: str, *, steps: int, **options: Any) -> str:
    """Returns a hash of everything that a vector environment of three returns."""
    options = {"raster_px": (45, 30), "observations": COMPONENTS, **options}
    envs = ReplayVectorEnv(3, data, **options)
    seen, rng = hashlib.sha256(), np.random.default_rng(0)
    digest(envs.reset(seed=5), seen)
    for _ in range(steps):
        digest(envs.step(rng.uniform((-0.5, -0.3), (1.0, 0.3), size=(3, 2))), seen)
    return seen.hexdigest()
