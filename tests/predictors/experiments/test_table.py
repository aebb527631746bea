"""`asp-env table`: a whole small one, its numbers by hand, and what it refuses."""

import csv
import fcntl
import io
import json
import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from asp_env.cli import main
from asp_env.errors import AspEnvError
from asp_env.evaluation import statistics
from predictors.experiments.errors import METRICS, Errors, stamp_of
from predictors.experiments.results import (
    NO_SEED,
    Choice,
    Findings,
    Key,
    Sums,
    excludes_zero,
)
from predictors.experiments.tables import PAPER, difference_table, main_table, paper_numbers
from tests.predictors.tiny import write_data

SURE = Choice("most-probable", "all")
MOVING = Choice("most-probable", "moving")
BEST = Choice("best-of-3", "all")


def errors(fde: Sequence[float], *, shift: int = 0) -> Errors:
    """Of four snippets: three of one recording, the last of which stands, and one of another.

    MAE, MSE and ADE are 1, 2 and 3 tenths of FDE; the best mode's errors are half.
    """
    sure = np.array(fde) * np.array([0.1, 0.2, 0.3, 1.0])[:, None]
    return Errors(
        values=np.stack([sure, sure / 2]).astype(np.float32),
        moving=np.array([True, True, False, True]),
        recording=np.array([0, 0, 0, 4]),
        track=np.array([1, 2, 3, 1]),
        tick=np.array([15, 15, 15, 15 + shift]),
        stamp="s",
    )


def key(predictor: str, *, view: str = "vectors", variant: str = "", chaining: str = "") -> Key:
    """A line at the first site, for 3 s."""
    return Key("here", view, predictor, "", variant, chaining, 3.0)


def findings() -> Findings:
    """DKM with two seeds, SSP-ASP with those and a third, and one that learns nothing."""
    found = {
        key("constant-turn-rate", view=""): {NO_SEED: [4.0, 4.0, 4.0, 4.0]},
        key("dkm"): {0: [1.0, 3.0, 2.0, 4.0], 1: [3.0, 5.0, 2.0, 8.0]},
        key("ssp-asp"): {
            0: [1.0, 2.0, 2.0, 3.0],
            1: [2.0, 2.0, 2.0, 6.0],
            2: [9.0, 9.0, 9.0, 9.0],
        },
        key("ssp-asp", variant="ema"): {1: [1.0, 1.0, 2.0, 5.0]},
    }
    return Findings(
        sums={
            line: {seed: Sums.of(errors(fde)) for seed, fde in seeds.items()}
            for line, seeds in found.items()
        }
    )


def test_means_by_hand() -> None:
    """DKM: seeds of mean 2.5 and 4.5, so 3.5 ± √2; moving alone (1, 3, 4; 3, 5, 8) 4 ± 4/3·√2."""
    found = findings().numbers(key("dkm"), SURE)
    assert found["FDE"].estimate.value == pytest.approx(3.5)
    assert found["FDE"].estimate.n == 4
    assert found["FDE"].spread == pytest.approx(math.sqrt(2))
    assert found["MAE"].estimate.value == pytest.approx(0.35)
    assert found["MSE"].estimate.value == pytest.approx(0.70)
    moving = findings().numbers(key("dkm"), MOVING)["FDE"]
    assert (moving.estimate.value, moving.estimate.n) == (pytest.approx(4.0), 3)
    assert moving.spread == pytest.approx(8 / 3 / math.sqrt(2))
    assert findings().numbers(key("dkm"), BEST)["FDE"].estimate.value == pytest.approx(1.75)


def test_interval_is_the_bootstrap_over_recordings() -> None:
    """Of sums by recording as of the snippets themselves, averaged over seeds: (2, 4, 2 | 6)."""
    found = findings().numbers(key("dkm"), SURE)["FDE"].estimate
    wanted = statistics.mean(np.array([2.0, 4.0, 2.0, 6.0]), np.array([0, 0, 0, 4]))
    assert (found.low, found.high) == (pytest.approx(wanted.low), pytest.approx(wanted.high))
    # Two recordings: drawn twice each, 8/3 m in one and 6 m in the other.
    assert found.low == pytest.approx(8 / 3)
    assert found.high == pytest.approx(6.0)


def test_differences_are_over_common_seeds() -> None:
    """SSP-ASP less DKM over seeds 0 and 1: (-0.5, -2, 0, -1.5), mean -1; seeds -0.5 and -1.5."""
    found = findings().differences(key("ssp-asp"), key("dkm"), SURE)["FDE"]
    assert found.estimate.value == pytest.approx(-1.0)
    assert found.spread == pytest.approx(math.sqrt(0.5))
    # Recordings: -2.5/3 and -1.5, so zero is in no resample.
    assert found.estimate.low == pytest.approx(-1.5)
    assert found.estimate.high == pytest.approx(-2.5 / 3)
    assert excludes_zero(found.estimate)
    rate = findings().differences(key("dkm"), key("constant-turn-rate", view=""), SURE)["FDE"]
    assert rate.estimate.value == pytest.approx(-0.5)
    assert not excludes_zero(rate.estimate)


