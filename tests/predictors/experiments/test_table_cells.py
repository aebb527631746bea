"""Cells of a table: which there are, their order, and how their processes run and end."""

import dataclasses
import hashlib
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from threading import Thread
from typing import Any, NamedTuple

import pytest
from rich.console import Console

from asp_env.errors import AspEnvError
from predictors.experiments.campaign import Campaign
from predictors.experiments.cells import (
    Ablation,
    Cell,
    ModelSpec,
    choose_ablations,
    plan_cells,
    site_names,
)
from predictors.experiments.job import EvaluationJob, Job
from tests.predictors.tiny import write_data

CHAINED = ("ssp-asp",)
"""Predictors whose runs for more than 3 s start from runs for 3 s."""

DKM, SSP = (
    ModelSpec(predictor=name, warm_starts_from_3s=name in CHAINED) for name in ("dkm", "ssp-asp")
)


class Known(NamedTuple):
    """The part of a variant that a table uses."""

    horizons_s: tuple[float, ...] = (3.0,)
    segment_s: float | None = None


VARIANTS = {
    "dkm": {"long": Known()},
    "ssp-asp": {"long": Known(), "ema": Known(), "from-scratch": Known((6.0,))},
}


def names(cells: list[Cell]) -> list[str]:
    """Names of the cells with training."""
    return [cell.name for cell in cells if cell.seed is not None]


def test_the_whole_table_for_one_seed_comes_first() -> None:
    """For each seed 3 s comes before 6 s, and chained cells start from 3 s of the same seed."""
    cells = plan_cells(
        sites=["a"], models=[DKM, SSP], views=["vectors"], horizons_s=[6.0, 3.0], seeds=[0, 7]
    )
    assert names(cells)[:4] == [
        "a/vectors/dkm/3s/seed0",
        "a/vectors/ssp-asp/3s/seed0",
        "a/vectors/dkm/6s/seed0",
        "a/vectors/ssp-asp/6s/seed0",
    ]
    assert len(names(cells)) == 8
    started = [cell for cell in cells if cell.start is not None]
    assert names(started) == [f"a/vectors/ssp-asp/6s/seed{seed}" for seed in (0, 7)]
    for cell in started:
        assert cell.start is not None
        assert cell.start.name == cell.name.replace("6s", "3s")
        assert cells.index(cell.start) < cells.index(cell)
    physical = {cell.name for cell in cells if cell.seed is None}
    assert physical == {
        f"a/constant-{what}/{h}s" for what in ("velocity", "turn-rate") for h in "36"
    }


def test_cells_that_others_start_from_are_added() -> None:
    """A table of 6 s alone also has the 3 s cells of chained predictors, in front."""
    cells = plan_cells(
        sites=["a"], models=[DKM, SSP], views=["vectors"], horizons_s=[6.0], seeds=[0]
    )
    assert names(cells) == [
        "a/vectors/dkm/6s/seed0",
        "a/vectors/ssp-asp/3s/seed0",
        "a/vectors/ssp-asp/6s/seed0",
    ]


def test_ablations_run_at_the_first_site_for_their_horizons() -> None:
    """A variant without a 3 s cell of its own starts from the 3 s weights of the recipe."""
    ablations = [
        Ablation(predictor="ssp-asp", name="ema", horizons_s=(3.0,), warm_starts_from_3s=True),
        Ablation(
            predictor="ssp-asp", name="scheduled", horizons_s=(6.0,), warm_starts_from_3s=True
        ),
        Ablation(
            predictor="ssp-asp", name="from-scratch", horizons_s=(6.0,), warm_starts_from_3s=False
        ),
        Ablation(
            predictor="ssp-asp", name="causal", horizons_s=(3.0, 6.0), warm_starts_from_3s=True
        ),
    ]
    cells = plan_cells(
        sites=["a", "b"],
        models=[SSP],
        views=["vectors"],
        horizons_s=[3.0, 6.0],
        seeds=[0],
        ablations=ablations,
        ablation_view="vectors",
    )
    variants = [cell for cell in cells if cell.variant and cell.seed is not None]
    starts = {cell.name: None if cell.start is None else cell.start.name for cell in variants}
    place = "a/vectors/ssp-asp"
    assert starts == {
        f"{place}-ema/3s/seed0": None,
        f"{place}-scheduled/6s/seed0": f"{place}/3s/seed0",
        f"{place}-from-scratch/6s/seed0": None,
        f"{place}-causal/3s/seed0": None,
        f"{place}-causal/6s/seed0": f"{place}-causal/3s/seed0",
    }
    assert any(cell.label == "constant-velocity-causal" for cell in cells)


def test_other_segments_start_from_runs_for_one_segment() -> None:
    """At 3 and 6 s from the same run for 1 s, which is not evaluated itself."""
    ablation = Ablation(
        predictor="ssp-asp",
        name="segment-1s",
        horizons_s=(3.0, 6.0),
        warm_starts_from_3s=True,
        segment_s=1.0,
    )
    cells = plan_cells(
        sites=["a"],
        models=[SSP],
        views=["vectors"],
        horizons_s=[3.0, 6.0],
        seeds=[0],
        ablations=[ablation],
        ablation_view="vectors",
    )
    place = "a/vectors/ssp-asp-segment-1s"
    starts = {each.name: each.start and each.start.name for each in cells if each.variant}
    assert starts == {
        f"{place}/1s/seed0": None,
        f"{place}/3s/seed0": f"{place}/1s/seed0",
        f"{place}/6s/seed0": f"{place}/1s/seed0",
    }


