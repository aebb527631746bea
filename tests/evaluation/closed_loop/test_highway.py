"""`asp-env drive` and `asp-env evaluate` in the traffic of highway-env."""

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


def test_drive(tmp_path):
    """The expert is the first method, follows its log and reaches its goal; traffic is `own`."""
    out, data = tmp_path / "out", highway_data("intersection")
    given = ["drive", data, "--out", str(out), "--max-scenarios", "2", "--scenarios", "length<=9"]
    assert main([*given, "--predictors", *PREDICTORS]) == 0
    endings = json.loads((out / "manifest.json").read_text())["endings"]
    assert list(endings) == ["expert", *(f"contingency + {each}" for each in PREDICTORS)]
    assert endings["expert"] == {"GOAL": 2}
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
    for method in endings:
        rollouts = [Rollout.load(path) for path in (out / "rollouts" / method).iterdir()]
        assert len(rollouts) == 2
    assert (out / "report.html").stat().st_size > 10_000


def test_evaluate(tmp_path):
    """The oracle has no error; constant velocity has a larger one than constant turn rate."""
    out = tmp_path / "out"
    given = ["evaluate", highway_data("roundabout"), "--out", str(out)]
    assert main([*given, "--predictors", *PREDICTORS, "oracle"]) == 0
    values = {
        (row["predictor"], row["metric"]): float(row["value"])
        for row in _rows(out)
        if (row["subset"], row["selection"]) == ("moving", "most-probable")
    }
    assert values["oracle", "FDE"] == pytest.approx(0.0, abs=1e-4)
    assert values["constant-velocity", "FDE"] > values["constant-turn-rate", "ADE"] > 1.0


def test_wrong_options_are_errors_of_one_line(tmp_path, capsys):
    """Unknown DATA, a driver that needs replayed logs, and a tick that fits no frame rate."""
    for options, message in (
        (["highway:nowhere"], "unknown highway site or folder 'nowhere'"),
        ([highway_data("roundabout"), "--traffic", "log"], "this world replays no tracks"),
        ([highway_data("roundabout"), "--dt", "0.3333333333"], "multiple of that"),
    ):
        out = tmp_path / "out"
        assert main(["drive", *options, "--out", str(out), "--horizon", "1"]) == 2
        error = capsys.readouterr().err
        assert message in error
        assert error.count("\n") == 1
        assert not out.exists()