def test_who_is_compared_with_whom() -> None:
    """The same change if there is one, else the recipe; what all are given is never mixed."""
    lines = findings()
    assert list(lines.references(key("ssp-asp"))) == [
        key("constant-turn-rate", view=""),
        key("dkm"),
    ]
    changed = key("ssp-asp", variant="ema")
    assert list(lines.references(changed)) == list(lines.references(key("ssp-asp")))
    assert lines.base(changed) == key("ssp-asp")
    assert lines.base(key("ssp-asp")) is None
    assert list(lines.references(key("ssp-asp", variant="causal"))) == []
    assert lines.differences(changed, key("ssp-asp"), SURE)["FDE"].estimate.value == -0.75


def test_other_snippets_are_refused() -> None:
    """Errors at other ticks make no pairs with these."""
    sums = {
        key("dkm"): {0: Sums.of(errors([1, 1, 1, 1]))},
        key("mtp"): {0: Sums.of(errors([1, 1, 1, 1], shift=3))},
    }
    with pytest.raises(AspEnvError, match="different snippets"):
        Findings(sums=sums)


def test_errors_survive_the_disk(tmp_path: Path) -> None:
    """Every array, and the stamp; of a file that is cut short there is none."""
    path = tmp_path / "deep" / "errors.npz"
    errors([1, 2, 3, 4]).save(path)
    again = Errors.load(path)
    np.testing.assert_array_equal(again.values, errors([1, 2, 3, 4]).values)
    assert Sums.of(again).digest == Sums.of(errors([1, 2, 3, 4])).digest
    assert stamp_of(path) == "s"
    path.write_bytes(path.read_bytes()[:-40])
    assert stamp_of(path) is None
    assert stamp_of(tmp_path / "none.npz") is None


def test_paper_numbers() -> None:
    """SSP-ASP on inD, 3 s: FDE 0.98; DKM on rounD, 6 s, MTP view: 1.25 / 6.13 / 5.51."""
    assert len(PAPER) == 6
    numbers = paper_numbers("chauffeurnet", "ssp-asp", 0, 3.0)
    assert numbers is not None
    assert numbers.fde == 0.98
    assert paper_numbers("mtp", "dkm", 1, 6.0) == (1.25, 6.13, 5.51)
    assert paper_numbers("vectors", "dkm", 0, 3.0) is None
    assert paper_numbers("mtp", "dkm", 2, 3.0) is None
    assert paper_numbers("mtp", "dkm", 0, 4.0) is None


def printed(table: object) -> str:
    """As on a terminal."""
    out = io.StringIO()
    Console(file=out, width=120).print(table)
    return out.getvalue()


def test_tables_say_the_numbers() -> None:
    """Ours and the paper's in the paper's shape; differences with a mark where they are sure."""
    column = key("dkm")
    text = printed(main_table(findings(), ["here"], [column], SURE))
    assert "0.35 / 0.70 / 3.50" in text
    assert "[2.67, 6.00] ±1.41" in text
    assert "paper 0.48 / 0.86 / 2.01" in text
    assert "other data, not comparable in size" in text
    text = printed(difference_table(findings(), ["here"], [column], SURE))
    assert "less DKM" in text
    assert "-0.10* / -0.20* / -1.00*" in text
    assert "-0.05 / -0.10 / -0.50 " in text


OPTIONS = [
    *("--predictors", "dkm", "--views", "vectors", "--horizons", "3", "--seeds", "0"),
    *("--epochs", "1", "--max-snippets", "16", "--jobs", "1"),
]


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> str:
    """Three recordings: one to learn from, one to select on, one to judge on."""
    return write_data(tmp_path_factory.mktemp("data"))


