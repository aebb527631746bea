"""`asp-env table`: a small table, its numbers by hand, and errors."""

import csv
import dataclasses
import fcntl
import io
import itertools
import json
import math
import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from asp_env.cli import main
from asp_env.errors import AspEnvError, DataError
from asp_env.evaluation import statistics
from predictors.experiments.errors import METRICS, VIOLATIONS, Errors, stamp_of
from predictors.experiments.results import (
    NO_SEED,
    Choice,
    Findings,
    Key,
    Sums,
    Training,
    excludes_zero,
)
from predictors.experiments.tables import (
    PAPER,
    difference_table,
    main_table,
    paper_errors,
    training_table,
    violation_table,
)
from tests.predictors.tiny import write_data

MOST_PROBABLE = Choice("most-probable", "all")
MOVING = Choice("most-probable", "moving")
BEST = Choice("best-of-3", "all")


def errors(fde: Sequence[float], *, shift: int = 0) -> Errors:
    """Errors of four snippets: three of one recording, the third of which stands, one of another.

    MAE, MSE and ADE are 0.1, 0.2 and 0.3 times FDE; the errors of the best mode are half as large.
    A tenth of FDE is the share of infeasible modes and, of the first snippet alone, that of modes
    off the road; no snippet shows whether modes overlap.
    """
    most_probable = np.array(fde) * np.array([0.1, 0.2, 0.3, 1.0])[:, None]
    return Errors(
        values=np.stack([most_probable, most_probable / 2]).astype(np.float32),
        moving=np.array([True, True, False, True]),
        recording=np.array([0, 0, 0, 4]),
        track=np.array([1, 2, 3, 1]),
        tick=np.array([15, 15, 15, 15 + shift]),
        stamp="s",
        violations=np.tile(np.array(fde, dtype=np.float32) / 10, (3, 1)),
        violations_valid=np.array([[True] * 4, [True] + [False] * 3, [False] * 4]),
    )


def key(predictor: str, *, view: str = "vectors", variant: str = "", chaining: str = "") -> Key:
    """A line at one site for 3 s."""
    return Key("here", view, predictor, "", variant, chaining, 3.0)


def findings() -> Findings:
    """DKM with two seeds, SSP-ASP with these and a third, and a predictor without training."""
    fdes = {
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
            for line, seeds in fdes.items()
        }
    )


def test_means_by_hand() -> None:
    """DKM: the means of the seeds are 2.5 and 4.5, so 3.5 ± √2.

    Of the moving targets (1, 3, 4 and 3, 5, 8) they are 8/3 and 16/3, so 4 ± 4/3·√2.
    """
    found = findings().means(key("dkm"), MOST_PROBABLE)
    assert found["FDE"].estimate.value == pytest.approx(3.5)
    assert found["FDE"].estimate.n == 4
    assert found["FDE"].spread == pytest.approx(math.sqrt(2))
    assert found["MAE"].estimate.value == pytest.approx(0.35)
    assert found["MSE"].estimate.value == pytest.approx(0.70)
    moving = findings().means(key("dkm"), MOVING)["FDE"]
    assert (moving.estimate.value, moving.estimate.n) == (pytest.approx(4.0), 3)
    assert moving.spread == pytest.approx(8 / 3 / math.sqrt(2))
    assert findings().means(key("dkm"), BEST)["FDE"].estimate.value == pytest.approx(1.75)


def test_intervals_are_bootstrapped_over_recordings() -> None:
    """Sums by recording give the interval of the snippets, averaged over seeds: (2, 4, 2 | 6)."""
    found = findings().means(key("dkm"), MOST_PROBABLE)["FDE"].estimate
    expected = statistics.mean(np.array([2.0, 4.0, 2.0, 6.0]), np.array([0, 0, 0, 4]))
    assert (found.low, found.high) == (pytest.approx(expected.low), pytest.approx(expected.high))
    # The bounds are resamples with one recording twice: 8/3 m in one and 6 m in the other.
    assert found.low == pytest.approx(8 / 3)
    assert found.high == pytest.approx(6.0)


