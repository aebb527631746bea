"""The first calls of a function in each test are checked, and no test depends on another."""

import dataclasses

import jaxtyping
import numpy as np
import pytest
from beartype import beartype
from jaxtyping import Float

from asp_env.geometry import box_corners
from tests import checked_calls
from tests.checked_calls import CHECKED_CALLS, _jaxtyped, begin_test

THREE, FOUR = np.zeros(3), np.zeros((2, 2))


@_jaxtyped(typechecker=beartype)
def _first(values: Float[np.ndarray, " n"]) -> float:
    return float(values.flat[0])


@_jaxtyped(typechecker=beartype)
@dataclasses.dataclass(frozen=True, kw_only=True)
class _Pair:
    values: Float[np.ndarray, " n"]
    weights: Float[np.ndarray, " n"]


def test_the_packages_are_checked() -> None:
    with pytest.raises(jaxtyping.TypeCheckError, match="box_corners"):
        box_corners(np.zeros((2, 4)), np.zeros((3, 2)))


def test_first_calls_are_checked_again_in_the_next_test() -> None:
    for _ in range(2):
        begin_test()
        for call in range(CHECKED_CALLS):
            if call % 2:
                assert _first(THREE) == 0.0
            else:
                with pytest.raises(jaxtyping.TypeCheckError):
                    _first(FOUR)
        assert _first(FOUR) == 0.0


def test_a_dataclass_is_checked_where_it_is_made() -> None:
    assert len(_Pair(values=THREE, weights=THREE).values) == 3
    with pytest.raises(jaxtyping.TypeCheckError):
        _Pair(values=THREE, weights=FOUR[0])


def test_closures_of_one_definition_are_counted_together(monkeypatch: pytest.MonkeyPatch) -> None:
    made = []
    check = checked_calls._check_every_call
    monkeypatch.setattr(
        checked_calls, "_check_every_call", lambda *args, **kw: made.append(1) or check(*args, **kw)
    )

    def closure() -> object:
        @_jaxtyped(typechecker=beartype)
        def inner(value: int) -> int:
            return value

        return inner(1)

    for _ in range(2 * CHECKED_CALLS):
        closure()
    assert len(made) == CHECKED_CALLS