@pytest.fixture(scope="module")
def table(data: str, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a table of one trained cell."""
    out = tmp_path_factory.mktemp("tables") / "table"
    assert main(["table", data, "--out", str(out), *OPTIONS]) == 0
    return out


def content(folder: Path) -> dict[str, bytes]:
    """All files."""
    return {str(f.relative_to(folder)): f.read_bytes() for f in folder.rglob("*") if f.is_file()}


def test_a_whole_table(table: Path) -> None:
    """Rows of trained and physical predictors for every metric, and of their differences."""
    with (table / "metrics.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    predictors = {row["predictor"] for row in rows}
    assert predictors == {"constant-velocity", "constant-turn-rate", "dkm"}
    mine = [row for row in rows if row["predictor"] == "dkm"]
    metrics = {f"{m}{less}" for m in METRICS for less in ("", " less constant-turn-rate")}
    assert {row["metric"] for row in mine} == metrics
    assert {row["selection"] for row in mine} == {"most-probable", "best-of-3"}
    assert {(row["recipe"], row["view"]) for row in mine} == {("cpu", "vectors")}
    assert "report.html" in content(table)
    assert "paper 0.48 / 0.86 / 2.01" in (table / "table.txt").read_text()
    manifest = json.loads((table / "manifest.json").read_text())
    assert manifest["failed"] == {}
    assert manifest["options"]["seeds"] == [0]


def test_again_does_nothing(data: str, table: Path) -> None:
    """Nothing is trained or judged again, and every file is as it was."""
    before = content(table)
    assert main(["table", data, "--out", str(table), *OPTIONS]) == 0
    assert content(table) == before


def test_one_command_at_a_time(data: str, table: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """While one is at a folder another is refused, but may print what is there."""
    with (table / ".lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        assert main(["table", data, "--out", str(table), *OPTIONS]) == 2
        assert "another asp-env table is at it" in capsys.readouterr().err
        assert main(["table", data, "--out", str(table), *OPTIONS, "--jobs", "0"]) == 0
    assert "DKM" in capsys.readouterr().out


def test_what_is_missing_is_done_again(data: str, table: Path) -> None:
    """Errors that were deleted come back the same, from the run that is there."""
    path = next(table.glob("errors/*/vectors/dkm/3s/seed0.npz"))
    kept = Errors.load(path)
    run = next(table.glob("runs/*/vectors/dkm/3s/seed0/weights.safetensors"))
    trained = run.stat().st_mtime_ns
    path.unlink()
    assert main(["table", data, "--out", str(table), *OPTIONS]) == 0
    np.testing.assert_array_equal(Errors.load(path).values, kept.values)
    assert run.stat().st_mtime_ns == trained


def test_failed_cells_end_with_status_1(
    data: str, table: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A run that another recipe trained is told and left out; all else is printed."""
    config = next(table.glob("runs/*/vectors/dkm/3s/seed0/config.json"))
    kept = config.read_text()
    changed = json.loads(kept)
    changed["provenance"]["config"]["batch_size"] = 1
    config.write_text(json.dumps(changed))
    with pytest.raises(SystemExit) as stopped:
        main(["table", data, "--out", str(table), *OPTIONS])
    config.write_text(kept)
    assert stopped.value.code == 1
    said = capsys.readouterr().out
    assert "seed0 was trained with other batch_size than the recipe has now" in said
    assert "constant-velocity" in said
    assert main(["table", data, "--out", str(table), *OPTIONS]) == 0


@pytest.mark.parametrize(
    ("given", "what"),
    [
        (["--predictors", "dkn"], "did you mean 'dkm'"),
        (["--predictors", "dkm:ours2"], "recipe of dkm"),
        (["--views", "raster"], "unknown view 'raster'"),
        (["--ablations", "skip"], "unknown ablation 'skip'"),
        (["--horizons", "0.3"], "0.3"),
        (["--jobs", "-1"], "jobs is -1"),
        (["--epochs", "0"], "epochs is 0"),
        (["--validation", "DATA"], "nothing is left to judge on; give --test too"),
        (["--test", "DATA", "DATA"], "--test: 2 given, expected one for each of the 1 DATA"),
        (["--test", "DATA"], "judge on recordings that are neither learned from nor selected on"),
        (["--test", "nowhere"], "nowhere does not exist"),
    ],
)
def test_bad_options_are_one_line(
    given: list[str], what: str, data: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Refused with status 2 before anything is written."""
    out = tmp_path / "table"
    given = [data if each == "DATA" else each for each in given]
    assert main(["table", data, "--out", str(out), *OPTIONS, *given]) == 2
    said = capsys.readouterr().err
    assert what in said
    assert said.count("\n") == 1
    assert not out.exists()


def test_other_tables_folders_are_refused(
    data: str, table: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """One of other options, and one with something else in it."""
    assert main(["table", data, "--out", str(table), *OPTIONS, "--epochs", "2"]) == 2
    assert "holds a table of other epochs" in capsys.readouterr().err
    (tmp_path / "letter.txt").write_text("dear")
    assert main(["table", data, "--out", str(tmp_path), *OPTIONS]) == 2
    assert "holds something that is no table" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["letter.txt"]


def test_folders_of_commands_that_were_killed(
    data: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """One that was killed before it said what it is may begin again; half a plan is told."""
    begun = tmp_path / "begun"
    begun.mkdir()
    (begun / ".lock").touch()
    assert main(["table", data, "--out", str(begun), *OPTIONS, "--jobs", "0"]) == 0
    (begun / "plan.json").write_text('{"sites":')
    capsys.readouterr()
    assert main(["table", data, "--out", str(begun), *OPTIONS, "--jobs", "0"]) == 2
    said = capsys.readouterr().err
    assert "plan.json: cannot be read" in said
    assert said.count("\n") == 1
