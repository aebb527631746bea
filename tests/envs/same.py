"""Whether two things that environments return are the same, bit for bit."""

from typing import Any

import numpy as np


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