def test_ablations_by_name() -> None:
    """All, none, a variant of every predictor that has it, or of one predictor."""

    def warm_starts_from_3s(predictor: str, name: str) -> bool:
        return predictor in CHAINED and name != "from-scratch"

    def chosen(*given: str) -> list[Ablation]:
        return choose_ablations(given, VARIANTS, warm_starts_from_3s)

    def labels(*given: str) -> list[str]:
        return [f"{each.predictor}:{each.name}" for each in chosen(*given)]

    assert labels("none") == []
    assert labels("long") == ["dkm:long", "ssp-asp:long"]
    assert labels("ssp-asp:long", "ema") == ["ssp-asp:long", "ssp-asp:ema"]
    assert len(labels("all")) == 4
    assert [each.warm_starts_from_3s for each in chosen("all")] == [False, True, True, False]
    with pytest.raises(AspEnvError, match="did you mean 'ema'"):
        labels("ema2")
    with pytest.raises(AspEnvError, match="unknown ablation 'dkm:ema'"):
        labels("dkm:ema")


def test_site_names() -> None:
    """The last part of a path, a sample without its colon; equal names are an error."""
    assert site_names(["/x/inD/", "sample:roundabout"]) == ["inD", "sample-roundabout"]
    with pytest.raises(AspEnvError, match="'x' names 2 sites"):
        site_names(["a/x", "b/x"])


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> str:
    return write_data(tmp_path_factory.mktemp("data"))


def training(data: str, out: Path, *, epochs: int) -> Job:
    """Training of DKM on vectors."""
    recipe = {"predictor": "dkm", "view": "vectors", "max_snippets": 16, "epochs": epochs}
    return Job(train={**recipe, "data": data, "out": str(out)}, evaluation=None)


def evaluation(data: str, errors: Path) -> Job:
    """Evaluation of constant velocity, which needs no training."""
    return Job(
        train=None,
        evaluation=EvaluationJob(
            predictor="constant-velocity",
            run="",
            data=data,
            part="all",
            horizon_s=3.0,
            errors=str(errors),
            data_hash="",
        ),
    )


def test_a_failed_cell_affects_only_cells_that_start_from_it(data: str, tmp_path: Path) -> None:
    """Missing data fail a cell with one line; all processes have costs."""
    first = Cell(site="a", predictor="dkm", horizon_s=3.0, view="vectors", seed=0)
    second = Cell(site="a", predictor="dkm", horizon_s=6.0, view="vectors", seed=0, start=first)
    third = Cell(site="b", predictor="dkm", horizon_s=3.0, view="vectors", seed=0)
    jobs = {
        first: evaluation(str(tmp_path / "nowhere"), tmp_path / "1"),
        second: evaluation(data, tmp_path / "2"),
        third: evaluation(data, tmp_path / "3"),
    }
    campaign = Campaign(jobs, tmp_path, Console(quiet=True))
    campaign.run(1)
    assert "nowhere does not exist" in campaign.failed[first]
    assert "starts from, failed" in campaign.failed[second]
    assert third not in campaign.failed
    assert jobs[third].done
    assert not jobs[second].done
    costs = json.loads((tmp_path / "cost.json").read_text())
    assert costs["cells"].keys() == {first.name, third.name}
    cpu_s = [cell["cpu_s"] for cell in costs["cells"].values()]
    assert costs["total_cpu_s"] == pytest.approx(sum(cpu_s), abs=0.2)
    assert min(cpu_s) > 0.1


def wait_for_an_epoch(run: Path) -> None:
    """Waits until a training has stored the state after an epoch."""
    while not (run / "unfinished" / "state.safetensors").exists():
        time.sleep(0.05)