def test_differences_are_over_common_seeds() -> None:
    """SSP-ASP less DKM over seeds 0 and 1: (-0.5, -2, 0, -1.5), so -1; by seed -0.5 and -1.5."""
    found = findings().differences(key("ssp-asp"), key("dkm"), MOST_PROBABLE)["FDE"]
    assert found.estimate.value == pytest.approx(-1.0)
    assert found.spread == pytest.approx(math.sqrt(0.5))
    # By recording -2.5/3 and -1.5, so no resample is zero.
    assert found.estimate.low == pytest.approx(-1.5)
    assert found.estimate.high == pytest.approx(-2.5 / 3)
    assert excludes_zero(found.estimate)
    physical = key("constant-turn-rate", view="")
    rate = findings().differences(key("dkm"), physical, MOST_PROBABLE)["FDE"]
    assert rate.estimate.value == pytest.approx(-0.5)
    assert not excludes_zero(rate.estimate)


def test_violations_by_hand() -> None:
    """DKM: (0.1, 0.3, 0.2, 0.4) and (0.3, 0.5, 0.2, 0.8), so 0.25 and 0.45: 0.35 ± 0.2/√2."""
    found = findings().violations(key("dkm"), "all")
    assert list(found) == ["infeasible", "off-road"]
    assert found["infeasible"].estimate.value == pytest.approx(0.35)
    assert found["infeasible"].estimate.n == 4
    assert found["infeasible"].spread == pytest.approx(0.2 / math.sqrt(2))
    assert found["off-road"].estimate.value == pytest.approx(0.2)
    assert found["off-road"].estimate.n == 1
    moving = findings().violations(key("dkm"), "moving")["infeasible"].estimate
    assert (moving.value, moving.n) == (pytest.approx(0.4), 3)
    assert findings().violations(key("mtp"), "all") == {}


def test_the_table_of_violations_shows_per_cent() -> None:
    text = printed(violation_table(findings(), ["here"], [key("dkm")], "all"))
    assert "35.0 / 20.0 / –" in text
    assert "[26.7, 60.0]" in text


def test_errors_of_earlier_versions_have_no_violations(tmp_path: Path) -> None:
    """They are read as before, and their line shows none."""
    old, path = errors([1, 2, 3, 4]), tmp_path / "errors.npz"
    np.savez_compressed(
        path,
        **{
            name: getattr(old, name)
            for name in ("values", "moving", "recording", "track", "tick", "stamp")
        },
    )
    sums = Sums.of(Errors.load(path))
    np.testing.assert_array_equal(sums.errors, Sums.of(old).errors)
    assert Findings(sums={key("dkm"): {0: sums}}).violations(key("dkm"), "all") == {}


def test_references() -> None:
    """The same variant if there is one, else the recipe; variants of the input are not mixed."""
    lines = findings()
    assert list(lines.references(key("ssp-asp"))) == [
        key("constant-turn-rate", view=""),
        key("dkm"),
    ]
    variant = key("ssp-asp", variant="ema")
    assert list(lines.references(variant)) == list(lines.references(key("ssp-asp")))
    assert lines.base(variant) == key("ssp-asp")
    assert lines.base(key("ssp-asp")) is None
    assert list(lines.references(key("ssp-asp", variant="causal"))) == []
    assert lines.differences(variant, key("ssp-asp"), MOST_PROBABLE)["FDE"].estimate.value == -0.75


def test_errors_of_different_snippets_are_refused() -> None:
    """They cannot be compared in pairs."""
    sums = {
        key("dkm"): {0: Sums.of(errors([1, 1, 1, 1]))},
        key("mtp"): {0: Sums.of(errors([1, 1, 1, 1], shift=3))},
    }
    with pytest.raises(AspEnvError, match="different snippets"):
        Findings(sums=sums)


def test_errors_can_be_saved_and_loaded(tmp_path: Path) -> None:
    """A truncated file has no stamp."""
    path = tmp_path / "deep" / "errors.npz"
    errors([1, 2, 3, 4]).save(path)
    again = Errors.load(path)
    np.testing.assert_array_equal(again.values, errors([1, 2, 3, 4]).values)
    assert Sums.of(again).digest == Sums.of(errors([1, 2, 3, 4])).digest
    assert stamp_of(path) == "s"
    path.write_bytes(path.read_bytes()[:-40])
    assert stamp_of(path) is None
    with pytest.raises(DataError, match=r"errors\.npz: not readable errors of forecasts"):
        Errors.load(path)
    assert stamp_of(tmp_path / "none.npz") is None


