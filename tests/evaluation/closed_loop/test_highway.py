"""`drive` and `evaluate` in highway-env's traffic, from end to end."""

import csv
import json
from pathlib import Path

import pytest

from asp_env.cli import main
from asp_env.data.rollout import Rollout
from tests.highway_folders import highway_data

PREDICTORS = ("constant-velocity", "constant-turn-rate")


def _rows(folder: Path) -> list[dict[str, str]]:
    with (folder / "metrics.csv").open(newline="") as file:
        return list(csv.DictReader(file))


def test_drives_from_end_to_end(tmp_path):
    """The expert is first, keeps to its log and ends at its goal; everybody meets `own` traffic."""
    out, data = tmp_path / "out", highway_data("intersection")
    given = ["drive", data, "--out", str(out), "--max-scenarios", "2", "--scenarios", "length<=9"]
    assert main([*given, "--predictors", *PREDICTORS]) == 0
    told = json.loads((out / "manifest.json").read_text())
    assert list(told["endings"]) == ["expert", *(f"sampling + {each}" for each in PREDICTORS)]
    assert told["endings"]["expert"] == {"GOAL": 2}
    rows = _rows(out)
    assert rows[0]["planner"] == "expert"
    assert {row["traffic"] for row in rows} == {"own"}
    assert {row["predictor"] for row in rows} == {"", *PREDICTORS}
    expert = {
        row["metric"]: float(row["value"])
        for row in rows
        if (row["planner"], row["subset"]) == ("expert", "all")
    }
    assert expert["log divergence"] == pytest.approx(0.0, abs=1e-4)
    assert expert["progress"] == pytest.approx(1.0, abs=1e-3)
    for driver in told["endings"]:
        rollouts = [Rollout.load(path) for path in (out / "rollouts" / driver).iterdir()]
        assert len(rollouts) == 2
    assert (out / "report.html").stat().st_size > 10_000


def test_evaluates_from_end_to_end(tmp_path):
    """Constant velocity is the measure of the other; an oracle errs by nothing."""
    out = tmp_path / "out"
    given = ["evaluate", highway_data("roundabout"), "--out", str(out)]
    assert main([*given, "--predictors", *PREDICTORS, "oracle"]) == 0
    found = {
        (row["predictor"], row["metric"]): float(row["value"])
        for row in _rows(out)
        if (row["subset"], row["selection"]) == ("moving", "most-probable")
    }
    assert found["oracle", "FDE"] == pytest.approx(0.0, abs=1e-4)
    assert found["constant-velocity", "FDE"] > found["constant-turn-rate", "ADE"] > 1.0


def test_a_damaged_folder_is_told_in_one_line(tmp_path, capsys):
    """Unknown DATA, and drivers that need a replay: status 2."""
    for options, what in (
        (["highway:nowhere"], "unknown highway site or folder 'nowhere'"),
        ([highway_data("roundabout"), "--traffic", "log"], "this world replays no tracks"),
        ([highway_data("roundabout"), "--dt", "0.3333333333"], "multiple of that"),
    ):
        out = tmp_path / "out"
        assert main(["drive", *options, "--out", str(out), "--horizon", "1"]) == 2
        told = capsys.readouterr().err
        assert what in told
        assert told.count("\n") == 1
        assert not out.exists()
