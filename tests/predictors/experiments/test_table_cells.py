"""Which cells a table has, what comes before what, and what a cell's process does."""

import dataclasses
import hashlib
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any, NamedTuple

import pytest
from rich.console import Console

from asp_env.errors import AspEnvError
from asp_env.workers import ABANDONED
from predictors.experiments.campaign import Campaign
from predictors.experiments.cells import (
    Ablation,
    Cell,
    ModelSpec,
    choose_ablations,
    plan_cells,
    site_names,
)
from predictors.experiments.worker import Job, Judging
from tests.predictors.tiny import write_data

CHAINED = ("ssp-asp",)
"""Whose runs for more than 3 s go on from others."""

DKM, SSP = (
    ModelSpec(predictor=name, preset="", warm_starts_from_3s=name in CHAINED)
    for name in ("dkm", "ssp-asp")
)


class Known(NamedTuple):
    """What a table needs to know of a variant."""

    horizons_s: tuple[float, ...] = (3.0,)


VARIANTS = {
    "dkm": {"long": Known()},
    "ssp-asp": {"long": Known(), "ema": Known(), "from-scratch": Known((6.0,))},
}


def names(cells: list[Cell]) -> list[str]:
    """Of the cells that learn."""
    return [cell.name for cell in cells if cell.seed is not None]


def test_a_whole_table_for_one_seed_comes_first() -> None:
    """Seeds in turn; within one, 3 s before 6 s, and what chains starts from its own seed's 3 s."""
    cells = plan_cells(
        sites=["a"], entrants=[DKM, SSP], views=["vectors"], horizons_s=[6.0, 3.0], seeds=[0, 7]
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


def test_what_6_s_start_from_is_trained_without_being_asked_for() -> None:
    """A table of 6 s alone has the 3 s runs of what chains too, in front."""
    entrants = [DKM, SSP]
    cells = plan_cells(
        sites=["a"], entrants=entrants, views=["vectors"], horizons_s=[6.0], seeds=[0]
    )
    assert names(cells) == [
        "a/vectors/dkm/6s/seed0",
        "a/vectors/ssp-asp/3s/seed0",
        "a/vectors/ssp-asp/6s/seed0",
    ]


def test_ablations_are_of_the_first_site_and_their_horizons() -> None:
    """One from the 3 s weights goes on from the recipe's where it says nothing at 3 s itself."""
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
        entrants=[SSP],
        views=["vectors"],
        horizons_s=[3.0, 6.0],
        seeds=[0],
        ablations=ablations,
        ablation_view="vectors",
    )
    changed = {cell.name: cell.start for cell in cells if cell.variant and cell.seed is not None}
    starts = {name: None if start is None else start.name for name, start in changed.items()}
    place = "a/vectors/ssp-asp"
    assert starts == {
        f"{place}-ema/3s/seed0": None,
        f"{place}-scheduled/6s/seed0": f"{place}/3s/seed0",
        f"{place}-from-scratch/6s/seed0": None,
        f"{place}-causal/3s/seed0": None,
        f"{place}-causal/6s/seed0": f"{place}-causal/3s/seed0",
    }
    assert any(cell.label == "constant-velocity-causal" for cell in cells)


def test_ablations_by_name() -> None:
    """All, none, of everybody that has it, or of one predictor."""

    def warm_starts_from_3s(predictor: str, name: str) -> bool:
        return predictor in CHAINED and name != "from-scratch"

    def chosen(*given: str) -> list[Ablation]:
        return choose_ablations(given, VARIANTS, warm_starts_from_3s)

    def found(*given: str) -> list[str]:
        return [f"{each.predictor}:{each.name}" for each in chosen(*given)]

    assert found("none") == []
    assert found("long") == ["dkm:long", "ssp-asp:long"]
    assert found("ssp-asp:long", "ema") == ["ssp-asp:long", "ssp-asp:ema"]
    assert len(found("all")) == 4
    assert [each.warm_starts_from_3s for each in chosen("all")] == [False, True, True, False]
    with pytest.raises(AspEnvError, match="did you mean 'ema'"):
        found("ema2")
    with pytest.raises(AspEnvError, match="unknown ablation 'dkm:ema'"):
        found("dkm:ema")


def test_sites_are_named_after_folders() -> None:
    """The last part of a path, and a sample without its colon; two of one name are refused."""
    assert site_names(["/x/inD/", "sample:roundabout"]) == ["inD", "sample-roundabout"]
    with pytest.raises(AspEnvError, match="'x' names 2 sites"):
        site_names(["a/x", "b/x"])


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> str:
    """Three recordings."""
    return write_data(tmp_path_factory.mktemp("data"))


def training(data: str, out: Path, *, epochs: int) -> Job:
    """DKM on vectors."""
    recipe = {"predictor": "dkm", "view": "vectors", "max_snippets": 16, "epochs": epochs}
    return Job(train={**recipe, "data": data, "out": str(out)}, judging=None)


def test_job_survives_json(data: str, tmp_path: Path) -> None:
    """What a process is told is what was meant."""
    job = training(data, tmp_path, epochs=2)
    assert Job.load(job.dump()) == job