def test_paper_errors() -> None:
    """SSP-ASP on inD, 3 s: FDE 0.98; DKM on rounD, 6 s, MTP view: 1.25 / 6.13 / 5.51."""
    assert len(PAPER) == 6
    numbers = paper_errors("chauffeurnet", "ssp-asp", 0, 3.0)
    assert numbers is not None
    assert numbers.fde == 0.98
    assert paper_errors("mtp", "dkm", 1, 6.0) == (1.25, 6.13, 5.51)
    assert paper_errors("vectors", "dkm", 0, 3.0) is None
    assert paper_errors("mtp", "dkm", 2, 3.0) is None
    assert paper_errors("mtp", "dkm", 0, 4.0) is None


def printed(table: object) -> str:
    """Text of a table on a terminal."""
    out = io.StringIO()
    Console(file=out, width=120).print(table)
    return out.getvalue()


def test_tables_show_the_numbers() -> None:
    """Measured ones and those of the paper; significant differences are marked."""
    column = key("dkm")
    text = printed(main_table(findings(), ["here"], [column], MOST_PROBABLE))
    assert "0.35 / 0.70 / 3.50" in text
    assert "[2.67, 6.00] ±1.41" in text
    assert "paper 0.48 / 0.86 / 2.01" in text
    assert "other data, not comparable in size" in text
    text = printed(difference_table(findings(), ["here"], [column], MOST_PROBABLE))
    assert "less DKM" in text
    assert "-0.10* / -0.20* / -1.00*" in text
    assert "-0.05 / -0.10 / -0.50 " in text


OPTIONS = [
    *("--predictors", "dkm", "--views", "vectors", "--horizons", "3", "--seeds", "0"),
    *("--epochs", "1", "--max-snippets", "16", "--jobs", "1"),
]


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> str:
    """Three recordings: one each for training, validation and test."""
    return write_data(tmp_path_factory.mktemp("data"))


