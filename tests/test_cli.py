"""The command line: 0 when all is well, 2 and one line on stderr for bad input."""

import os
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import pytest

from asp_env import registry
from asp_env.cli import RENAMED_OPTIONS, main
from asp_env.errors import AspEnvError


@dataclass(frozen=True, slots=True, kw_only=True)
class Fail:
    """A command that fails in some way."""

    how: str
    """What is raised."""

    def run(self) -> None:
        """Raises it."""
        raise {
            "input": AspEnvError("first line\nsecond line"),
            "system": PermissionError(13, "Permission denied", "/a/file"),
            "interrupt": KeyboardInterrupt(),
            "bug": ZeroDivisionError(),
        }[self.how]


@pytest.fixture
def failing(monkeypatch: pytest.MonkeyPatch) -> None:
    """Every command is `Fail`."""
    monkeypatch.setattr(registry, "find", lambda *_: Fail)


def _refused(capsys: pytest.CaptureFixture[str], *args: str) -> str:
    """The one line that a command refuses its input with."""
    assert main(args) == 2
    told = capsys.readouterr()
    assert told.out == ""
    assert told.err.count("\n") == 1
    assert told.err.startswith("asp-env: ")
    return told.err.strip()


def test_an_unknown_command_is_refused(capsys):
    """The nearest one is suggested, all are listed."""
    line = _refused(capsys, "drvie")
    assert "unknown command 'drvie' (did you mean 'drive'?): known are " in line
    assert "evaluate" in line


@pytest.mark.parametrize(
    ("args", "what"),
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
def test_wrong_options_are_refused(capsys, args, what):
    """What is wrong, and where the options are told, without a box around it."""
    line = _refused(capsys, "drive", *args)
    assert what in line
    assert line.endswith("; see asp-env drive --help")
    assert not set("│─╭╰╮╯") & set(line)


@pytest.mark.parametrize("command", ["evaluate", "drive", "inspect"])
def test_data_that_is_not_there_is_refused(capsys, tmp_path, command):
    """The folder is named; nothing is written."""
    out = [] if command == "inspect" else ["--out", str(tmp_path / "out")]
    line = _refused(capsys, command, str(tmp_path / "nothing"), *out)
    assert f"{tmp_path / 'nothing'} does not exist" in line
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("command", ["evaluate", "drive"])
def test_an_unwritable_output_is_refused(capsys, tmp_path, command):
    """Before anything is computed: below a file, and where there is something already."""
    (tmp_path / "file").write_text("words")
    for out, what in (
        ("file/out", "cannot be written"),
        ("file", "exists and is not an empty folder"),
    ):
        line = _refused(capsys, command, str(tmp_path), "--out", str(tmp_path / out))
        assert what in line
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


@pytest.mark.parametrize(
    ("args", "what"),
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
def test_wrong_values_are_refused(capsys, tmp_path, args, what):
    """On shipped data, each in one line, and the output folder does not come into being."""
    line = _refused(capsys, "drive", "sample:intersection", "--out", str(tmp_path / "out"), *args)
    assert what in line
    assert list(tmp_path.iterdir()) == []


def test_help_lists_the_commands(capsys):
    """With `--help`, `-h` or nothing: every registered command, status 0, nothing on stderr."""
    for args in (["--help"], ["-h"], []):
        assert main(args) == 0
        told = capsys.readouterr()
        assert told.err == ""
        for name in registry.names("commands"):
            assert f" {name} " in told.out


def test_help_survives_a_command_that_cannot_be_loaded(capsys, monkeypatch):
    """A plug whose package is missing is listed with what it lacks."""

    def find(_group: str, name: str) -> type:
        if name == "train":
            raise AspEnvError("needs the package 'torch'")
        return Fail

    monkeypatch.setattr(registry, "find", find)
    assert main(["--help"]) == 0
    told = capsys.readouterr().out
    assert "needs the package 'torch'" in told
    assert "A command that fails in some way." in told


@pytest.mark.parametrize("command", registry.names("commands"))
def test_every_command_has_a_help(capsys, command):
    """Status 0, and a line for every option."""
    with pytest.raises(SystemExit) as stop:
        main([command, "--help"])
    assert not stop.value.code
    assert f"asp-env {command}" in capsys.readouterr().out


@pytest.mark.usefixtures("failing")
def test_errors_of_a_command_are_one_line(capsys):
    """Bad input and errors of the system; what has several lines becomes one."""
    assert _refused(capsys, "any", "--how", "input") == "asp-env: first line second line"
    assert _refused(capsys, "any", "--how", "system") == "asp-env: /a/file: Permission denied"


@pytest.mark.usefixtures("failing")
def test_an_interrupt_is_130(capsys):
    """As shells have it, with one line."""
    assert main(["any", "--how", "interrupt"]) == 130
    assert capsys.readouterr().err == "asp-env: interrupted\n"


@pytest.mark.usefixtures("failing")
def test_our_own_faults_are_not_hidden():
    """Anything else is a bug and keeps its traceback."""
    with pytest.raises(ZeroDivisionError):
        main(["any", "--how", "bug"])


def test_the_installed_command_exits_with_the_status():
    """Run as a process: 2, one line on stderr, nothing on stdout."""
    script = Path(sys.executable).with_name("asp-env")
    command = [str(script)] if script.exists() else [sys.executable, "-m", "asp_env.cli"]
    done = subprocess.run(
        [*command, "drive", "nowhere", "--out", os.devnull], capture_output=True, text=True
    )
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr == (
        "asp-env: /dev/null exists and is not an empty folder; choose another name or remove it\n"
    )


@pytest.mark.parametrize(("command", "old"), RENAMED_OPTIONS)
def test_deprecated_options_warn_and_work(
    command: str, old: str, capsys: pytest.CaptureFixture[str]
) -> None:
    """An old name is taken like the new one, as two words or with an equals sign."""
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
