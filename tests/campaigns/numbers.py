"""Values that other programs and damage put in the place of a number, and JSON with them."""

import json
from collections.abc import Sequence
from typing import Any, TypeVar

import numpy as np

T = TypeVar("T")

NUMBERS: Sequence[str] = (
    *("1e39", "-1e39", "1e308", "-1e308", "1e999", "1e23", "1e15", "1e-320", "3.4e38"),
    *("nan", "NaN", "inf", "-inf", "Infinity", "", " ", "None", "null", "true", "x", "-"),
    *("0", "-0", "-1", "1", "0.5", "8.5", "100000", "2147483647", "2147483648", "4294967301"),
    *("9007199254740993", "9223372036854775808", "18446744073709551616", "9" * 100, "9" * 5_000),
    *("0x10", "1_000", "1,5", "1.234.567", "²", "١٢", "1e", "+5", "--5", "1 2", "65535"),
)
"""Texts of numbers at the edges of types, of no numbers, and of numbers in other notations."""

VALUES: Sequence[Any] = (
    *(None, True, False, "", "x", "../../etc/passwd", "a\nb", "x" * 5_000, [], {}, [[]], [None]),
    *(
        0,
        -1,
        1,
        2,
        3,
        0.5,
        8.5,
        1e308,
        -1e308,
        1e39,
        1e-320,
        2**31,
        2**53,
        2**63,
        10**400,
        64_000_000,
    ),
    *(float("nan"), float("inf"), float("-inf"), {"name": 1}, [1e308, -1e308], ["a", "b"]),
    *(64_000_000, 6.4e7),
)
"""Values that JSON can hold, or Python's JSON."""


def pick(rng: np.random.Generator, items: Sequence[T]) -> T:
    """One of some items."""
    return items[int(rng.integers(len(items)))]


def mutate_json(rng: np.random.Generator, content: bytes) -> bytes:
    """Replaces, removes, repeats or renames something at a random place, or nests it deeply."""
    tree = json.loads(content)
    if rng.random() < 0.05:
        depth = int(pick(rng, (100, 2_000, 100_000)))
        return b"[" * depth + pick(rng, (b"", b"1" + b"]" * depth))
    places = list(_places(tree))
    if not places:
        return json.dumps(pick(rng, VALUES)).encode()
    depths = sorted({len(path) for path, _ in places})
    depth = pick(rng, depths)  # few values at the top, many within lists
    holder, key = pick(rng, [place for path, place in places if len(path) == depth])
    kind = int(rng.integers(8))
    if kind == 0:
        del holder[key]
    elif kind == 1 and isinstance(holder, dict):
        holder[f"{key} "] = holder.pop(key)
    elif kind == 1:
        holder.append(holder[key])
    elif kind == 2 and isinstance(holder[key], int | float):
        holder[key] *= pick(rng, (-1, 2, 10, 1.5, 1e6, 1e30))
    elif kind == 3 and isinstance(holder, dict):
        other = pick(rng, list(holder))
        holder[key], holder[other] = holder[other], holder[key]
    else:
        holder[key] = pick(rng, VALUES)
    return json.dumps(tree).encode()


def _places(tree: Any, path: tuple[Any, ...] = ()) -> Any:
    """(path, (container, key)) of everything within some JSON."""
    keys = (
        list(tree) if isinstance(tree, dict) else range(len(tree)) if isinstance(tree, list) else ()
    )
    for key in keys:
        yield (*path, key), (tree, key)
        yield from _places(tree[key], (*path, key))
