"""Checks of arguments: each returns the value in a type of Python's own, or raises an error."""

import math
import numbers
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from asp_env.errors import AspEnvError

MAX_SEED = 2**32 - 1
"""Largest seed that the generators of all packages take: those of NumPy, torch and SB3."""

MAX_JOBS = 1024
"""Largest number of processes of a command. Chosen by hand: above the cores of one machine."""

_LONGEST = 80
"""Longest value, in characters, that a message shows in full."""


def shown(value: object) -> str:
    """The value as one short line, for messages."""
    text = " ".join(repr(value).split())
    return text if len(text) <= _LONGEST else f"{text[: _LONGEST - 1]}…"


def whole_number(
    name: str, value: object, *, least: int | None = None, most: int | None = None
) -> int:
    """Checks a whole number.

    Args:
        name: name of the argument.
        value: its value. A bool is no number.
        least: the smallest value that is allowed, if any.
        most: the largest value that is allowed, if any.

    Raises:
        AspEnvError: the value is no whole number, or out of range.
    """
    if isinstance(value, numbers.Integral) and not isinstance(value, bool):
        number = int(value)
        if (least is None or number >= least) and (most is None or number <= most):
            return number
    bounds = (f" of at least {least}" if least is not None else "") + (
        f"{' and' if least is not None else ' of'} at most {most}" if most is not None else ""
    )
    raise AspEnvError(f"{name} {shown(value)}: expected a whole number{bounds}")


def is_finite_number(value: object) -> bool:
    """Whether a value is a real, finite number; a bool is none."""
    return (
        isinstance(value, numbers.Real)
        and not isinstance(value, bool | np.bool_)
        and math.isfinite(value)
    )


def positive_number(name: str, value: Any, unit: str = "") -> float:
    """Checks a finite number above 0.

    Args:
        name: name of the argument.
        value: its value.
        unit: unit of numbers, for messages.

    Raises:
        AspEnvError: the value is something else.
    """
    if is_finite_number(value) and value > 0:
        return float(value)
    given = f"{value} {unit}".rstrip() if isinstance(value, numbers.Real) else shown(value)
    raise AspEnvError(f"{name} {given}: expected a positive number")


def flag(name: str, value: object) -> bool:
    """Checks a truth value.

    Raises:
        AspEnvError: the value is neither True nor False.
    """
    if isinstance(value, bool | np.bool_):
        return bool(value)
    raise AspEnvError(f"{name} {shown(value)}: expected True or False")


def text(name: str, value: object) -> str:
    """Checks a text.

    Raises:
        AspEnvError: the value is no text.
    """
    if isinstance(value, str):
        return value
    raise AspEnvError(f"{name} {shown(value)}: expected a text")


def table(name: str, value: object, expected: str) -> Mapping[Any, Any]:
    """Checks a mapping.

    Args:
        name: name of the argument.
        value: its value.
        expected: what its entries are, for messages.

    Raises:
        AspEnvError: the value is no mapping.
    """
    if isinstance(value, Mapping):
        return value
    raise AspEnvError(f"{name} {shown(value)}: expected a mapping of {expected}")


def path(name: str, value: object) -> Path:
    """Checks a path.

    Raises:
        AspEnvError: the value is neither a path nor a text that is not empty.
    """
    if isinstance(value, Path) or (isinstance(value, str) and value):
        return Path(value)
    raise AspEnvError(f"{name} {shown(value)}: expected a path")


def check_jobs(jobs: int, *, least: int = 1) -> None:
    """Checks a number of processes, the option `--jobs` of commands.

    Raises:
        AspEnvError: it is below `least` or above `MAX_JOBS`.
    """
    if not least <= jobs <= MAX_JOBS:
        raise AspEnvError(f"--jobs {jobs}: expected {least} to {MAX_JOBS} processes")


def check_max_scenarios(count: int | None) -> None:
    """Checks a largest number of scenarios, the option `--max-scenarios` of commands.

    Raises:
        AspEnvError: it is below 1.
    """
    if count is not None and count < 1:
        raise AspEnvError(f"--max-scenarios {count}: expected at least 1")
