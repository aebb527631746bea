"""A package of third parties, installed by pip: each of its plugs is found and used by its name."""

import csv
import importlib.util
import json
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import gymnasium as gym
import numpy as np
import pytest

from asp_env import AspEnvError, registry
from asp_env.cli import main
from asp_env.data.predictor import load_predictor
from asp_env.evaluation.closed_loop import containment

PACKAGE = Path(__file__).parent / "asp_env_sample"
OF_PACKAGE = "of the package asp-env-sample 1.0"


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the installed package."""
    folder = tmp_path_factory.mktemp("third-party")
    source = shutil.copytree(PACKAGE, folder / "source")
    command = [sys.executable, "-m", "pip", "install", "--quiet", "--disable-pip-version-check"]
    options = ["--no-deps", "--no-build-isolation", "--no-index", "--no-compile"]
    subprocess.run(
        [*command, *options, "--target", str(folder / "site"), str(source)],
        check=True, capture_output=True, text=True,
    )  # fmt: skip
    return folder / "site"


@pytest.fixture
def installed(site: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """The package can be imported, and is registered."""
    monkeypatch.syspath_prepend(site)
    registry._plugs.cache_clear()
    yield
    monkeypatch.undo()
    registry._plugs.cache_clear()


@pytest.fixture
def data(tmp_path: Path) -> str:
    """Two cars on one road at 5 m/s, 20 m apart, for 20 s at 10 Hz, in the package's layout."""
    rows = [
        f"{car},{frame / 10},{20 * car + 0.5 * frame:.2f},0.0"
        for car in (1, 2)
        for frame in range(200)
    ]
    folder = tmp_path / "street"
    folder.mkdir()
    (folder / "morning.sample.csv").write_text(
        "\n".join(["agent,time_s,east_m,north_m", *rows]) + "\n"
    )
    return str(folder)


def test_the_command_lists_its_plugs(site: Path) -> None:
    """In a process of its own, as after `pip install`: `drive --help` has all names."""
    path = os.pathsep.join([str(site), os.environ.get("PYTHONPATH", "")])
    done = subprocess.run(
        [sys.executable, "-m", "asp_env.cli", "drive", "--help"],
        capture_output=True, text=True, check=True, env={**os.environ, "PYTHONPATH": path},
    )  # fmt: skip
    listed = dict(line.split(": ", 1) for line in done.stdout.splitlines()[-4:])
    assert "sample-standing" in listed["predictors"].split(", ")
    assert "sample-coasting" in listed["planners"].split(", ")
    assert "sample-cruising" in listed["drivers"].split(", ")
    assert "sample-table" in listed["readers"].split(", ")


@pytest.mark.usefixtures("installed")
def test_doctor_lists_its_plugs_and_what_is_wrong(
    data: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda _: None)  # spares the import of torch
    assert main(["doctor", data]) == 1
    lines = capsys.readouterr().out.splitlines()
    for name in ("standing", "coasting", "cruising", "table", "ego-box"):
        assert any("asp-env-sample 1.0" in line and f"sample-{name} " in line for line in lines)
    assert any("sample-table" in line and " 20.0 " in line for line in lines)
    (problem,) = [line for line in lines if line.startswith("problem: ")]
    assert problem == (
        f"problem: predictor 'sample-broken' {OF_PACKAGE} cannot be imported from its entry point "
        "asp_env_sample.broken:Broken (RuntimeError: licence expired): repair the package that "
        "registers it, or uninstall it"
    )


@pytest.mark.usefixtures("installed")
def test_inspect_reads_its_layout(data: str, capsys: pytest.CaptureFixture[str]) -> None:
    """Two tracks, and the reader's own line under Repairs."""
    assert main(["inspect", data]) == 0
    output = capsys.readouterr().out
    assert "morning" in output
    assert "all agents are taken for cars" in output


@pytest.mark.usefixtures("installed")
def test_evaluate_uses_its_predictor(data: str, tmp_path: Path) -> None:
    """Cars at 5 m/s are 15 m away from where they stood 3 s before."""
    out = tmp_path / "out"
    named = ["sample-standing", "constant-velocity"]
    options = ["--planner", "none", "--horizon", "3", "--out", str(out)]
    assert main(["evaluate", data, "--predictors", *named, *options]) == 0
    assert _value(out, "sample-standing", "FDE") == pytest.approx(15.0, abs=0.1)
    assert _value(out, "constant-velocity", "FDE") == pytest.approx(0.0, abs=0.1)


