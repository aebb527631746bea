"""Predictors by name."""

from typing import Any

import pytest

from asp_env import registry
from asp_env.data.predictor import Predictor, load_predictor
from asp_env.errors import AspEnvError


def test_for_the_scenes_to_come() -> None:
    """A name alone is made for the horizon and the time step that are asked for."""
    predictor = load_predictor("constant-velocity", horizon=10, dt_s=0.1)
    assert (predictor.name, predictor.horizon, predictor.dt_s) == ("constant-velocity", 10, 0.1)
    assert not predictor.privileged
    assert predictor.trained_on is None


def test_oracle_is_privileged() -> None:
    """The one that is handed the future says so."""
    assert load_predictor("oracle", horizon=10, dt_s=0.2).privileged


@pytest.mark.parametrize(
    ("name", "kind", "argument"),
    [
        ("plug", "plug", ""),
        ("plug:runs/1", "plug", "runs/1"),
        ("plug:a:b", "plug", "a:b"),
    ],
)
def test_what_stands_behind_the_colon(
    monkeypatch: pytest.MonkeyPatch, name: str, kind: str, argument: str
) -> None:
    """Everything behind the first colon goes to the plug."""
    asked: list[tuple[Any, ...]] = []
    made = load_predictor("constant-velocity", horizon=10, dt_s=0.1)

    class Plug:
        def from_name(self, argument: str, *, horizon: int, dt_s: float) -> Predictor:
            asked.append((argument, horizon, dt_s))
            return made

    monkeypatch.setattr(registry, "find", lambda *args: (asked.append(args), Plug())[1])
    assert load_predictor(name, horizon=15, dt_s=0.2) is made
    assert asked == [("predictors", kind), (argument, 15, 0.2)]


def test_wrong_name() -> None:
    """What stands behind the colon plays no part in looking for the name."""
    with pytest.raises(AspEnvError, match=r"'constant-velocty' \(did you mean 'constant-vel"):
        load_predictor("constant-velocty:runs/1", horizon=10, dt_s=0.2)
