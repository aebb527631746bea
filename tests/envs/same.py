"""Whether two things that environments return are the same, bit for bit."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode


def same(one: Any, other: Any, path: str = "") -> None:
    """Fails where types, shapes or bits differ; containers are compared part by part."""
    assert type(one) is type(other), f"{path}: {type(one)} and {type(other)}"
    if isinstance(one, dict):
        assert set(one) == set(other), f"{path}: {set(one) ^ set(other)}"
        for name in one:
            same(one[name], other[name], f"{path}/{name}")
    elif isinstance(one, list | tuple):
        assert len(one) == len(other), path
        for number, (left, right) in enumerate(zip(one, other, strict=True)):
            same(left, right, f"{path}/{number}")
    elif isinstance(one, np.ndarray):
        assert (one.dtype, one.shape) == (other.dtype, other.shape), path
        if one.dtype == object:
            same(one.tolist(), other.tolist(), path)
        else:
            assert one.tobytes() == other.tobytes(), f"{path}: {one} and {other}"
    else:
        assert one == other, f"{path}: {one} and {other}"


def same_through_ends(
    one: Any, other: Any, mode: AutoresetMode, actions: Sequence[np.ndarray]
) -> int:
    """Two batches return the same bits through their episodes' ends; how many there were."""
    same(one.reset(seed=3), other.reset(seed=3))
    ends = 0
    for each in actions:
        told = one.step(each)
        same(told, other.step(each))
        over = told[2] | told[3]
        ends += int(over.sum())
        if mode is AutoresetMode.DISABLED and over.any():
            told = one.reset(options={"reset_mask": over.copy()})
            same(told, other.reset(options={"reset_mask": over.copy()}))
    return ends


def same_alone(one: Any, other: Any, seed: int) -> None:
    """The only agent of a parallel environment is told what a single one tells its ego."""
    rng = np.random.default_rng(seed)
    same([part["vehicle_0"] for part in one.reset(seed=seed)], list(other.reset(seed=seed)))
    while one.agents:
        action = rng.uniform(-0.3, 0.6, 2)
        told = one.step({"vehicle_0": action})
        same([part["vehicle_0"] for part in told], list(other.step(action)))
