"""`asp-env study`: cells that are driven once, and what is made of them."""

import csv
import dataclasses
import hashlib
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from asp_env.data.predictor import Forecast
from asp_env.data.scene import Scene
from asp_env.data.snippets import Future
from asp_env.errors import AspEnvError, DataError
from asp_env.evaluation.closed_loop.drive import Drive, drive
from asp_env.evaluation.results import Row
from asp_env.evaluation.study import study
from asp_env.evaluation.study.cells import CellFolder
from asp_env.evaluation.study.compare import Compare, compare_methods, read_scenario_table
from asp_env.evaluation.study.conditions import Group, make_cells, make_groups, open_data_sets
from asp_env.evaluation.study.driving import Task, drive_tasks
from asp_env.evaluation.study.settings import StudySettings
from asp_env.evaluation.study.study import Study, StudyResult, run_study, write_study
from predictors.physical import ConstantVelocity
from tests.crossing_files import ON_ROAD, write_crossing
from tests.sim.worlds import car
from tests.test_stored import write_member


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> str:
    """Two recordings of one place."""
    folder = tmp_path_factory.mktemp("crossing")
    drives = ((*ON_ROAD, car(-60, 8)), (ON_ROAD[1], car(-95, 8), car(-40, 7)))
    return str(write_crossing(folder, drives=drives))


def settings(data: str, **changes: object) -> StudySettings:
    given = StudySettings(
        data=(data,),
        methods=("constant-turn-rate", "idm"),
        controls=False,
        traffic=("log", "idm"),
        max_scenarios=3,
    )
    return dataclasses.replace(given, **changes)