@pytest.fixture(scope="module")
def table(data: str, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a table with one trained cell."""
    out = tmp_path_factory.mktemp("tables") / "table"
    assert main(["table", data, "--out", str(out), *OPTIONS]) == 0
    return out


def content(folder: Path) -> dict[str, bytes]:
    """All files of a folder."""
    return {str(f.relative_to(folder)): f.read_bytes() for f in folder.rglob("*") if f.is_file()}


def test_a_whole_table(table: Path) -> None:
    """Rows of trained and physical predictors for every metric, and their differences."""
    with (table / "metrics.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    predictors = {row["predictor"] for row in rows}
    assert predictors == {"constant-velocity", "constant-turn-rate", "dkm"}
    dkm = [row for row in rows if row["predictor"] == "dkm"]
    metrics = {f"{m}{less}" for m in METRICS for less in ("", " less constant-turn-rate")}
    of_modes = [row for row in dkm if row["selection"]]
    assert {row["metric"] for row in of_modes} == metrics
    assert {row["selection"] for row in of_modes} == {"most-probable", "best-of-3"}
    rates = {(r["metric"], r["subset"]) for r in dkm if r["metric"] in VIOLATIONS}
    assert rates == set(itertools.product(VIOLATIONS, ("moving", "all")))
    assert "infeasible / off-road / overlap" in (table / "table.txt").read_text()
    assert {(row["recipe"], row["view"]) for row in dkm} == {("cpu", "vectors")}
    epochs = {row["metric"]: row["value"] for row in rows if "epochs" in row["metric"]}
    assert {name: float(value) for name, value in epochs.items()} == {
        "prediction epochs": 1.0,
        "epochs of pre-training": 0.0,
    }
    text = (table / "table.txt").read_text()
    assert "training, budget: prediction epochs" in text
    assert re.search(r"DKM +1; \d+ s", text)
    assert "report.html" in content(table)
    assert "paper 0.48 / 0.86 / 2.01" in (table / "table.txt").read_text()
    manifest = json.loads((table / "manifest.json").read_text())
    assert manifest["failed"] == {}
    assert manifest["options"]["seeds"] == [0]
    assert manifest["options"]["parked"] is False


def test_a_table_of_equal_cpu_time(data: str, tmp_path: Path) -> None:
    """The epochs follow from the stored costs: 3 · 2 s for the reference, 6 s / 4 s are 2."""
    costs = tmp_path / "costs.json"
    epochs = {
        "mtp:cpu/vectors/3s/16-snippets": {"prediction_s": 2.0},
        "dkm:cpu/vectors/3s/16-snippets": {"prediction_s": 4.0},
    }
    costs.write_text(json.dumps({"reference": "mtp:cpu", "epochs": epochs}))
    out = tmp_path / "table"
    given = ["--budget", "cpu", "--cpu-reference", "mtp", "--costs", str(costs), "--epochs", "3"]
    assert main(["table", data, "--out", str(out), *OPTIONS, *given]) == 0
    config = json.loads(next(out.glob("runs/*/vectors/dkm/3s/seed0/config.json")).read_text())
    assert config["provenance"]["trained_epochs"] == 2
    text = " ".join((out / "table.txt").read_text().split())
    assert "training, budget: CPU time of mtp:cpu" in text
    assert re.search(r"DKM +2; \d+ s", text)
    manifest = json.loads((out / "manifest.json").read_text())
    assert (
        manifest["epoch costs"]["epochs"]["dkm:cpu/vectors/3s/16-snippets"]["prediction_s"] == 4.0
    )
    assert main(["table", data, "--out", str(out), *OPTIONS, "--epochs", "3"]) == 2


def test_the_training_of_a_line_by_hand() -> None:
    """Epochs of several seeds are a range, CPU times a mean; unknown times are left out."""
    column = key("dkm")
    runs = [Training(20, 0, 100.0), Training(31, 0, 140.0)]
    found = dataclasses.replace(findings(), training={column: runs})
    text = printed(training_table(found, ["here"], [column], "in words"))
    assert "training, budget: in words" in text
    assert "20 to 31; 120 s" in text
    found = dataclasses.replace(findings(), training={column: [Training(8, 2, None)]})
    assert "8 + 2 " in printed(training_table(found, ["here"], [column], "in words"))


def test_a_finished_table_is_not_repeated(data: str, table: Path) -> None:
    """Every file stays the same."""
    before = content(table)
    assert main(["table", data, "--out", str(table), *OPTIONS]) == 0
    assert content(table) == before


def test_one_command_at_a_time(data: str, table: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """While one command uses a folder, another one may only print the finished cells."""
    with (table / ".lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        assert main(["table", data, "--out", str(table), *OPTIONS]) == 2
        assert "another asp-env table uses it" in capsys.readouterr().err
        assert main(["table", data, "--out", str(table), *OPTIONS, "--jobs", "0"]) == 0
    assert "DKM" in capsys.readouterr().out


def test_missing_errors_are_computed_again(data: str, table: Path) -> None:
    """They are the same, and nothing is trained again."""
    path = next(table.glob("errors/*/vectors/dkm/3s/seed0.npz"))
    before = Errors.load(path)
    run = next(table.glob("runs/*/vectors/dkm/3s/seed0/weights.safetensors"))
    trained = run.stat().st_mtime_ns
    path.unlink()
    assert main(["table", data, "--out", str(table), *OPTIONS]) == 0
    np.testing.assert_array_equal(Errors.load(path).values, before.values)
    assert run.stat().st_mtime_ns == trained


def test_failed_cells_end_with_status_1(
    data: str, table: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A run of another recipe is reported and left out; all else is printed."""
    config = next(table.glob("runs/*/vectors/dkm/3s/seed0/config.json"))
    before = config.read_text()
    changed = json.loads(before)
    changed["provenance"]["config"]["batch_size"] = 1
    config.write_text(json.dumps(changed))
    with pytest.raises(SystemExit) as stopped:
        main(["table", data, "--out", str(table), *OPTIONS])
    config.write_text(before)
    assert stopped.value.code == 1
    printed = capsys.readouterr().out
    assert "seed0 was trained with other batch_size than the recipe has now" in printed
    assert "constant-velocity" in printed
    assert main(["table", data, "--out", str(table), *OPTIONS]) == 0


@pytest.mark.parametrize(
    ("given", "what"),
    [
        (["--predictors", "dkn"], "did you mean 'dkm'"),
        (["--predictors", "dkm:ours2"], "recipe of dkm"),
        (["--views", "raster"], "unknown view 'raster'"),
        (["--ablations", "skip"], "unknown ablation 'skip'"),
        (["--horizons", "0.3"], "0.3"),
        (["--jobs", "-1"], "--jobs -1: expected 0 to 1024 processes"),
        (["--per-recording", "0"], "--per-recording 0: expected 1 or more"),
        (["--horizons", "3", "6", "3"], "--horizons: 3.0 is given twice; give it once"),
        (["--seeds", "-1"], "--seeds -1: expected 0 to 4294967295"),
        (["--ablations", "none", "all"], "--ablations none all: expected none alone"),
        (["--budget", "converged", "--patience", "0"], "patience is 0, expected 1 or more"),
        (["--budget", "cpu", "--costs", "."], ".: cannot be read (Is a directory)"),
        (["--epochs", "0"], "epochs is 0"),
        (["--patience", "2"], "patience is 2 with the budget epochs"),
        (["--budget", "cpu", "--ablations", "long"], "unknown ablation 'long'"),
        (["--budget", "cpu", "--cpu-reference", "dkn"], "did you mean 'dkm'"),
        (["--ablations", "nearest"], "unknown ablation 'nearest'"),
        (["--validation", "DATA"], "nothing is left to evaluate on; give --test too"),
        (["--test", "DATA", "DATA"], "--test: 2 given, expected one for each of the 1 DATA"),
        (["--test", "DATA"], "evaluate on recordings that are neither trained nor selected on"),
        (["--test", "nowhere"], "nowhere does not exist"),
    ],
)
def test_bad_options_are_one_line(
    given: list[str], what: str, data: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Status 2, before anything is written."""
    out = tmp_path / "table"
    given = [data if each == "DATA" else each for each in given]
    assert main(["table", data, "--out", str(out), *OPTIONS, *given]) == 2
    error = capsys.readouterr().err
    assert what in error
    assert error.count("\n") == 1
    assert not out.exists()


def test_data_that_cannot_be_divided_are_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A single recording, before any cell fails for it, with options that this command has."""
    out = tmp_path / "table"
    assert main(["table", "sample:intersection", "--out", str(out), *OPTIONS]) == 2
    error = capsys.readouterr().err
    assert "a split by recording needs three; give more recordings, or other data by" in error
    assert "--validation and --test" in error
    assert not out.exists()


def test_folders_of_other_tables_are_refused(
    data: str, table: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A table with other options, and a folder with something else."""
    assert main(["table", data, "--out", str(table), *OPTIONS, "--epochs", "2"]) == 2
    assert "contains a table with other epochs" in capsys.readouterr().err
    assert main(["table", data, "--out", str(table), *OPTIONS, "--budget", "converged"]) == 2
    assert "contains a table with other budget;" in capsys.readouterr().err
    assert main(["table", data, "--out", str(table), *OPTIONS, "--parked"]) == 2
    assert "contains a table with other parked" in capsys.readouterr().err
    (tmp_path / "letter.txt").write_text("dear")
    assert main(["table", data, "--out", str(tmp_path), *OPTIONS]) == 2
    assert "contains something that is no table" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["letter.txt"]


def test_folders_of_commands_that_were_killed(
    data: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A folder without plan can be used again; a truncated plan is an error."""
    begun = tmp_path / "begun"
    begun.mkdir()
    (begun / ".lock").touch()
    assert main(["table", data, "--out", str(begun), *OPTIONS, "--jobs", "0"]) == 0
    (begun / "plan.json").write_text('{"sites":')
    capsys.readouterr()
    assert main(["table", data, "--out", str(begun), *OPTIONS, "--jobs", "0"]) == 2
    error = capsys.readouterr().err
    assert "plan.json: cannot be read" in error
    assert error.count("\n") == 1
