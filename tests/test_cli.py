"""The command line: exit status 0 on success, 2 and one line on stderr for bad input."""

import io
import os
import subprocess
import sys
from dataclasses import dataclass
from importlib.metadata import EntryPoint
from pathlib import Path

import pytest

from asp_env import registry
from asp_env.cli import RENAMED_OPTIONS, main
from asp_env.errors import AspEnvError


@dataclass(frozen=True, slots=True, kw_only=True)
class Fail:
    """A command that fails."""

    how: str
    """The kind of failure."""

    def run(self) -> None:
        """Raises the failure."""
        raise {
            "input": AspEnvError("first line\nsecond line"),
            "system": PermissionError(13, "Permission denied", "/a/file"),
            "interrupt": KeyboardInterrupt(),
            "bug": ZeroDivisionError(),
        }[self.how]


@pytest.fixture
def failing(monkeypatch: pytest.MonkeyPatch) -> None:
    """Makes every command `Fail`."""
    monkeypatch.setattr(registry, "find", lambda *_: Fail)


def _rejected(capsys: pytest.CaptureFixture[str], *args: str) -> str:
    """Runs a command with bad input and returns its one line on stderr."""
    assert main(args) == 2
    output = capsys.readouterr()
    assert output.out == ""
    assert output.err.count("\n") == 1
    assert output.err.startswith("asp-env: ")
    return output.err.strip()


def test_an_unknown_command_is_rejected(capsys):
    """The message suggests the nearest command and lists all."""
    line = _rejected(capsys, "drvie")
    assert "unknown command 'drvie' (did you mean 'drive'?): known are " in line
    assert "evaluate" in line


@pytest.mark.parametrize(
    ("args", "message"),
    [
        (["x", "--out", "o", "--plannr", "idm"], "Unrecognized options: --plannr"),
        (["x", "y", "--out", "o"], "Unrecognized options: y"),
        (["x"], "--out PATH"),
        ([], "Missing from asp-env drive"),
        (["x", "--out", "o", "--horizon", "long"], "could not convert string to float: 'long'"),
        (["x", "--out", "o", "--max-scenarios", "1.5"], "--max-scenarios"),
        (["x", "--out", "o", "--part", "some"], "'some'"),
    ],
    ids=["unknown", "too many", "missing option", "nothing", "no number", "no integer", "no part"],
)
def test_invalid_options_are_rejected(capsys, args, message):
    """The message is tyro's, without its box."""
    line = _rejected(capsys, "drive", *args)
    assert message in line
    assert line.endswith("; see asp-env drive --help")
    assert not set("│─╭╰╮╯") & set(line)


@pytest.mark.parametrize(
    ("args", "line"),
    [
        (["--episodes", "nan"], "Error parsing --episodes: invalid literal for int()"),
        (["--envs"], "Missing value for argument '--envs'. Expected 1 values; see"),
    ],
    ids=["no number", "no value"],
)
def test_messages_do_not_depend_on_the_encoding(capsys, monkeypatch, args, line):
    """Without UTF-8, tyro draws its box with dashes."""
    lines = [_rejected(capsys, "bench", *args)]
    with monkeypatch.context() as patch:
        patch.setattr(sys, "stdout", io.TextIOWrapper(io.BytesIO(), encoding="latin-1"))
        lines.append(_rejected(capsys, "bench", *args))
    assert lines[0] == lines[1]
    assert lines[0].startswith(f"asp-env: {line}")
    assert lines[0].count("--help") == 1


def test_of_an_optional_value_the_message_states_the_problem_alone(capsys):
    """Tyro's own says that it is not None, either."""
    line = _rejected(capsys, "drive", "x", "--out", "o", "--max-scenarios", "few")
    assert line == (
        "asp-env: Error parsing --max-scenarios: invalid literal for int() with base 10: 'few'; "
        "see asp-env drive --help"
    )


