"""`asp-env drive` on chosen scenarios: by words, from a file, and what is said of each tag."""

import csv
from pathlib import Path
from typing import Any

import pytest

from asp_env.cli import main
from asp_env.data.scenarios.tags import TAGS
from asp_env.evaluation.closed_loop.drive import ClosedLoop, Drive, drive

NOWHERE = Path("not-written")


def driven(crossings: Path, **options: Any) -> ClosedLoop:
    """The expert's drives alone, which need no planning."""
    return drive(Drive(data=str(crossings), out=NOWHERE, planner="expert", **options))


def test_words_choose(crossings: Path) -> None:
    """All that fit are driven, with the seeds that they have among all; then at most so many."""
    every, left = driven(crossings), driven(crossings, scenarios="left")
    wanted = [each for each in every.scenarios if "left" in each.tags]
    assert 0 < len(wanted) < len(every.scenarios)
    assert [*left.scenarios] == wanted
    assert list(left.manifest["scenarios"]) == [each.name for each in wanted]
    assert left.manifest["asked for"] == {"scenarios": "left", "max_scenarios": None}
    assert [*driven(crossings, scenarios="left", max_scenarios=1).scenarios] == wanted[:1]


def test_rows_by_tag(crossings: Path) -> None:
    """One of each metric for all and for every tag that occurs: the mean over its scenarios."""
    every = driven(crossings)
    counts = {tag: count for tag, count in every.scenarios.counts().items() if count}
    scores = {row.subset: row for row in every.rows if row.metric == "score"}
    assert list(scores) == ["all", *counts]
    assert {tag: row.n for tag, row in scores.items()} == {"all": len(every.scenarios), **counts}
    for tag in counts:
        alone = driven(crossings, scenarios=tag)
        (row,) = (row for row in alone.rows if row.metric == "score" and row.subset == "all")
        assert row.value == scores[tag].value
        assert (row.low, row.high) == (scores[tag].low, scores[tag].high)


def test_a_run_can_be_driven_again(crossings: Path, tmp_path: Path) -> None:
    """By the file in its folder: the same rows for the same scenarios."""
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
    ("words", "what"),
    [
        ("lft", "unknown scenario tag 'lft'"),
        ("speed>3", "unknown scenario column 'speed'"),
        ("left,right", "none of the"),
        ("nothing.json", "nothing.json: cannot be read"),
    ],
)
def test_refused(
    crossings: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], words: str, what: str
) -> None:
    """Status 2, one line, and no folder."""
    out = tmp_path / "out"
    assert main(["drive", str(crossings), "--out", str(out), "--scenarios", words]) == 2
    told = capsys.readouterr().err
    assert what in told
    assert told.count("\n") == 1
    assert not list(tmp_path.iterdir())
