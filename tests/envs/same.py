"""Bitwise comparison of what environments return."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode


def same(one: Any, other: Any, path: str = "") -> None:
    """Asserts equal types, shapes and bits; containers are compared item by item."""
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
    """Asserts that two vector environments return the same bits; returns the number of endings."""
    same(one.reset(seed=3), other.reset(seed=3))
    ends = 0
    for each in actions:
        returned = one.step(each)
        same(returned, other.step(each))
        over = returned[2] | returned[3]
        ends += int(over.sum())
        if mode is AutoresetMode.DISABLED and over.any():
            returned = one.reset(options={"reset_mask": over.copy()})
            same(returned, other.reset(options={"reset_mask": over.copy()}))
    return ends


def same_alone(one: Any, other: Any, seed: int) -> None:
    """Asserts that a parallel environment with one agent returns what a single one returns."""
    rng = np.random.default_rng(seed)
    same([part["vehicle_0"] for part in one.reset(seed=seed)], list(other.reset(seed=seed)))
    while one.agents:
        action = rng.uniform(-0.3, 0.6, 2)
        returned = one.step({"vehicle_0": action})
        same([part["vehicle_0"] for part in returned], list(other.step(action)))