@pytest.mark.parametrize(
    "args",
    [
        ["drive", "sample:intersection", "--out", ""],
        ["compare", "a", "b", "--out", ""],
        ["watch", ""],
    ],
    ids=["required", "optional", "positional"],
)
def test_an_empty_path_is_rejected(capsys, tmp_path, monkeypatch, args):
    """Of a variable that is not set; it is not the current folder."""
    monkeypatch.chdir(tmp_path)
    assert "the value is empty, expected a path" in _rejected(capsys, *args)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("command", ["evaluate", "drive", "inspect"])
def test_missing_data_are_rejected(capsys, tmp_path, command):
    """Nothing is written."""
    out = [] if command == "inspect" else ["--out", str(tmp_path / "out")]
    line = _rejected(capsys, command, str(tmp_path / "nothing"), *out)
    assert f"{tmp_path / 'nothing'} does not exist" in line
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("command", ["evaluate", "drive"])
def test_an_unwritable_output_is_rejected(capsys, tmp_path, command):
    """Below a file, and where a file exists, before anything is computed."""
    (tmp_path / "file").write_text("text")
    for out, message in (
        ("file/out", "cannot be written"),
        ("file", "exists and is not an empty folder"),
    ):
        line = _rejected(capsys, command, str(tmp_path), "--out", str(tmp_path / out))
        assert message in line
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


@pytest.mark.parametrize(
    ("args", "message"),
    [
        (["--predictors", "constant-velocty"], "unknown predictor 'constant-velocty'"),
        (["--predictors"], "none given"),
        (["--planner", "sampler"], "unknown planner 'sampler'"),
        (["--traffic", "idn"], "unknown driver 'idn'"),
        (["--dt", "0.13"], "0.13 s"),
        (["--dt", "0"], "expected a positive number"),
        (["--dt", "nan"], "expected a positive number"),
        (["--horizon", "inf"], "expected a positive number"),
        (["--horizon", "-1"], "expected a positive number"),
        (["--max-scenarios", "0"], "expected at least 1"),
    ],
    ids=lambda value: "-".join(value) if isinstance(value, list) else None,
)
def test_invalid_values_are_rejected(capsys, tmp_path, args, message):
    """The output folder is not made."""
    line = _rejected(capsys, "drive", "sample:intersection", "--out", str(tmp_path / "out"), *args)
    assert message in line
    assert list(tmp_path.iterdir()) == []


def test_help_lists_the_commands(capsys):
    """With `--help`, `-h` and no argument."""
    for args in (["--help"], ["-h"], []):
        assert main(args) == 0
        output = capsys.readouterr()
        assert output.err == ""
        for name in registry.names("commands"):
            assert f" {name} " in output.out