def test_worker_ends_with_whoever_started_it(data: str, tmp_path: Path) -> None:
    """With its standard input closed, a training of a million epochs ends by itself."""
    process = subprocess.Popen(
        [
            *(sys.executable, "-m", "predictors.experiments.worker"),
            training(data, tmp_path / "run", epochs=10**6).dump(),
        ],
        stdin=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    assert process.stdin is not None
    process.stdin.close()
    assert process.wait(timeout=60) == ABANDONED


def judging(data: str, errors: Path) -> Job:
    """Constant velocity, which needs no training."""
    return Job(
        train=None,
        judging=Judging(
            predictor="constant-velocity",
            run="",
            data=data,
            part="all",
            horizon_s=3.0,
            errors=str(errors),
            data_hash="",
        ),
    )


def test_failures_are_told_and_the_rest_goes_on(data: str, tmp_path: Path) -> None:
    """Data that are missing fail a cell with one line, and the cell that starts from it."""
    first = Cell(site="a", predictor="dkm", horizon_s=3.0, view="vectors", seed=0)
    second = Cell(site="a", predictor="dkm", horizon_s=6.0, view="vectors", seed=0, start=first)
    third = Cell(site="b", predictor="dkm", horizon_s=3.0, view="vectors", seed=0)
    jobs = {
        first: judging(str(tmp_path / "nowhere"), tmp_path / "1"),
        second: judging(data, tmp_path / "2"),
        third: judging(data, tmp_path / "3"),
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
    spent = [cell["cpu_s"] for cell in costs["cells"].values()]
    assert costs["total_cpu_s"] == pytest.approx(sum(spent), abs=0.2)
    assert min(spent) > 0.1


def test_killed_cell_is_gone_on_with(
    data: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A process killed after an epoch fails its cell; the next start begins behind that epoch."""
    cell = Cell(site="a", predictor="dkm", horizon_s=3.0, view="vectors", seed=0)
    run = tmp_path / "run"
    started: list[subprocess.Popen[bytes]] = []

    real_popen, real_sleep = subprocess.Popen, time.sleep

    def watched(*args: Any, **kwargs: Any) -> subprocess.Popen[bytes]:
        started.append(real_popen(*args, **kwargs))
        return started[-1]

    def kill_after_an_epoch(seconds: float) -> None:
        real_sleep(seconds)
        if started and (run / "unfinished" / "state.safetensors").exists():
            os.kill(started.pop().pid, signal.SIGKILL)

    jobs = {cell: training(data, run, epochs=40)}
    with monkeypatch.context() as patched:
        patched.setattr(subprocess, "Popen", watched)
        patched.setattr(time, "sleep", kill_after_an_epoch)
        campaign = Campaign(jobs, tmp_path, Console(quiet=True))
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


def finished_run(run: Path, **provenance: Any) -> None:
    """A folder as far as `check` looks into it."""
    run.mkdir()
    (run / "config.json").write_text(json.dumps({"provenance": provenance}))


def test_run_of_another_recipe_is_told(data: str, tmp_path: Path) -> None:
    """A finished run whose configuration differs is named with the fields that do.

    One that is older than a field has its default.
    """
    run = tmp_path / "run"
    config = {"epochs": 8, "network": {"hidden": 4, "modes": 3}, "validation": "elsewhere"}
    finished_run(run, config=config)
    recipe = {"epochs": 8, "network": {"hidden": 4, "modes": 3, "kept": 0}, "validation": None}
    job = Job(
        train={"out": str(run), "data": data},
        judging=None,
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


def test_run_from_other_weights_is_told(data: str, tmp_path: Path) -> None:
    """A run that started from weights which were trained again since is no result any more.

    Nor is one whose start was trained by another recipe, finished as it may be.
    """
    first = Cell(site="a", predictor="dkm", horizon_s=3.0, view="vectors", seed=0)
    second = Cell(site="a", predictor="dkm", horizon_s=6.0, view="vectors", seed=0, start=first)
    begin, run = tmp_path / "3s", tmp_path / "6s"
    finished_run(begin, config={"epochs": 8})
    (begin / "weights.safetensors").write_bytes(b"weights")
    finished_run(run, config={"epochs": 4}, start=hashlib.sha256(b"weights").hexdigest())

    def failed(epochs: int) -> dict[Cell, str]:
        start = {"out": str(begin), "data": data}
        warm_starts_from_3s = {"out": str(run), "data": data, "start": str(begin)}
        jobs = {
            first: Job(train=start, judging=None, recipe={"epochs": epochs}),
            second: Job(train=warm_starts_from_3s, judging=None, recipe={"epochs": 4}),
        }
        campaign = Campaign(jobs, tmp_path, Console(quiet=True))
        campaign.run(0)
        return dict(campaign.failed)

    assert failed(8) == {}
    told = failed(9)
    assert "other epochs" in told[first]
    assert "starts from, failed" in told[second]
    (begin / "weights.safetensors").write_bytes(b"others")
    assert "started from other weights" in failed(8)[second]
    at_once = Job(train={"out": str(run), "data": data}, judging=None, recipe={"epochs": 4})
    with pytest.raises(AspEnvError, match="went on from another run"):
        at_once.check()
