"""Drives in units: how they are dealt, and what is kept of them."""

import dataclasses
import pickle
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from asp_env.cli import main
from asp_env.data.rollout import Rollout
from asp_env.data.scenarios.scenario import ScenarioSet, find_scenarios
from asp_env.data.source import Recordings
from asp_env.evaluation.closed_loop import comparison, drive
from asp_env.evaluation.closed_loop.comparison import (
    ComparisonScores,
    EpisodeScores,
    Methods,
    WorkUnit,
    work_units,
)
from asp_env.evaluation.closed_loop.drive import Drive
from asp_env.evaluation.closed_loop.episodes import drive_episodes
from asp_env.metrics.driving.rules import PDMS, WAYMAX
from asp_env.metrics.masked import Masked
from asp_env.sim.world import Ending
from tests.predictors.tiny import save_random
from tests.render.films import make_rollout
from tests.sim.worlds import DT_S, HISTORY


@pytest.fixture(scope="module")
def scenarios(recordings: Recordings) -> ScenarioSet:
    """All of the three crossings."""
    return find_scenarios(recordings, source="", dt_s=DT_S, history=HISTORY)


@pytest.fixture(scope="module")
def network(tmp_path_factory: pytest.TempPathFactory) -> str:
    """DKM with random weights, by name."""
    return f"dkm:{save_random(tmp_path_factory.mktemp('runs') / 'dkm', 'dkm', 'vectors')}"


def entrants(*predictors: str, planner: str = "sampling", traffic: str = "log") -> Methods:
    """As the command makes them."""
    return Methods("", planner, predictors, traffic, "pdms", 3.0, DT_S)


def unit(scenarios: ScenarioSet, *numbers: int, entrant: int = 1) -> WorkUnit:
    """Some scenarios for one entrant."""
    return WorkUnit(
        entrant=entrant,
        numbers=np.array(numbers),
        scenarios=tuple(scenarios[number] for number in numbers),
    )


def outcome(*scores: float, **metrics: tuple[float, ...]) -> EpisodeScores:
    """One whose rollouts tell the scores again, as their time steps."""
    found = {"score": scores, **{name.replace("_", " "): each for name, each in metrics.items()}}
    everywhere = np.ones(len(scores), dtype=bool)
    return EpisodeScores(
        metrics={
            name: Masked(value=np.array(each), valid=everywhere) for name, each in found.items()
        },
        endings=(Ending.GOAL,) * len(scores),
        rollouts=tuple(dataclasses.replace(make_rollout(), dt_s=score) for score in scores),
    )


def told(found: ComparisonScores, entrant: int) -> list[float]:
    """The scores of the rollouts that were kept."""
    return [rollout.dt_s for rollout in found.of(entrant).rollouts]


