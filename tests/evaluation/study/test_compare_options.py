"""Options of `asp-env compare`, on tables that are written by hand."""

import csv
from pathlib import Path

import pytest

from asp_env.cli import main
from asp_env.evaluation.closed_loop.scenario_table import COLUMNS


def folder(path: Path, *scores: float) -> Path:
    """Results of one method in replayed traffic, without latency: a scenario for each score."""
    path.mkdir()
    with (path / "scenarios.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, [*COLUMNS, "score"])
        writer.writeheader()
        for number, score in enumerate(scores):
            cells = dict.fromkeys(COLUMNS, "") | {"data": "d", "traffic": "log", "planner": "idm"}
            cells |= {"latency_ticks": "0", "scenario": f"s{number}", "recording": f"r{number}"}
            writer.writerow(cells | {"score": score})
    return path


def rejected(capsys: pytest.CaptureFixture[str], *args: object) -> str:
    """The one line on stderr, with nothing on stdout."""
    assert main(["compare", *map(str, args)]) == 2
    printed = capsys.readouterr()
    assert (printed.err.count("\n"), printed.out) == (1, "")
    return printed.err


def test_an_existing_file_is_not_overwritten(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Nor is the comparison printed before a file is refused."""
    a, b = folder(tmp_path / "a", 0.5, 1.0), folder(tmp_path / "b", 1.0, 1.0)
    (tmp_path / "notes.csv").write_text("mine")
    for name, message in (
        ("notes.csv", "exists; choose another name or remove it"),
        ("a", "exists; choose another name or remove it"),
        ("notes.csv/out.csv", "cannot be written"),
    ):
        assert message in rejected(capsys, a, b, "--out", tmp_path / name)
    assert (tmp_path / "notes.csv").read_text() == "mine"
    assert main(["compare", str(a), str(b), "--out", str(tmp_path / "new.csv")]) == 0
    assert "d,log,0,s0,0.5,1" in (tmp_path / "new.csv").read_text()


def test_conditions_that_no_result_has_are_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    a, b = folder(tmp_path / "a", 0.5), folder(tmp_path / "b", 1.0)
    assert f"--traffic idn: {a} has log" in rejected(capsys, a, b, "--traffic", "idn")
    assert f"--latency-ticks 2: {a} has 0" in rejected(capsys, a, b, "--latency-ticks", "2")
    assert main(["compare", str(a), str(b), "--traffic", "log", "--latency-ticks", "0"]) == 0


def test_what_is_no_folder_of_results(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    a = folder(tmp_path / "a", 0.5)
    line = rejected(capsys, tmp_path / "none", a)
    assert "scenarios.csv: cannot be read (No such file or directory); expected a folder" in line


def test_equal_results_have_no_scenario_that_decides(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    a, b = folder(tmp_path / "a", 0.5, 1.0), folder(tmp_path / "b", 0.5, 1.0)
    assert main(["compare", str(a), str(b)]) == 0
    assert "no scenario differs in score" in capsys.readouterr().out
