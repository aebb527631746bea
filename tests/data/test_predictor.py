"""Loading of predictors by name."""

from typing import Any, ClassVar

import pytest

from asp_env import registry
from asp_env.data import Forecast, Future, Predictor, Scene, load_predictor
from asp_env.errors import AspEnvError


def test_untrained_predictor_has_the_given_horizon_and_time_step() -> None:
    predictor = load_predictor("constant-velocity", horizon=10, dt_s=0.1)
    assert (predictor.name, predictor.horizon, predictor.dt_s) == ("constant-velocity", 10, 0.1)
    assert not predictor.privileged
    assert predictor.trained_on is None


def test_oracle_is_privileged() -> None:
    assert load_predictor("oracle", horizon=10, dt_s=0.2).privileged


@pytest.mark.parametrize(
    ("name", "kind", "argument"),
    [
        ("plug", "plug", ""),
        ("plug:runs/1", "plug", "runs/1"),
        ("plug:a:b", "plug", "a:b"),
    ],
)
def test_plug_receives_the_text_behind_the_first_colon(
    monkeypatch: pytest.MonkeyPatch, name: str, kind: str, argument: str
) -> None:
    calls: list[tuple[Any, ...]] = []
    predictor = load_predictor("constant-velocity", horizon=10, dt_s=0.1)

    class Plug:
        def from_name(self, argument: str, *, horizon: int, dt_s: float) -> Predictor:
            calls.append((argument, horizon, dt_s))
            return predictor

    monkeypatch.setattr(registry, "find", lambda *args: (calls.append(args), Plug())[1])
    assert load_predictor(name, horizon=15, dt_s=0.2) is predictor
    assert calls == [("predictors", kind), (argument, 15, 0.2)]


class FormerPredictor:
    """A predictor, and its own plug, of a package that still defines `about`."""

    __slots__ = ("dt_s", "horizon")
    name = "former"
    privileged = False
    history = 0
    trained_on = None
    about: ClassVar[dict[str, str]] = {"weights": "abc"}

    def __init__(self, horizon: int, dt_s: float) -> None:
        self.horizon, self.dt_s = horizon, dt_s

    @classmethod
    def from_name(cls, argument: str, *, horizon: int, dt_s: float) -> Any:
        del argument
        return cls(horizon, dt_s)

    def predict(self, scene: Scene, future: Future | None = None) -> Forecast:
        raise NotImplementedError


@pytest.mark.parametrize("bases", [(FormerPredictor,), (FormerPredictor, Predictor)])
def test_former_name_of_metadata_still_works(
    bases: tuple[type, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The first load warns; the predictor then satisfies the protocol.

    A class with the protocol as a base inherits a `metadata` without content.
    """
    kind = type("Former", bases, {})
    monkeypatch.setattr(registry, "find", lambda *_: kind)
    with pytest.warns(DeprecationWarning, match=r"Former\.about .* rename it to `metadata`"):
        predictor = load_predictor("former", horizon=5, dt_s=0.2)
    assert isinstance(predictor, Predictor)
    assert predictor.metadata == {"weights": "abc"}


def test_unknown_name_is_reported_without_its_argument() -> None:
    with pytest.raises(AspEnvError, match=r"'constant-velocty' \(did you mean 'constant-vel"):
        load_predictor("constant-velocty:runs/1", horizon=10, dt_s=0.2)
