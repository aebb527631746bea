"""The whole way through the command line: traffic, training, judging, driving, report."""

import csv
import json
from pathlib import Path

import pytest

from asp_env.cli import main
from asp_env.data.rollout import Rollout
from tests.real_data import real_data


@pytest.fixture(scope="module")
def traffic(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Half a minute at one place, three times."""
    out = tmp_path_factory.mktemp("road") / "traffic"
    assert main(["synthesize", str(out), "--recordings", "3", "--minutes", "0.5"]) == 0
    return out


@pytest.fixture(scope="module")
def run(traffic: Path) -> Path:
    """A predictor that has hardly learned."""
    out = traffic.parent / "run"
    options = ["--epochs", "1", "--max-snippets", "64", "--out", str(out)]
    assert main(["train", "ffw-asp", str(traffic), *options]) == 0
    return out


def _rows(folder: Path) -> list[dict[str, str]]:
    with (folder / "metrics.csv").open(newline="") as file:
        return list(csv.DictReader(file))


def test_a_trained_predictor_is_judged_only_on_what_it_has_not_seen(
    traffic: Path, run: Path, tmp_path: Path
) -> None:
    """Of three recordings one trains, one selects and one is left to judge on."""
    out = tmp_path / "judged"
    names = ["constant-velocity", f"ffw-asp:{run}"]
    assert main(["evaluate", str(traffic), "--predictors", *names, "--out", str(out)]) == 0
    manifest = json.loads((out / "manifest.json").read_text())
    assert manifest["recordings"] == 1
    assert {row["predictor"] for row in _rows(out)} == set(names)
    assert {row["selection"] for row in _rows(out)} == {"most-probable", "best-of-3", ""}
    assert (out / "report.html").stat().st_size > 1_000_000


def test_drives_are_logged_and_the_expert_stands_first(
    traffic: Path, run: Path, tmp_path: Path
) -> None:
    """The logged driver keeps to its log: no divergence, all of the way, nothing at fault."""
    out = tmp_path / "driven"
    options = ["--predictors", f"ffw-asp:{run}", "--max-scenarios", "2", "--out", str(out)]
    assert main(["drive", str(traffic), *options]) == 0
    expert = {r["metric"]: float(r["value"]) for r in _rows(out) if r["planner"] == "expert"}
    assert _rows(out)[0]["planner"] == "expert"
    assert expert["log divergence"] == 0.0
    assert expert["progress"] == pytest.approx(1.0, abs=0.01)
    assert expert["no at-fault collision"] == 1.0
    rollouts = [Rollout.load(path) for path in sorted(out.glob("rollouts/sampling*/*.npz"))]
    assert len(rollouts) == 2
    assert all(len(rollout.plans) == len(rollout.states) - 1 for rollout in rollouts)


def test_a_finished_folder_is_not_overwritten(
    traffic: Path, run: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Exit status 2 and one line, for the run as for the traffic."""
    before = sorted(path.stat().st_mtime_ns for path in run.rglob("*"))
    assert main(["train", "ffw-asp", str(traffic), "--out", str(run)]) == 2
    assert main(["synthesize", str(traffic)]) == 2
    assert len(capsys.readouterr().err.strip().splitlines()) == 2
    assert sorted(path.stat().st_mtime_ns for path in run.rglob("*")) == before


@pytest.mark.data
def test_the_same_road_on_real_recordings(tmp_path: Path) -> None:
    """Inspect, train on time blocks, judge and drive on the blocks that are left."""
    data = str(real_data("karlsruhe"))
    run = tmp_path / "run"
    options = ["--split", "blocks", "--epochs", "1", "--max-snippets", "64", "--out", str(run)]
    named = ["--predictors", "constant-velocity", f"ffw-asp:{run}"]
    assert main(["inspect", data]) == 0
    assert main(["train", "ffw-asp", data, *options]) == 0
    assert main(["evaluate", data, *named, "--out", str(tmp_path / "judged")]) == 0
    assert main(["drive", data, *named, "--out", str(tmp_path / "driven")]) == 0
    judged = json.loads((tmp_path / "judged" / "manifest.json").read_text())
    assert 0 < judged["snippets"] < 200  # a tenth of 1,343, less what lies at the blocks' borders
    expert = [row for row in _rows(tmp_path / "driven") if row["planner"] == "expert"]
    by_metric = {row["metric"]: float(row["value"]) for row in expert}
    assert by_metric["no at-fault collision"] == 1.0
    assert by_metric["log divergence"] == 0.0


def test_a_demo_takes_up_only_its_own_remains(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A folder that holds something else is refused, and nothing in it is touched."""
    other = tmp_path / "results"
    other.mkdir()
    (other / "mine.txt").write_text("precious")
    (tmp_path / "plan.json").write_text('{"site": "elsewhere"}')
    assert main(["demo", "--out", str(tmp_path)]) == 2
    assert "choose another --out" in capsys.readouterr().err
    assert (other / "mine.txt").read_text() == "precious"