def test_units_hold_every_scenario_once_for_everybody(
    scenarios: ScenarioSet, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The longest first, the expert's (0) behind the others', of nearly the same size."""
    monkeypatch.setattr(comparison, "EPISODES_AT_ONCE", 4)
    units = work_units(scenarios, 3)
    assert [each.entrant for each in units[:4]] == [2, 1, 0, 2]
    for entrant in range(3):
        mine = [each for each in units if each.entrant == entrant]
        numbers = np.concatenate([each.numbers for each in mine])
        assert sorted(numbers.tolist()) == list(range(len(scenarios)))
        assert (np.diff(scenarios.length[numbers]) <= 0).all()
        sizes = {len(each.numbers) for each in mine}
        assert max(sizes) <= 4
        assert max(sizes) - min(sizes) <= 1
    for each in units:
        assert [scenarios[i] for i in each.numbers.tolist()] == list(each.scenarios)


@pytest.mark.parametrize("order", [(0, 1, 2, 3), (3, 1, 2, 0)])
def test_outcomes_stand_in_the_scenarios_order(
    scenarios: ScenarioSet, order: tuple[int, ...]
) -> None:
    """Whichever comes first; the worst are the others' lowest, the expert's do not count."""
    parts = [
        (unit(scenarios, 3, 0, entrant=0), outcome(0.0, 0.1)),
        (unit(scenarios, 3, 0, entrant=1), outcome(0.3, 0.9)),
        (unit(scenarios, 1, 2, entrant=0), outcome(0.2, 0.3)),
        (unit(scenarios, 1, 2, entrant=1), outcome(0.3, 0.2)),
    ]
    found = ComparisonScores(2, PDMS)
    for number in order:
        found.add(*parts[number])
    assert found.of(0).metrics["score"].value.tolist() == [0.1, 0.2, 0.3, 0.0]
    assert found.of(1).metrics["score"].value.tolist() == [0.9, 0.3, 0.2, 0.3]
    assert found.worst == [2, 1, 3, 0]
    assert told(found, 1) == [0.2, 0.3, 0.3, 0.9]
    assert told(found, 0) == [0.3, 0.2, 0.0, 0.1]
    assert len(found.of(1).endings) == 4


def test_only_the_worst_are_kept(scenarios: ScenarioSet, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of an expert alone, by its own score; by the product of three metrics without a score."""
    monkeypatch.setattr(comparison, "SAVED_ROLLOUTS", 1)
    alone = ComparisonScores(1, PDMS)
    alone.add(unit(scenarios, 0, 1, entrant=0), outcome(0.5, 0.4))
    alone.add(unit(scenarios, 2, entrant=0), outcome(0.6))
    assert (alone.worst, told(alone, 0)) == ([1], [0.4])
    unscored = ComparisonScores(1, WAYMAX)
    metrics = {"no_collision": (1.0, 1.0), "on_road": (1.0, 0.0), "progress": (0.1, 0.9)}
    unscored.add(unit(scenarios, 0, 1, entrant=0), outcome(0.5, 0.6, **metrics))
    assert (unscored.worst, told(unscored, 0)) == ([1], [0.6])


def same(one: Rollout, other: Rollout, folder: Path) -> bool:
    """Whether they are the same bytes in a file."""
    for name, rollout in (("one", one), ("other", other)):
        rollout.save(folder / f"{name}.npz")
    return (folder / "one.npz").read_bytes() == (folder / "other.npz").read_bytes()


def test_a_copy_drives_the_same(
    recordings: Recordings, scenarios: ScenarioSet, network: str, tmp_path: Path
) -> None:
    """It is made by names; and so does one that has driven other scenarios before."""
    first = entrants(network, traffic="idm")
    second = pickle.loads(pickle.dumps(first))
    task = unit(scenarios, 4, 5)
    alone = first.drive(recordings, task)
    second.drive(recordings, unit(scenarios, 0, 1))
    after = second.drive(recordings, task)
    for one, other in zip(alone.rollouts, after.rollouts, strict=True):
        assert same(one, other, tmp_path)


def test_networks_run_on_one_thread(
    recordings: Recordings, scenarios: ScenarioSet, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of however many there are, which are given back."""
    seen: list[int] = []

    def watched(*args: Any, **kwargs: Any) -> Any:
        seen.append(torch.get_num_threads())
        return drive_episodes(*args, **kwargs)

    monkeypatch.setattr(comparison, "drive_episodes", watched)
    before = torch.get_num_threads()
    torch.set_num_threads(3)
    try:
        entrants("oracle").drive(recordings, unit(scenarios, 0, entrant=0))
        assert (seen, torch.get_num_threads()) == ([1], 3)
    finally:
        torch.set_num_threads(before)


def test_the_number_of_processes_changes_nothing(
    crossings: Path, network: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Every file of a run is the same, with a network and traffic that draws."""
    monkeypatch.setattr(comparison, "EPISODES_AT_ONCE", 2)
    runs = {1: tmp_path / "one", 2: tmp_path / "two"}
    for jobs, out in runs.items():
        Drive(
            data=str(crossings), out=out, predictors=(network,), max_scenarios=4, jobs=jobs,
            traffic=f"predictor:mode=sampled:{network}",
        ).run()  # fmt: skip
    one, two = (
        {str(path.relative_to(out)): path.read_bytes() for path in out.rglob("*") if path.is_file()}
        for out in runs.values()
    )
    assert sum(name.endswith(".npz") for name in one) == 8
    assert {"metrics.csv", "manifest.json", "scenarios.json", "report.html"} < set(one)
    assert one == two


def test_bad_input_in_a_process_is_one_line(
    crossings: Path,
    network: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    """A network that is gone by the time that the others load it; nothing is written."""
    run = tmp_path / "run"
    shutil.copytree(network.partition(":")[2], run)

    def dealt(scenarios: ScenarioSet, entrants: int) -> list[WorkUnit]:
        shutil.rmtree(run)
        return work_units(scenarios, entrants)

    monkeypatch.setattr(drive, "work_units", dealt)
    out = tmp_path / "out"
    args = ["drive", str(crossings), "--predictors", f"dkm:{run}", "--out", str(out)]
    assert main([*args, "--jobs", "2", "--max-scenarios", "2"]) == 2
    (line,) = capfd.readouterr().err.splitlines()
    assert line.startswith("asp-env: ")
    assert str(run) in line
    assert not out.exists()
