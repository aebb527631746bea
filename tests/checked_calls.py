"""Types and shapes are checked in the first calls of each function in each test.

jaxtyping's option `--jaxtyping-packages` has every call of every function checked, which takes
five times as long as what the functions do. Here a function is checked in its first `CHECKED_CALLS`
calls of each test, so that what is checked depends on no other test, and the code of a check is
made when it is first needed.
"""

import dataclasses
import functools
import inspect
from collections import Counter
from collections.abc import Callable
from typing import Any

import jaxtyping

CHECKED_CALLS = 3

_calls: Counter[object] = Counter()
_check_every_call = jaxtyping.jaxtyped


def begin_test() -> None:
    """Checks the first calls of each function anew."""
    _calls.clear()


def install() -> None:
    """Makes modules that are imported from now on be checked in this way."""
    jaxtyping.jaxtyped = _jaxtyped


def _jaxtyped(*, typechecker: Any) -> Callable[[Any], Any]:
    def decorate(target: Any) -> Any:
        if not inspect.isclass(target):
            return _check_first_calls(target, typechecker)
        if dataclasses.is_dataclass(target) and "__init__" in vars(target):
            target.__init__ = _check_first_calls(target.__init__, typechecker)
        return target

    return decorate


def _check_first_calls(function: Callable[..., Any], typechecker: Any) -> Callable[..., Any]:
    checked: Callable[..., Any] | None = None
    code = function.__code__  # the same for all closures of one definition

    @functools.wraps(function)
    def call(*args: Any, **kwargs: Any) -> Any:
        nonlocal checked
        if _calls[code] >= CHECKED_CALLS:
            return function(*args, **kwargs)
        _calls[code] += 1
        if checked is None:
            checked = _check_every_call(function, typechecker=typechecker)
        return checked(*args, **kwargs)

    return call
