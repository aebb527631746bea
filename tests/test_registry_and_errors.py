"""Registered plugs, and error messages."""

import sys
from importlib.metadata import EntryPoint
from pathlib import Path

import pytest

from asp_env import registry
from asp_env.errors import (
    AspEnvError,
    CheckpointError,
    DataError,
    MissingExtraError,
    StaleInstallError,
    unknown_name,
)


def one_line(error: BaseException) -> str:
    """The message, which must be one line."""
    (line,) = str(error).splitlines()
    return line


def test_unknown_name_lists_known_names_and_suggests_one() -> None:
    assert one_line(unknown_name("fruit", "aple", ["pear", "apple"])) == (
        "unknown fruit 'aple' (did you mean 'apple'?): known are apple, pear"
    )
    assert one_line(unknown_name("fruit", "xyz", ["pear", "apple"])) == (
        "unknown fruit 'xyz': known are apple, pear"
    )


@pytest.mark.parametrize("kind", [AspEnvError, DataError, CheckpointError, MissingExtraError])
def test_all_errors_are_value_errors(kind: type[Exception]) -> None:
    assert issubclass(kind, AspEnvError)
    assert issubclass(kind, ValueError)


def test_missing_extra_names_purpose_package_and_command() -> None:
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
def test_names_are_sorted(group: registry.Group, name: str) -> None:
    names = registry.names(group)
    assert name in names
    assert list(names) == sorted(names)


def test_find_returns_the_object_of_the_entry_point() -> None:
    from asp_env.planning.planner import Expert

    assert registry.find("planners", "expert") is Expert


@pytest.mark.parametrize(
    ("group", "kind"),
    [
        ("predictors", "predictor"),
        ("planners", "planner"),
        ("sources", "source"),
        ("views", "view"),
        ("commands", "command"),
    ],
)
def test_misspelled_name(group: registry.Group, kind: str) -> None:
    correct = registry.names(group)[0]
    with pytest.raises(AspEnvError) as caught:
        registry.find(group, f"{correct}x")
    line = one_line(caught.value)
    assert line.startswith(f"unknown {kind} '{correct}x' (did you mean '{correct}'?): known are ")
    assert all(name in line for name in registry.names(group))


def register(monkeypatch: pytest.MonkeyPatch, value: str) -> None:
    """Registers the planner `far` alone."""
    plug = EntryPoint(name="far", value=value, group="asp_env.planners")
    monkeypatch.setattr(registry, "_plugs", lambda group: {"far": plug} if group else {})


def test_plug_that_needs_a_missing_package(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    (tmp_path / "far_planner.py").write_text("import no_such_package.module\n")
    monkeypatch.syspath_prepend(tmp_path)
    register(monkeypatch, "far_planner:Far")
    with pytest.raises(AspEnvError) as caught:
        registry.find("planners", "far")
    line = one_line(caught.value)
    assert line.startswith("planner 'far' needs the package 'no_such_package', which is not")
    assert line.endswith("pip install no-such-package")


@pytest.mark.parametrize(
    ("module", "extra"),
    [
        ("highway_env", "highway"),
        ("torch", "inference"),
        ("lightning", "train"),
        ("sumolib", "synthetic"),
    ],
)
def test_missing_package_names_the_smallest_extra(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, module: str, extra: str
) -> None:
    """Not `all`, which has every package."""
    (tmp_path / "far_planner.py").write_text(f"import {module}\n")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setitem(sys.modules, module, None)
    monkeypatch.delitem(sys.modules, "far_planner", raising=False)
    register(monkeypatch, "far_planner:Far")
    with pytest.raises(AspEnvError) as caught:
        registry.find("planners", "far")
    assert one_line(caught.value).endswith(f"pip install 'asp-env[{extra}]'")


@pytest.mark.parametrize(
    ("code", "reason"),
    [
        (None, "ModuleNotFoundError: No module named 'broken_planner'"),
        ("", "AttributeError: module 'broken_planner' has no attribute 'Far'"),
        ("Far = 1 / 0", "ZeroDivisionError: division by zero"),
        ("raise ValueError('one\\ntwo')", "ValueError: one two"),
        ("Far = (", "SyntaxError: '(' was never closed"),
    ],
)
def test_plug_that_cannot_be_imported(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, code: str | None, reason: str
) -> None:
    """One line names the plug, its entry point and the reason."""
    if code is not None:
        (tmp_path / "broken_planner.py").write_text(code)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "broken_planner", raising=False)
    register(monkeypatch, "broken_planner:Far")
    with pytest.raises(AspEnvError) as caught:
        registry.find("planners", "far")
    line = one_line(caught.value)
    assert line.startswith(
        "planner 'far' cannot be imported from its entry point broken_planner:Far"
    )
    assert reason in line


def test_metadata_without_a_name_of_this_version_are_stale(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """As after an update of a checkout that is not installed again; the remedy is a command."""
    plugs = {name: point for name, point in registry._plugs("readers").items() if name != "sind"}
    monkeypatch.setattr(registry, "_plugs", lambda _: plugs)
    with pytest.raises(StaleInstallError, match=r"reader 'sind' .* run python -m pip install -e"):
        registry.find("readers", "sind")
    with pytest.raises(AspEnvError, match=r"unknown reader 'sinf': known are"):
        registry.find("readers", "sinf")
