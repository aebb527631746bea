"""Environments return the same bits in every instance and every process."""

import subprocess
import sys

import gymnasium
import numpy as np
from gymnasium.vector import AsyncVectorEnv

from tests.envs.same import same
from tests.envs.traces import make, trace, trace_vector


def test_two_instances_return_the_same_bits(crossing):
    """With other environments made and stepped in between."""
    first = make(crossing)
    expected = trace(first, steps=500)
    other = make(crossing, traffic="idm", observations=("state",))
    trace(other, seed=77)
    second = make(crossing)
    assert trace(second, steps=500) == expected
    assert trace(first, steps=60) == trace(second, steps=60)
    assert trace(first, seed=6, steps=60) != trace(second, steps=60)


def test_another_process_returns_the_same_bits(crossing):
    """Over 500 steps of a single and a vector environment, with replayed and reacting traffic."""
    script = (
        "import sys; from tests.envs.test_determinism import traces; print(*traces(sys.argv[1]))"
    )
    done = subprocess.run(
        [sys.executable, "-c", script, crossing], capture_output=True, text=True, check=True
    )
    assert done.stdout.split() == traces(crossing)


def traces(data):
    """Hashes of what the environments return."""
    return [
        found
        for traffic in ("log", "idm")
        for found in (
            trace(make(data, traffic=traffic), steps=500),
            trace_vector(data, steps=500, traffic=traffic),
        )
    ]


def test_async_vector_env_returns_the_same_bits(crossing):
    options = {"data": crossing, "observations": ("state", "vectors", "route")}
    one = gymnasium.make_vec(
        "asp_env/Replay-v0", num_envs=2, vectorization_mode="vector_entry_point", **options
    )
    other = gymnasium.make_vec(
        "asp_env/Replay-v0", num_envs=2, vectorization_mode="async", **options
    )
    assert isinstance(other, AsyncVectorEnv)
    try:
        same(one.reset(seed=4), other.reset(seed=4))
        rng = np.random.default_rng(0)
        for _ in range(60):
            actions = rng.uniform((0.0, -0.5), (1.0, 0.5), size=(2, 2)).astype(np.float32)
            same(one.step(actions), other.step(actions))
    finally:
        other.close()