def test_a_killed_cell_is_resumed(
    data: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A process killed after an epoch fails its cell; the next run starts after that epoch."""
    cell = Cell(site="a", predictor="dkm", horizon_s=3.0, view="vectors", seed=0)
    run = tmp_path / "run"
    started: list[subprocess.Popen[Any]] = []
    popen = subprocess.Popen

    def spy(*args: Any, **kwargs: Any) -> subprocess.Popen[Any]:
        started.append(popen(*args, **kwargs))
        return started[-1]

    def kill_after_an_epoch() -> None:
        wait_for_an_epoch(run)
        os.kill(started[0].pid, signal.SIGKILL)

    jobs = {cell: training(data, run, epochs=40)}
    with monkeypatch.context() as patched:
        patched.setattr(subprocess, "Popen", spy)
        campaign = Campaign(jobs, tmp_path, Console(quiet=True))
        Thread(target=kill_after_an_epoch, daemon=True).start()
        campaign.run(1)
    assert "killed by signal 9" in campaign.failed[cell]
    assert not (run / "config.json").exists()
    again = Campaign(jobs, tmp_path, Console(quiet=True))
    again.run(1)
    assert not again.failed
    assert (run / "config.json").exists()
    first, second = sorted(path.name for path in (run / "logs").iterdir())
    assert first == "from-epoch-00"
    assert int(second.removeprefix("from-epoch-")) >= 1
    assert json.loads((tmp_path / "cost.json").read_text())["cells"][cell.name]["processes"] == 2


def test_an_interrupt_terminates_running_cells(
    data: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A training of a million epochs; its cost is recorded."""
    cell = Cell(site="a", predictor="dkm", horizon_s=3.0, view="vectors", seed=0)
    run = tmp_path / "run"

    def interrupt(*args: Any, **kwargs: Any) -> None:
        del args, kwargs
        wait_for_an_epoch(run)
        raise KeyboardInterrupt

    monkeypatch.setattr("predictors.experiments.campaign.wait", interrupt)
    campaign = Campaign({cell: training(data, run, epochs=10**6)}, tmp_path, Console(quiet=True))
    with pytest.raises(KeyboardInterrupt):
        campaign.run(1)
    assert json.loads((tmp_path / "cost.json").read_text())["cells"][cell.name]["cpu_s"] > 0.1


SCRIPT = """
import os, signal, sys
from pathlib import Path
from asp_env.workers import WorkerPool
from predictors.experiments.job import run_job
from tests.predictors.experiments.test_table_cells import training, wait_for_an_epoch

data, run = sys.argv[1], Path(sys.argv[2])
WorkerPool(run_job, 1).submit(training(data, run, epochs=10**6))
wait_for_an_epoch(run)
os.kill(os.getpid(), signal.SIGKILL)
"""


def test_a_training_ends_when_the_command_is_killed(data: str, tmp_path: Path) -> None:
    """A training of a million epochs; the output ends with the last process that shares it."""
    env = {**os.environ, "PYTHONPATH": os.pathsep.join(path for path in sys.path if path)}
    done = subprocess.run(
        [sys.executable, "-c", SCRIPT, data, str(tmp_path / "run")],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        env=env,
        timeout=300,
        check=False,
    )
    assert done.returncode == -signal.SIGKILL, done.stdout.decode()


def finished_run(run: Path, **provenance: Any) -> None:
    """Writes the part of a run folder that `check` reads."""
    run.mkdir()
    (run / "config.json").write_text(json.dumps({"provenance": provenance}))


def test_a_run_of_another_recipe_is_an_error(data: str, tmp_path: Path) -> None:
    """The message names the fields that differ; a run that lacks a field has its default."""
    run = tmp_path / "run"
    config = {"epochs": 8, "network": {"hidden": 4, "modes": 3}, "validation": "elsewhere"}
    finished_run(run, config=config)
    recipe = {"epochs": 8, "network": {"hidden": 4, "modes": 3, "kept": 0}, "validation": None}
    job = Job(
        train={"out": str(run), "data": data},
        evaluation=None,
        recipe=recipe,
        defaults={"epochs": 10, "network": {"hidden": 9, "kept": 0}},
    )
    job.check()
    assert job.done
    for field, value in (("hidden", 5), ("kept", 3)):
        changed = recipe | {"network": recipe["network"] | {field: value}}
        other = dataclasses.replace(job, recipe=changed)
        with pytest.raises(AspEnvError, match=f"trained with other {field} than the recipe"):
            other.check()


def test_a_run_from_other_weights_is_an_error(data: str, tmp_path: Path) -> None:
    """The run that it started from was trained again, or with another recipe."""
    first = Cell(site="a", predictor="dkm", horizon_s=3.0, view="vectors", seed=0)
    second = Cell(site="a", predictor="dkm", horizon_s=6.0, view="vectors", seed=0, start=first)
    begin, run = tmp_path / "3s", tmp_path / "6s"
    finished_run(begin, config={"epochs": 8})
    (begin / "weights.safetensors").write_bytes(b"weights")
    finished_run(run, config={"epochs": 4}, start=hashlib.sha256(b"weights").hexdigest())

    def failed(epochs: int) -> dict[Cell, str]:
        start = {"out": str(begin), "data": data}
        warm_start = {"out": str(run), "data": data, "start": str(begin)}
        jobs = {
            first: Job(train=start, evaluation=None, recipe={"epochs": epochs}),
            second: Job(train=warm_start, evaluation=None, recipe={"epochs": 4}),
        }
        campaign = Campaign(jobs, tmp_path, Console(quiet=True))
        campaign.run(0)
        return dict(campaign.failed)

    assert failed(8) == {}
    reasons = failed(9)
    assert "other epochs" in reasons[first]
    assert "starts from, failed" in reasons[second]
    (begin / "weights.safetensors").write_bytes(b"others")
    assert "started from other weights" in failed(8)[second]
    scratch = Job(train={"out": str(run), "data": data}, evaluation=None, recipe={"epochs": 4})
    with pytest.raises(AspEnvError, match="started from another run"):
        scratch.check()
