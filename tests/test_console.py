"""Commands print names of folders, recordings and predictors as they are."""

import re
from pathlib import Path

import pytest
from rich.table import Table

from asp_env.cli import main
from asp_env.console import page_console
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


def test_every_console_is_of_this_kind() -> None:
    """Others would read names as markup."""
    root = Path(__file__).parents[1]
    rooms = ("asp_env", "predictors", "policies", "scenarios")
    found = [
        path.relative_to(root).as_posix()
        for room in rooms
        for path in (root / room).rglob("*.py")
        if re.search(r"(?<!: )\bConsole[,(]|\bget_console\(", path.read_text())
    ]
    assert found == ["asp_env/console.py"]