def bytes_of(folder: Path) -> dict[str, str]:
    """Hash of every file below a folder."""
    return {
        str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


class Counted:
    """Drives in this process, and counts the cells of each study."""

    def __init__(self) -> None:
        self.counts: list[int] = []

    def study(self, given: StudySettings, out: Path) -> None:
        """Runs a study."""
        self.counts.append(0)
        run_study(given, out, drive=self._drive)

    def _drive(self, groups: Sequence[Group], dt_s: float, tasks: Sequence[Task]):
        self.counts[-1] = len(tasks)
        return drive_tasks(groups, dt_s, tasks, jobs=1)


def test_a_study_of_one_condition_is_a_drive(data: str, tmp_path: Path) -> None:
    """The same rows as `asp-env drive` prints, besides what only a study measures."""
    result = run_study(settings(data, methods=("constant-turn-rate",), traffic=("log",)), tmp_path)
    predictors = ("constant-turn-rate", "constant-velocity", "oracle")
    expected = drive(
        Drive(data=data, out=tmp_path, predictors=predictors, traffic="log", max_scenarios=3)
    )
    metrics = {row.metric for row in expected.rows}
    rows = [row for row in result.rows if row.metric in metrics]
    assert rows == expected.rows
    assert {row.value for row in result.rows if row.metric == "faulty"} == {0.0}


def test_only_what_depends_on_a_changed_option_is_driven(data: str, tmp_path: Path) -> None:
    """In two traffics: 4 methods with the expert, and `idm` alone; the expert is shared.

    Three predictors forecast while the expert is replayed, once for both traffics.
    """
    counted = Counted()
    for changes in (
        {},
        {},
        {"methods": ("constant-turn-rate", "idm", "blind")},
        {"traffic": ("idm",)},
        {"latency_ticks": (0, 1)},
        {"rules": "nuplan"},
    ):
        counted.study(settings(data, **changes), tmp_path)
    # 2 traffics of (expert, turn rate, constant velocity, oracle, idm), and 3 at logged states;
    # blind; 3 predictors that are late; everything by other rules.
    assert counted.counts == [2 * 5 + 3, 0, 2, 0, 2 * 3 + 3, 2 * 5 + 3]


def test_the_same_bytes_by_any_number_of_processes_and_after_a_kill(
    data: str, tmp_path: Path
) -> None:
    """The last study is killed as soon as it has stored a cell."""
    config = tmp_path / "study.toml"
    config.write_text(
        f'data = ["{data}"]\nmethods = ["constant-turn-rate"]\ncontrols = false\n'
        'traffic = ["log", "idm"]\nmax_scenarios = 2\n'
    )
    folders = [tmp_path / name for name in ("one", "two", "killed")]
    Study(config=config, out=folders[0]).run()
    Study(config=config, out=folders[1], jobs=2).run()
    command = [sys.executable, "-m", "asp_env.cli", "study", str(config), "--out", str(folders[2])]
    process = subprocess.Popen(
        [*command, "--jobs", "2"],
        stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True,
    )  # fmt: skip
    deadline_s = time.monotonic() + 60
    while not list(folders[2].rglob("*.npz")):
        assert process.poll() is None
        assert time.monotonic() < deadline_s
        time.sleep(0.01)
    os.killpg(process.pid, signal.SIGKILL)
    process.wait()
    Study(config=config, out=folders[2]).run()
    found = [bytes_of(folder) for folder in folders]
    assert found[0] == found[1] == found[2]
    assert "metrics.csv" in found[0]


def test_a_folder_that_another_process_drives_or_that_is_no_study_is_refused(
    data: str, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    with (
        study._locked(out),
        pytest.raises(AspEnvError, match="another process drives this study"),
    ):
        Study(out=out, data=(data,), methods=("idm",)).run()
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "file").touch()
    with pytest.raises(AspEnvError, match="is not the folder of a study"):
        Study(out=tmp_path / "other", data=(data,), methods=("idm",)).run()


def test_tidy_values_are_of_the_last_study(data: str, tmp_path: Path) -> None:
    """A study without `--parquet` removes the file of one before, which may be of other methods."""
    pytest.importorskip("pyarrow")
    options = {"out": tmp_path, "data": (data,), "methods": ("idm",), "controls": False}
    Study(**options, parquet=True).run()
    assert (tmp_path / "scenarios.parquet").is_file()
    Study(**options).run()
    assert not (tmp_path / "scenarios.parquet").exists()


def test_a_damaged_cell_is_named(data: str, tmp_path: Path) -> None:
    given = settings(data, traffic=("log",), methods=("idm",))
    run_study(given, tmp_path)
    path = next((tmp_path / "cells").rglob("*.npz"))
    claim = "{'descr': '<f8', 'fortran_order': False, 'shape': (1000000000000,), }"
    for damage in (
        lambda: path.write_bytes(path.read_bytes()[:100]),
        lambda: write_member(path, claim.encode()),
    ):
        damage()
        with pytest.raises(DataError, match=f"{path.name}: not a readable cell .* remove it"):
            run_study(given, tmp_path)
    path.unlink()
    run_study(given, tmp_path)


def test_keys_depend_on_what_the_result_depends_on(data: str) -> None:
    """Every changed setting of this list gives cells that have no key in common with the others."""
    changes = [{}, {"rules": "strict"}, {"horizon_s": 4.0}, {"budget_ms": 500.0}]
    seen: set[str] = set()
    for change in changes:
        given = settings(data, methods=("constant-turn-rate",), traffic=("log",), **change)
        groups = make_groups(given)
        methods = [group.methods() for group in groups]
        cells = make_cells(groups, methods, open_data_sets(given, groups))
        keys = {cell.key for cell in cells}
        assert not keys & seen
        seen |= keys


class FaultyOnSecond(ConstantVelocity):
    """Constant velocity that raises at one time step of the recordings."""

    def predict(self, scene: Scene, future: Future | None = None) -> Forecast:
        if (scene.tick[scene.targets[:, 0]] == 30).any():
            raise RuntimeError("of another package")
        return super().predict(scene, future)


def test_faults_are_counted_and_the_others_are_unchanged(
    data: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    given = settings(data, traffic=("log",), methods=("constant-turn-rate", "blind"))
    sound = run_study(given, tmp_path / "sound")
    monkeypatch.setattr(
        "predictors.plugs.Blind.from_name",
        lambda _argument="", *, horizon, dt_s: FaultyOnSecond(horizon=horizon, dt_s=dt_s),
    )
    faulty = run_study(given, tmp_path / "faulty")

    def others(result: StudyResult) -> list[Row]:
        """Rows of other methods, without the p values, which are adjusted over all methods."""
        return [
            dataclasses.replace(row, p_holm=None) for row in result.rows if row.predictor != "blind"
        ]

    assert others(faulty) == others(sound)
    of = {(row.predictor, row.metric): row.value for row in faulty.rows if row.subset == "all"}
    assert 0 < of["blind", "faulty"] < 1
    # What is filled in is constant velocity, and so is the rest.
    assert of["blind", "score"] == of["constant-velocity", "score"]
    write_study(faulty, tmp_path / "faulty")
    manifest = json.loads((tmp_path / "faulty" / "manifest.json").read_text())
    counts = manifest["faults"][f"contingency+blind ({data} · traffic log)"]
    drives = len(faulty.driven[0].scenarios)
    assert counts == {"predictor raised": round(of["blind", "faulty"] * drives)}
    with (tmp_path / "faulty" / "scenarios.csv").open(newline="") as file:
        lines = [line for line in csv.DictReader(file) if line["planner"] == "contingency"]
    marked = [line for line in lines if line["fault"]]
    assert len(marked) == counts["predictor raised"]
    assert "raised at tick" in marked[0]["fault"]


def test_comparison_is_paired_by_scenario(data: str, tmp_path: Path) -> None:
    """The difference of the table is that of the means, and is 0 to the same result."""
    out = tmp_path / "study"
    Study(
        out=out,
        data=(data,),
        methods=("constant-turn-rate",),
        latency_ticks=(0, 1),
        controls=False,
        max_scenarios=3,
    ).run()
    methods = read_scenario_table(out / "scenarios.csv", "score")
    a, b = methods["contingency+constant-velocity"], methods["contingency+oracle"]
    found = compare_methods("x", a, b)
    assert found is not None
    assert len(found.keys) == 2 * len({key[3] for key in a.values})
    means = [np.mean([v for values in m.values.values() for v in values.values()]) for m in (a, b)]
    assert found.less.estimate.value == pytest.approx(means[1] - means[0])
    same = compare_methods("x", a, a)
    assert same is not None
    assert (same.less.estimate.value, same.less.mde) == (0.0, 0.0)
    Compare(a=out, b=out, methods=("contingency+constant-velocity", "contingency+oracle")).run()
    with pytest.raises(AspEnvError, match="unknown method 'oracle'"):
        Compare(a=out, b=out, methods=("oracle",)).run()
    with pytest.raises(AspEnvError, match="the folders are the same"):
        Compare(a=out, b=out).run()
    with pytest.raises(AspEnvError, match=r"unknown metric 'scor' .did you mean 'score'"):
        Compare(a=out, b=out, methods=("contingency+oracle",), metric="scor").run()


def test_cells_of_a_killed_process_leave_nothing(tmp_path: Path) -> None:
    folder = CellFolder(tmp_path)
    partial = tmp_path / "cells" / "ab" / ".abc.npz.0123456789ab.partial"
    partial.parent.mkdir(parents=True)
    partial.touch()
    folder.remove_leftovers()
    assert not partial.exists()


def test_bad_input_leaves_no_folder(data: str, tmp_path: Path) -> None:
    for method, scenarios in (("nothing", ""), ("idm", "length>=900")):
        with pytest.raises(AspEnvError):
            Study(out=tmp_path / "out", data=(data,), methods=(method,), scenarios=scenarios).run()
        assert not (tmp_path / "out").exists()