@pytest.mark.usefixtures("installed")
def test_drive_uses_its_planner_predictor_and_driver(data: str, tmp_path: Path) -> None:
    """Coasting at the recorded 5 m/s on the straight road follows the log."""
    out = tmp_path / "out"
    plugs = ["--planner", "sample-coasting", "--predictors", "sample-standing"]
    options = ["--traffic", "sample-cruising", "--max-scenarios", "2", "--out", str(out)]
    assert main(["drive", data, *plugs, *options]) == 0
    rows = _rows(out)
    assert {row["traffic"] for row in rows} == {"sample-cruising"}
    (divergence,) = [
        float(row["value"])
        for row in rows
        if row["planner"] == "sample-coasting"
        and row["metric"] == "log divergence"
        and row["subset"] == "all"
    ]
    assert divergence < 0.2


@pytest.mark.usefixtures("installed")
def test_gym_make_uses_all(data: str) -> None:
    """The view draws one channel; the forecast of a standing agent is where it is."""
    env = gym.make(
        "asp_env/Replay-v0",
        data=data,
        observations=("raster", "state"),
        view="sample-ego-box",
        traffic="sample-cruising",
        predictor="sample-standing",
    )
    observation, _ = env.reset(seed=0)
    assert observation["raster"].shape[0] == 1
    assert any("forecast" in name for name in observation)
    observation, reward, *_ = env.step(np.zeros(2, dtype=np.float32))
    assert np.isfinite(float(reward))
    assert observation["raster"].max() == 255


@pytest.mark.usefixtures("installed")
@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("sample-broken", f"predictor 'sample-broken' {OF_PACKAGE} cannot be imported"),
        (
            "sample-incomplete",
            f"predictor 'sample-incomplete' {OF_PACKAGE} is no Predictor: Incomplete lacks dt_s, "
            "history, horizon, metadata, predict, privileged, trained_on",
        ),
        ("sample-incomplete:fail", "cannot be made (KeyError: 'weights', at "),
        ("sample-standing:run", "sample-standing takes no argument, 'run' was given"),
    ],
)
def test_errors_of_a_broken_plug_name_the_package(name: str, message: str) -> None:
    with pytest.raises(AspEnvError) as caught:
        load_predictor(name, horizon=15, dt_s=0.2)
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


def _rows(out: Path) -> list[dict[str, str]]:
    with (out / "metrics.csv").open() as file:
        return list(csv.DictReader(file))


def _value(out: Path, predictor: str, metric: str) -> float:
    values = {
        float(row["value"])
        for row in _rows(out)
        if (row["predictor"], row["metric"], row["subset"]) == (predictor, metric, "all")
        and row["selection"] == "most-probable"
    }
    (value,) = values
    return value


@pytest.mark.usefixtures("installed")
def test_a_study_goes_on_with_faulty_predictors(
    data: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Each fault is counted by its cause, and the rows of other methods stay the same bytes.

    What is filled in is constant velocity: it scores the same as that predictor. The clock of the
    budget goes on only while the slow predictor sleeps, so that a busy machine is not over budget.
    """
    slept_s = [0.0]
    clock = SimpleNamespace(perf_counter=lambda: sum(slept_s), sleep=slept_s.append)
    monkeypatch.setattr(containment, "time", clock)
    monkeypatch.setattr("asp_env_sample.faulty.time", clock)
    causes = {
        "raises": "raised",
        "not-finite": "not finite",
        "shapes": "wrong shapes",
        "ids": "wrong ids",
        "slow": "over budget",
    }
    options = ["--data", data, "--traffic", "log", "--no-controls", "--max-scenarios", "2"]
    options += ["--budget-ms", "1000"]
    good = ["constant-turn-rate", "sample-standing"]
    faulty = [f"sample-faulty:{name}" for name in causes]
    for name, methods in (("sound", good), ("faulty", [*good, *faulty])):
        arguments = ["study", "--out", str(tmp_path / name), *options, "--methods", *methods]
        assert main(arguments) == 0
    lines = capsys.readouterr().out
    texts = [(tmp_path / name / "scenarios.csv").read_text() for name in ("sound", "faulty")]
    others = [line for line in texts[1].splitlines() if "sample-faulty" not in line]
    assert others == texts[0].splitlines()
    counts = json.loads((tmp_path / "faulty" / "manifest.json").read_text())["faults"]
    rows = [*csv.DictReader(texts[1].splitlines())]
    scores: dict[str, list[str]] = {}
    for row in rows:
        if row["planner"] == "contingency":
            scores.setdefault(row["predictor"], []).append(row["score"])
    for name, cause in causes.items():
        drives = [row for row in rows if row["predictor"] == f"sample-faulty:{name}"
                  and row["planner"] == "contingency"]  # fmt: skip
        marked = [row for row in drives if cause in row["fault"]]
        assert len(marked) == len(drives) == len({row["scenario"] for row in rows})
        (count,) = [
            each for method, each in counts.items()
            if method.startswith(f"contingency+sample-faulty:{name} ")
        ]  # fmt: skip
        assert count == {f"predictor {cause}": len(drives)}
        assert f"faulty:{name}" in lines
        assert scores[f"sample-faulty:{name}"] == scores["constant-velocity"]
    assert all("sample-faulty" in method for method in counts)
