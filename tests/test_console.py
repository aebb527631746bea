"""Commands print names of folders, recordings and predictors as they are."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from rich.table import Table

from asp_env.cli import main
from asp_env.console import page_console, printable, similar
from tests.data.levelx_files import write_folder

NAME = "a[/b] [bold]c:car:$d^$&<e>"
"""Brackets that rich reads as tags, one of which closes nothing, the name of an emoji, a formula
that matplotlib cannot read, and HTML."""


def test_tables_and_lines_show_names_as_they_are() -> None:
    console = page_console(100)
    table = Table(NAME, title=NAME, caption=NAME)
    table.add_row(NAME)
    console.print(table)
    console.print(f"wrote {NAME}")
    assert console.export_text().count(NAME) == 5


def test_commands_take_such_folders(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A table of contents, an evaluation with its page, and an error."""
    data, out = tmp_path / NAME / "data", tmp_path / NAME / "out"
    data.parent.mkdir(parents=True)
    write_folder(data, recordings=1)
    assert main(["inspect", str(data)]) == 0
    lines = "".join(capsys.readouterr().out.split("\n"))
    assert f"Recordings of {data}" in lines
    command = ["evaluate", str(data), "--planner", "none", "--predictors", "constant-velocity"]
    assert main([*command, "--out", str(out)]) == 0
    lines = "".join(capsys.readouterr().out.split("\n"))
    assert f"wrote {out}/report.html" in lines
    assert main(["inspect", str(data / "none")]) == 2
    assert f"{data}/none does not exist" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("\x1b[31mred\x07", r"\x1b[31mred\x07"),
        ("a\x9b1m\u202eb", r"a\x9b1m\u202eb"),
        ("a\tb\nü 道 ₃ \\x1b", "a\tb\nü 道 ₃ \\x1b"),
    ],
)
def test_characters_that_control_terminals_are_shown_as_escapes(text: str, shown: str) -> None:
    assert printable(text) == shown


def test_files_do_not_control_the_terminal(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A weekday, the name of a folder, and the name of a missing one in an error."""
    data = tmp_path / "a\x1b[31m"
    write_folder(data, recordings=1)
    path = next(data.rglob("00_recordingMeta.csv"))
    path.write_text(path.read_text().replace("Mon", "\x1b[32mMon"))
    assert main(["inspect", str(data)]) == 0
    assert main(["inspect", str(data / "none")]) == 2
    printed = capsys.readouterr()
    assert "\x1b" not in printed.out + printed.err
    assert r"\x1b[32mMon" in printed.out
    assert r"\x1b[31m" in printed.out
    assert r"a\x1b[31m/none does not exist" in printed.err


def test_letters_that_an_encoding_lacks_have_similar_ones() -> None:
    text = "MAE₃ \u22120.03 1\u20132 m² … 道 ü"
    error = UnicodeEncodeError("ascii", text, 0, len(text), "")
    assert similar(error) == ("MAE3 -0.03 1-2 m2 ... ? u", len(text))


@pytest.mark.parametrize("encoding", ["ascii", "latin-1"])
def test_a_command_prints_in_encodings_without_some_letters(encoding: str, tmp_path: Path) -> None:
    """The tables of errors have subscripts."""
    write_folder(tmp_path / "data", recordings=1)
    command = [
        *(sys.executable, "-m", "asp_env.cli", "evaluate", str(tmp_path / "data")),
        *("--planner", "none", "--predictors", "constant-velocity", "--out", str(tmp_path / "out")),
    ]
    environment = {**os.environ, "PYTHONIOENCODING": encoding, "PYTHONUTF8": "0"}
    done = subprocess.run(command, capture_output=True, env=environment, check=False)
    assert (done.returncode, done.stderr) == (0, b"")
    assert b"MAE3" in done.stdout


def test_every_console_is_of_this_kind() -> None:
    """Others would read names as markup."""
    root = Path(__file__).parents[1]
    rooms = ("asp_env", "predictors", "policies", "scenarios")
    found = [
        path.relative_to(root).as_posix()
        for room in rooms
        for path in (root / room).rglob("*.py")
        if re.search(r"\bConsole\(|\bget_console\(", path.read_text())
    ]
    assert found == []