@pytest.fixture
def group(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two commands of the group `pet` and one without a group."""
    plugs = {
        name: EntryPoint(name, f"{__name__}:Fail", "asp_env.commands")
        for name in ("pet feed", "pet wash", "petrol")
    }
    monkeypatch.setattr(registry, "_plugs", lambda _: plugs)


@pytest.mark.usefixtures("group")
def test_help_of_a_group_lists_its_commands(capsys):
    """With `--help`, `-h` and no argument."""
    for args in (["pet"], ["pet", "--help"], ["pet", "-h"]):
        assert main(args) == 0
        output = capsys.readouterr()
        assert output.err == ""
        assert "usage: asp-env pet COMMAND" in output.out
        assert output.out.count("A command that fails.") == 2
        assert " pet feed " in output.out


@pytest.mark.usefixtures("group")
def test_commands_of_a_group_run_by_two_words(capsys):
    assert _rejected(capsys, "pet", "feed", "--how", "input") == "asp-env: first line second line"
    line = _rejected(capsys, "pet", "feed")
    assert line.endswith("see asp-env pet feed --help")
    line = _rejected(capsys, "pet", "fed")
    assert "unknown command 'pet fed' (did you mean 'pet feed'?): known are pet feed, pet" in line
    assert "unknown command 'pe'" in _rejected(capsys, "pe", "feed")


def test_help_lists_commands_that_cannot_be_loaded(capsys, monkeypatch):
    """With the missing package."""

    def find(_group: str, name: str) -> type:
        if name == "train":
            raise AspEnvError("needs the package 'torch'")
        return Fail

    monkeypatch.setattr(registry, "find", find)
    assert main(["--help"]) == 0
    output = capsys.readouterr().out
    assert "needs the package 'torch'" in output
    assert "A command that fails." in output


@pytest.mark.parametrize("command", registry.names("commands"))
def test_every_command_has_help(capsys, command):
    with pytest.raises(SystemExit) as stop:
        main([*command.split(), "--help"])
    assert not stop.value.code
    assert f"asp-env {command}" in capsys.readouterr().out


@pytest.mark.usefixtures("failing")
def test_errors_of_a_command_are_one_line(capsys):
    """Bad input and system errors; messages of several lines are joined."""
    assert _rejected(capsys, "any", "--how", "input") == "asp-env: first line second line"
    assert _rejected(capsys, "any", "--how", "system") == "asp-env: /a/file: Permission denied"


@pytest.mark.usefixtures("failing")
def test_an_interrupt_exits_with_130(capsys):
    """As in shells."""
    assert main(["any", "--how", "interrupt"]) == 130
    assert capsys.readouterr().err == "asp-env: interrupted\n"


@pytest.mark.usefixtures("failing")
def test_other_exceptions_keep_their_traceback():
    with pytest.raises(ZeroDivisionError):
        main(["any", "--how", "bug"])


def test_the_installed_command_exits_with_the_status():
    script = Path(sys.executable).with_name("asp-env")
    command = [str(script)] if script.exists() else [sys.executable, "-m", "asp_env.cli"]
    done = subprocess.run(
        [*command, "drive", "nowhere", "--out", os.devnull], capture_output=True, text=True
    )
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr == (
        "asp-env: /dev/null exists and is not an empty folder; choose another name or remove it\n"
    )


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        ({}, {"GOMP_SPINCOUNT": "10000"}),
        ({"GOMP_SPINCOUNT": "5"}, {"GOMP_SPINCOUNT": "5"}),
        ({"OMP_WAIT_POLICY": "ACTIVE"}, {"OMP_WAIT_POLICY": "ACTIVE"}),
    ],
)
def test_threads_do_not_wait_busily(monkeypatch, capsys, given, expected):
    """Unless the environment of the command says otherwise."""
    environment = dict(given)
    monkeypatch.setattr(os, "environ", environment)
    monkeypatch.setattr(sys, "argv", ["asp-env", "--version"])
    assert main() == 0
    assert environment == expected
    assert capsys.readouterr().out.startswith("asp-env ")


@pytest.mark.parametrize(("command", "old"), RENAMED_OPTIONS)
def test_deprecated_options_warn_and_work(
    command: str, old: str, capsys: pytest.CaptureFixture[str]
) -> None:
    """As two words and with an equals sign."""
    new = RENAMED_OPTIONS[command, old]
    fields = {
        "--" + name.replace("_", "-") for name in registry.find("commands", command).__annotations__
    }
    assert new in fields
    assert old not in fields
    assert main([command, old, "no-such-value", f"{old}=another"]) == 2
    lines = capsys.readouterr().err.splitlines()
    assert lines[:2] == [f"asp-env: {old} is deprecated; use {new}"] * 2
    assert "Unrecognized" not in lines[-1]


def test_equal_warnings_are_printed_once() -> None:
    """In one line each; a process of its own, since pytest records warnings."""
    code = (
        "import warnings\n"
        "from asp_env.cli import _one_line_warnings\n"
        "with _one_line_warnings(strict=False):\n"
        "    for text in ('a\\nb', 'c', 'a\\nb'):\n"
        "        with warnings.catch_warnings():\n"
        "            warnings.simplefilter('always')\n"
        "            warnings.warn(text)\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stderr == "asp-env: warning: a b\nasp-env: warning: c\n"
