"""The commands one after another: traffic, training, evaluation, driving, report."""

import csv
import json
from pathlib import Path

import pytest

from asp_env.cli import main
from asp_env.data.rollout import Rollout
from tests.real_data import real_data


@pytest.fixture(scope="module")
def traffic(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three recordings of half a minute at one place."""
    out = tmp_path_factory.mktemp("road") / "traffic"
    assert main(["synthesize", str(out), "--recordings", "3", "--minutes", "0.5"]) == 0
    return out


@pytest.fixture(scope="module")
def run(traffic: Path) -> Path:
    """A predictor trained for one epoch on 64 snippets."""
    out = traffic.parent / "run"
    options = ["--epochs", "1", "--max-snippets", "64", "--out", str(out)]
    assert main(["train", "ffw-asp", str(traffic), *options]) == 0
    return out


def _rows(folder: Path) -> list[dict[str, str]]:
    with (folder / "metrics.csv").open(newline="") as file:
        return list(csv.DictReader(file))


def test_a_trained_predictor_is_evaluated_only_on_held_out_recordings(
    traffic: Path, run: Path, tmp_path: Path
) -> None:
    """Of three recordings, one is for training, one for validation and one for evaluation."""
    out = tmp_path / "evaluated"
    names = ["constant-velocity", f"ffw-asp:{run}"]
    assert main(["evaluate", str(traffic), "--predictors", *names, "--out", str(out)]) == 0
    manifest = json.loads((out / "manifest.json").read_text())
    assert manifest["recordings"] == 1
    assert {row["predictor"] for row in _rows(out)} == set(names)
    assert {row["selection"] for row in _rows(out)} == {"most-probable", "best-of-3", ""}
    assert (out / "report.html").stat().st_size > 100_000


def test_drives_are_logged_and_the_expert_comes_first(
    traffic: Path, run: Path, tmp_path: Path
) -> None:
    """The expert follows its log: no divergence, full progress, no collision at fault."""
    out = tmp_path / "driven"
    options = ["--predictors", f"ffw-asp:{run}", "--max-scenarios", "2", "--out", str(out)]
    assert main(["drive", str(traffic), *options]) == 0
    expert = {r["metric"]: float(r["value"]) for r in _rows(out) if r["planner"] == "expert"}
    assert _rows(out)[0]["planner"] == "expert"
    assert expert["log divergence"] == 0.0
    assert expert["progress"] == pytest.approx(1.0, abs=0.01)
    assert expert["no at-fault collision"] == 1.0
    rollouts = [Rollout.load(path) for path in sorted(out.glob("rollouts/contingency*/*.npz"))]
    assert len(rollouts) == 2
    assert all(len(rollout.plans) == len(rollout.states) - 1 for rollout in rollouts)


def test_a_finished_folder_is_not_overwritten(
    traffic: Path, run: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Exit status 2 and one line, for a training run and for traffic."""
    before = sorted(path.stat().st_mtime_ns for path in run.rglob("*"))
    assert main(["train", "ffw-asp", str(traffic), "--out", str(run)]) == 2
    assert main(["synthesize", str(traffic)]) == 2
    assert len(capsys.readouterr().err.strip().splitlines()) == 2
    assert sorted(path.stat().st_mtime_ns for path in run.rglob("*")) == before


@pytest.mark.data
def test_the_commands_run_on_real_recordings(tmp_path: Path) -> None:
    """Inspect, train on time blocks, evaluate and drive on held-out blocks."""
    data = str(real_data("karlsruhe"))
    run = tmp_path / "run"
    options = ["--split", "blocks", "--epochs", "1", "--max-snippets", "64", "--out", str(run)]
    named = ["--predictors", "constant-velocity", f"ffw-asp:{run}"]
    assert main(["inspect", data]) == 0
    assert main(["train", "ffw-asp", data, *options]) == 0
    assert main(["evaluate", data, *named, "--out", str(tmp_path / "evaluated")]) == 0
    assert main(["drive", data, *named, "--out", str(tmp_path / "driven")]) == 0
    manifest = json.loads((tmp_path / "evaluated" / "manifest.json").read_text())
    # A tenth of 1,343 snippets, without those that cross the borders of blocks.
    assert 0 < manifest["snippets"] < 200
    expert = [row for row in _rows(tmp_path / "driven") if row["planner"] == "expert"]
    by_metric = {row["metric"]: float(row["value"]) for row in expert}
    assert by_metric["no at-fault collision"] == 1.0
    assert by_metric["log divergence"] == 0.0


def test_a_demo_continues_only_its_own_folder(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A folder with other files is rejected and stays unchanged."""
    other = tmp_path / "results"
    other.mkdir()
    (other / "notes.txt").write_text("precious")
    (tmp_path / "plan.json").write_text('{"site": "elsewhere"}')
    assert main(["demo", "--out", str(tmp_path)]) == 2
    assert "choose another --out" in capsys.readouterr().err
    assert (other / "notes.txt").read_text() == "precious"
