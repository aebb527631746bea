"""`asp-env drive` on scenarios chosen by a filter or from a file, and its rows by tag."""

import csv
from pathlib import Path
from typing import Any

import pytest

from asp_env.cli import main
from asp_env.data.scenarios.tags import TAGS
from asp_env.evaluation.closed_loop.drive import ClosedLoopResult, Drive, drive

NOWHERE = Path("not-written")


def drive_expert(crossings: Path, **options: Any) -> ClosedLoopResult:
    return drive(Drive(data=str(crossings), out=NOWHERE, planner="expert", **options))


def test_a_filter_chooses_scenarios(crossings: Path) -> None:
    """The chosen scenarios have the same seeds as among all; then their number can be limited."""
    every, left = drive_expert(crossings), drive_expert(crossings, scenarios="left")
    expected = [each for each in every.scenarios if "left" in each.tags]
    assert 0 < len(expected) < len(every.scenarios)
    assert [*left.scenarios] == expected
    assert list(left.manifest["scenarios"]) == [each.name for each in expected]
    assert left.manifest["asked for"] == {"scenarios": "left", "max_scenarios": None}
    assert [*drive_expert(crossings, scenarios="left", max_scenarios=1).scenarios] == expected[:1]


def test_rows_by_tag_are_means_over_its_scenarios(crossings: Path) -> None:
    every = drive_expert(crossings)
    counts = {tag: count for tag, count in every.scenarios.counts().items() if count}
    scores = {row.subset: row for row in every.rows if row.metric == "score"}
    assert list(scores) == ["all", *counts]
    assert {tag: row.n for tag, row in scores.items()} == {"all": len(every.scenarios), **counts}
    for tag in counts:
        alone = drive_expert(crossings, scenarios=tag)
        (row,) = (row for row in alone.rows if row.metric == "score" and row.subset == "all")
        assert row.value == scores[tag].value
        assert (row.low, row.high) == (scores[tag].low, scores[tag].high)


def test_a_run_repeats_from_its_scenarios_file(crossings: Path, tmp_path: Path) -> None:
    first, second = tmp_path / "first", tmp_path / "second"
    args = ["drive", str(crossings), "--planner", "idm", "--out"]
    assert (
        main([*args, str(first), "--scenarios", "straight,density>=1", "--max-scenarios", "3"]) == 0
    )
    assert main([*args, str(second), "--scenarios", str(first / "scenarios.json")]) == 0
    assert (first / "scenarios.json").read_bytes() == (second / "scenarios.json").read_bytes()
    assert (first / "metrics.csv").read_bytes() == (second / "metrics.csv").read_bytes()
    with (first / "metrics.csv").open(newline="") as file:
        subsets = {row["subset"] for row in csv.DictReader(file)}
    assert {"all", "straight"} <= subsets <= {"all", *TAGS}


@pytest.mark.parametrize(
    ("scenarios", "message"),
    [
        ("lft", "unknown scenario tag 'lft'"),
        ("speed>3", "unknown scenario column 'speed'"),
        ("left,right", "none of the"),
        ("nothing.json", "nothing.json: cannot be read"),
    ],
)
def test_wrong_scenarios_are_errors_of_one_line(
    crossings: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    scenarios: str,
    message: str,
) -> None:
    out = tmp_path / "out"
    assert main(["drive", str(crossings), "--out", str(out), "--scenarios", scenarios]) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1
    assert not list(tmp_path.iterdir())
