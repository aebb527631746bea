"""Plugs by name, and what a wrong name is answered."""

from importlib.metadata import EntryPoint

import pytest

from asp_env import registry
from asp_env.errors import (
    AspEnvError,
    CheckpointError,
    DataError,
    MissingExtraError,
    unknown_name,
)


def one_line(error: BaseException) -> str:
    """The message, which must be a single line."""
    (line,) = str(error).splitlines()
    return line


def test_unknown_name() -> None:
    """The error lists what is known, in order, and suggests the nearest."""
    assert one_line(unknown_name("fruit", "aple", ["pear", "apple"])) == (
        "unknown fruit 'aple' (did you mean 'apple'?): known are apple, pear"
    )
    assert one_line(unknown_name("fruit", "xyz", ["pear", "apple"])) == (
        "unknown fruit 'xyz': known are apple, pear"
    )


@pytest.mark.parametrize("kind", [AspEnvError, DataError, CheckpointError, MissingExtraError])
def test_one_family(kind: type[Exception]) -> None:
    """Whoever catches AspEnvError, or ValueError as for any bad argument, catches them all."""
    assert issubclass(kind, AspEnvError)
    assert issubclass(kind, ValueError)


def test_missing_extra() -> None:
    """It names the purpose, the package and the line to type, and is an ImportError too."""
    error = MissingExtraError("plotly", "report", "the report")
    assert isinstance(error, ImportError)
    assert one_line(error) == (
        "the report needs the package 'plotly', which is not installed: "
        "pip install 'asp-env[report]'"
    )


@pytest.mark.parametrize(
    ("group", "name"),
    [
        ("predictors", "constant-velocity"),
        ("planners", "expert"),
        ("sources", "synthetic"),
        ("commands", "inspect"),
    ],
)
def test_names(group: registry.Group, name: str) -> None:
    """Every group knows its plugs by name, in alphabetical order."""
    names = registry.names(group)
    assert name in names
    assert list(names) == sorted(names)


def test_find_gives_the_object() -> None:
    """`expert` is the class that the entry point names."""
    from asp_env.planning.planner import Expert

    assert registry.find("planners", "expert") is Expert


@pytest.mark.parametrize(
    ("group", "kind"),
    [
        ("predictors", "predictor"),
        ("planners", "planner"),
        ("sources", "source"),
        ("commands", "command"),
    ],
)
def test_wrong_name(group: registry.Group, kind: str) -> None:
    """A letter too many is answered with the right name and all others."""
    right = registry.names(group)[0]
    with pytest.raises(AspEnvError) as caught:
        registry.find(group, f"{right}x")
    line = one_line(caught.value)
    assert line.startswith(f"unknown {kind} '{right}x' (did you mean '{right}'?): known are ")
    assert all(name in line for name in registry.names(group))


def test_plug_whose_package_is_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    """A plug of a package that is not there is one line with what to install."""
    plug = EntryPoint(name="far", value="no_such_package.module:Far", group="asp_env.planners")
    monkeypatch.setattr(registry, "_plugs", lambda group: {"far": plug} if group else {})
    with pytest.raises(AspEnvError) as caught:
        registry.find("planners", "far")
    line = one_line(caught.value)
    assert line.startswith("planner 'far' needs the package 'no_such_package', which is not")
    assert "pip install" in line
