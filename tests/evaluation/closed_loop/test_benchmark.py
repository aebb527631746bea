"""`asp-env benchmark`: rows of methods on frozen scenarios."""

import csv
import hashlib
from dataclasses import replace
from pathlib import Path

import pytest

from asp_env import registry
from asp_env.errors import AspEnvError
from asp_env.evaluation.closed_loop.benchmark import (
    Benchmark,
    benchmark,
    benchmark_table,
    parse_method,
)
from asp_env.evaluation.closed_loop.drive import Drive, drive

DATA = "sample:roundabout"
FILTER = "interactive"


def config(out: Path, *methods: str, **options: object) -> Benchmark:
    """Four interactive scenarios of the sample, without the ladder."""
    plain = Benchmark(
        methods=methods, out=out, data=DATA, scenarios=FILTER, controls=False, max_scenarios=4
    )
    return replace(plain, **options)  # pyright: ignore


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("constant-velocity", ("contingency", "constant-velocity")),
        ("sampling+oracle", ("sampling", "oracle")),
        ("sampling+ffw-asp:runs/a+b", ("sampling", "ffw-asp:runs/a+b")),
        ("ffw-asp:runs/a+b", ("contingency", "ffw-asp:runs/a+b")),
        ("idm", ("idm", "")),
    ],
)
def test_a_method_is_a_planner_and_a_predictor(name: str, expected: tuple[str, str]) -> None:
    """The first plus sign after a planner's name separates the two."""
    assert parse_method(name) == expected


def test_rows_are_those_of_drive(tmp_path: Path) -> None:
    """Score and difference of a method are those that `drive` states."""
    rows, _ = benchmark(config(tmp_path / "x", "sampling+constant-turn-rate", "idm"))
    result = drive(
        Drive(
            data=DATA, out=tmp_path / "y", planner="sampling", scenarios=FILTER, max_scenarios=4,
            predictors=("constant-velocity", "constant-turn-rate"),
        )
    )  # fmt: skip
    by = {
        row.metric: row
        for row in result.rows
        if row.subset == "all" and row.predictor == "constant-turn-rate"
    }
    assert [row.method for row in rows] == ["sampling+constant-turn-rate", "idm"]
    first, second = rows
    assert first.score is not None
    assert first.difference is not None
    assert first.score.value == by["score"].value
    assert first.difference.value == by["score - constant-velocity"].value
    assert (first.n, first.places, second.predictor, second.difference) == (4, 1, "", None)
    assert second.score is not None


def test_the_ladder_gives_oracle_shares(tmp_path: Path) -> None:
    """With controls, the rows of a predictor have an oracle share, those of the ladder none."""
    (row, rung), results = benchmark(
        config(tmp_path / "x", "sampling+constant-turn-rate", "sampling+oracle", controls=True)
    )
    assert row.oracle_share is not None
    assert 0.0 <= row.oracle_share.value <= 1.0
    assert rung.oracle_share is None
    assert {row.predictor for row in results[0].rows} >= {"blind", "blend:0.5", "constant-velocity"}


def test_the_files_and_the_hash(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The list of scenarios that a run writes gives the same rows and the same hash again."""
    methods = ("sampling+constant-velocity", "idm")
    config(tmp_path / "a", *methods).run()
    assert "4 scenarios of 1 locations, hash" in " ".join(capsys.readouterr().out.split())
    listed = tmp_path / "a" / "scenarios.json"
    config(tmp_path / "b", *methods, scenarios=str(listed), max_scenarios=None).run()
    tables = []
    for name in ("a", "b"):
        with (tmp_path / name / "benchmark.csv").open(newline="") as file:
            tables.append(list(csv.DictReader(file)))
    assert tables[0] == tables[1]
    assert [row["method"] for row in tables[0]] == list(methods)
    expected = hashlib.sha256(listed.read_bytes()).hexdigest()
    assert {row["scenarios_hash"] for row in tables[0]} == {expected}
    with (tmp_path / "a" / "metrics.csv").open(newline="") as file:
        scores = [
            row["planner"]
            for row in csv.DictReader(file)
            if (row["metric"], row["subset"]) == ("score", "all")
        ]
    assert sorted(scores) == ["expert", "idm", "sampling", "sampling"]  # also with the oracle
    assert (tmp_path / "a" / "report.html").is_file()


def test_the_table_marks_what_is_privileged_and_not_resolved(tmp_path: Path) -> None:
    """The oracle has a star; four scenarios of one recording resolve no difference."""
    rows, results = benchmark(config(tmp_path / "x", "sampling+oracle"))
    table = benchmark_table(rows, results[0].manifest["privileged"])
    assert table.caption == "* uses the recorded future; ~ not resolved"


def test_bad_options_are_refused(tmp_path: Path) -> None:
    """One line states what was given and what was expected."""
    with pytest.raises(AspEnvError, match=r"sample:roundabout has no frozen scenarios"):
        config(tmp_path, "constant-velocity", scenarios="").run()
    with pytest.raises(AspEnvError, match="give one of them"):
        config(tmp_path, "constant-velocity", suite="roundabout-v1").run()
    with pytest.raises(AspEnvError, match=r"expected the method sampling\+PREDICTOR"):
        config(tmp_path, "sampling").run()
    with pytest.raises(AspEnvError, match="expected the method idm alone"):
        config(tmp_path, "idm+oracle").run()
    with pytest.raises(AspEnvError, match="no METHOD"):
        config(tmp_path).run()
    with pytest.raises(AspEnvError, match="unknown predictor 'mpt'"):
        config(tmp_path, "sampling+mpt").run()
    with pytest.raises(AspEnvError, match="unknown planner 'smapling'"):
        config(tmp_path, "smapling+oracle").run()
    with pytest.raises(AspEnvError, match="nowhere does not exist; expected a folder"):
        config(tmp_path, "idm", data=str(tmp_path / "nowhere"), scenarios="").run()
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"jobs": 0}, "--jobs 0"),
        ({"max_scenarios": 0}, "--max-scenarios 0"),
        ({"rules": "hard"}, "unknown rules 'hard'"),
        ({"suite": ""}, "unknown suite ''"),
        ({"data": ""}, "data '': expected a folder"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, dict) else None,
)
def test_bad_options_are_refused_before_a_suite_is_made(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, options: dict[str, object], message: str
) -> None:
    """The traffic of a suite takes minutes, and an empty name is not the default."""
    monkeypatch.setenv("ASP_ENV_CACHE", str(tmp_path / "cache"))
    with pytest.raises(AspEnvError, match=message):
        config(tmp_path / "out", "idm", **{"data": None, "scenarios": "", **options}).run()
    assert not (tmp_path / "cache").exists()
    assert not (tmp_path / "out").exists()


def test_the_command_is_registered() -> None:
    """`asp-env benchmark` is this command."""
    assert registry.find("commands", "benchmark") is Benchmark
