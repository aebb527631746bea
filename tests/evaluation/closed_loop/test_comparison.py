"""Work units of a comparison, their scores, and drives in several processes."""

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
    """All scenarios of the three recordings."""
    return find_scenarios(recordings, source="", dt_s=DT_S, history=HISTORY)


@pytest.fixture(scope="module")
def network(tmp_path_factory: pytest.TempPathFactory) -> str:
    """Name of a DKM with random weights."""
    return f"dkm:{save_random(tmp_path_factory.mktemp('runs') / 'dkm', 'dkm', 'vectors')}"


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with two training runs of a DKM with random weights."""
    folder = tmp_path_factory.mktemp("seeds")
    for seed in (0, 1):
        save_random(folder / f"seed{seed}", "dkm", "vectors", seed=seed)
    return folder


def methods(*predictors: str, planner: str = "sampling", traffic: str = "log") -> Methods:
    return Methods(
        data="",
        planner=planner,
        predictors={name: (name,) for name in predictors},
        traffic=traffic,
        rules="pdms",
        horizon_s=3.0,
        dt_s=DT_S,
    )


def unit(scenarios: ScenarioSet, *numbers: int, method: int = 1) -> WorkUnit:
    return WorkUnit(
        method=method,
        numbers=np.array(numbers),
        scenarios=tuple(scenarios[number] for number in numbers),
    )


def episodes(*scores: float, **metrics: tuple[float, ...]) -> EpisodeScores:
    """Episodes whose rollouts have their scores as time steps, by which they can be identified."""
    values = {"score": scores, **{name.replace("_", " "): each for name, each in metrics.items()}}
    valid = np.ones(len(scores), dtype=bool)
    return EpisodeScores(
        metrics={name: Masked(value=np.array(each), valid=valid) for name, each in values.items()},
        endings=(Ending.GOAL,) * len(scores),
        faults=(None,) * len(scores),
        rollouts=tuple(dataclasses.replace(make_rollout(), dt_s=score) for score in scores),
    )


def scores_of_rollouts(comparison_scores: ComparisonScores, method: int) -> list[float]:
    return [rollout.dt_s for rollout in comparison_scores.of(method).rollouts]


def test_units_contain_every_scenario_once_for_every_method(
    scenarios: ScenarioSet, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The longest scenarios first, the expert (0) after the others, units of similar size."""
    monkeypatch.setattr(comparison, "EPISODES_AT_ONCE", 4)
    units = work_units(scenarios, 3)
    assert [each.method for each in units[:4]] == [2, 1, 0, 2]
    for method in range(3):
        of_method = [each for each in units if each.method == method]
        numbers = np.concatenate([each.numbers for each in of_method])
        assert sorted(numbers.tolist()) == list(range(len(scenarios)))
        assert (np.diff(scenarios.length[numbers]) <= 0).all()
        sizes = {len(each.numbers) for each in of_method}
        assert max(sizes) <= 4
        assert max(sizes) - min(sizes) <= 1
    for each in units:
        assert [scenarios[i] for i in each.numbers.tolist()] == list(each.scenarios)


@pytest.mark.parametrize("order", [(0, 1, 2, 3), (3, 1, 2, 0)])
def test_scores_are_in_the_order_of_the_scenarios(
    scenarios: ScenarioSet, order: tuple[int, ...]
) -> None:
    """For any order of the units; the scores of the expert do not affect which are the worst."""
    parts = [
        (unit(scenarios, 3, 0, method=0), episodes(0.0, 0.1)),
        (unit(scenarios, 3, 0, method=1), episodes(0.3, 0.9)),
        (unit(scenarios, 1, 2, method=0), episodes(0.2, 0.3)),
        (unit(scenarios, 1, 2, method=1), episodes(0.3, 0.2)),
    ]
    scores = ComparisonScores(2, PDMS)
    for number in order:
        scores.add(*parts[number])
    assert scores.of(0).metrics["score"].value.tolist() == [0.1, 0.2, 0.3, 0.0]
    assert scores.of(1).metrics["score"].value.tolist() == [0.9, 0.3, 0.2, 0.3]
    assert scores.saved == [2, 1, 3, 0]
    assert scores_of_rollouts(scores, 1) == [0.2, 0.3, 0.3, 0.9]
    assert scores_of_rollouts(scores, 0) == [0.3, 0.2, 0.0, 0.1]
    assert len(scores.of(1).endings) == 4


def test_only_the_worst_rollouts_are_stored(
    scenarios: ScenarioSet, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The expert alone is ranked by its own score; without a score three metrics count."""
    monkeypatch.setattr(comparison, "SAVED_ROLLOUTS", 1)
    alone = ComparisonScores(1, PDMS)
    alone.add(unit(scenarios, 0, 1, method=0), episodes(0.5, 0.4))
    alone.add(unit(scenarios, 2, method=0), episodes(0.6))
    assert (alone.saved, scores_of_rollouts(alone, 0)) == ([1], [0.4])
    unscored = ComparisonScores(1, WAYMAX)
    metrics = {"no_collision": (1.0, 1.0), "on_road": (1.0, 0.0), "progress": (0.1, 0.9)}
    unscored.add(unit(scenarios, 0, 1, method=0), episodes(0.5, 0.6, **metrics))
    assert (unscored.saved, scores_of_rollouts(unscored, 0)) == ([1], [0.6])


@pytest.mark.parametrize("order", [(0, 1, 2, 3, 4, 5), (5, 4, 3, 2, 1, 0)])
def test_rollouts_of_the_most_telling_scenarios_are_stored(
    scenarios: ScenarioSet, monkeypatch: pytest.MonkeyPatch, order: tuple[int, ...]
) -> None:
    """Method 2 less the reference 1: +0.5, 0, -0.1, +0.1. The worst is 2, then gain 0, loss 2."""
    monkeypatch.setattr(comparison, "SAVED_ROLLOUTS", 1)
    monkeypatch.setattr(comparison, "TELLING_ROLLOUTS", 1)
    parts = [
        (unit(scenarios, *numbers, method=method), episodes(*scores))
        for method, rows in enumerate([(0.9,) * 4, (0.4, 0.8, 0.2, 0.6), (0.9, 0.8, 0.1, 0.7)])
        for numbers, scores in (((0, 1), rows[:2]), ((2, 3), rows[2:]))
    ]
    scores = ComparisonScores(3, PDMS, under_test=[2], reference=1)
    for number in order:
        scores.add(*parts[number])
    assert scores.saved == [2, 0]
    assert scores_of_rollouts(scores, 2) == [0.1, 0.9]
    controls = ComparisonScores(3, PDMS, reference=1)
    for number in order:
        controls.add(*parts[number])
    assert controls.saved == [2]


def same(one: Rollout, other: Rollout, folder: Path) -> bool:
    """Whether two rollouts have the same bytes in a file."""
    for name, rollout in (("one", one), ("other", other)):
        rollout.save(folder / f"{name}.npz")
    return (folder / "one.npz").read_bytes() == (folder / "other.npz").read_bytes()


def test_pickled_methods_drive_the_same(
    recordings: Recordings, scenarios: ScenarioSet, network: str, tmp_path: Path
) -> None:
    """Also after other scenarios."""
    first = methods(network, traffic="idm")
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
    """The number of threads is restored afterwards."""
    seen: list[int] = []

    def spy(*args: Any, **kwargs: Any) -> Any:
        seen.append(torch.get_num_threads())
        return drive_episodes(*args, **kwargs)

    monkeypatch.setattr(comparison, "drive_episodes", spy)
    before = torch.get_num_threads()
    torch.set_num_threads(3)
    try:
        methods("oracle").drive(recordings, unit(scenarios, 0, method=0))
        assert (seen, torch.get_num_threads()) == ([1], 3)
    finally:
        torch.set_num_threads(before)


def test_the_number_of_processes_changes_nothing(
    crossings: Path, network: str, runs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Every file of a run is the same, with two networks and with traffic that draws samples."""
    monkeypatch.setattr(comparison, "EPISODES_AT_ONCE", 2)
    outs = {1: tmp_path / "one", 2: tmp_path / "two"}
    for jobs, out in outs.items():
        Drive(
            data=str(crossings), out=out, predictors=(f"dkm:{runs}/*",), max_scenarios=4, jobs=jobs,
            traffic=f"predictor:mode=sampled:{network}",
        ).run()  # fmt: skip
    one, two = (
        {str(path.relative_to(out)): path.read_bytes() for path in out.rglob("*") if path.is_file()}
        for out in outs.values()
    )
    assert sum(name.endswith(".npz") for name in one) == 12
    assert {"scenarios.csv", "metrics.csv", "manifest.json", "scenarios.json", "report.html"} < set(
        one
    )
    assert one == two


def test_runs_of_a_predictor_are_one_method(crossings: Path, runs: Path) -> None:
    """Each run drives all scenarios; the scores of the method are the means over the runs."""
    pattern = f"dkm:{runs}/*"
    config = Drive(
        data=str(crossings), out=Path("unused"), predictors=(pattern, "constant-velocity"),
        max_scenarios=4,
    )  # fmt: skip
    result = drive.drive(config)
    names = [f"dkm:{runs}/seed{seed}" for seed in (0, 1)]
    expert, method, reference = result.methods
    assert (expert.planner, method.predictor) == ("expert", pattern)
    assert list(method.runs) == names
    assert list(reference.runs) == ["constant-velocity"]
    labels = ("dkm seed0", "dkm seed1", "constant-velocity")
    assert list(result.rollouts) == ["expert", *(f"contingency + {label}" for label in labels)]
    assert result.manifest["runs"] == {pattern: names}
    (score,) = [
        row
        for row in result.rows
        if (row.predictor, row.metric, row.subset) == (pattern, "score", "all")
    ]
    alone = [
        drive.drive(dataclasses.replace(config, predictors=(name,))).methods[1].metric("score")
        for name in names
    ]
    assert np.array_equal(method.metric("score").value, np.concatenate([a.value for a in alone]))
    assert score.value == pytest.approx(np.mean([a.value for a in alone]))
    assert (score.n, score.runs) == (4, 2)


def test_an_error_in_a_process_is_one_line(
    crossings: Path,
    network: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    """The network is deleted before the other processes load it; nothing is written."""
    run = tmp_path / "run"
    shutil.copytree(network.partition(":")[2], run)

    def delete_network(scenarios: ScenarioSet, count: int) -> list[WorkUnit]:
        shutil.rmtree(run)
        return work_units(scenarios, count)

    monkeypatch.setattr(drive, "work_units", delete_network)
    out = tmp_path / "out"
    args = ["drive", str(crossings), "--predictors", f"dkm:{run}", "--out", str(out)]
    assert main([*args, "--jobs", "2", "--max-scenarios", "2"]) == 2
    (line,) = capfd.readouterr().err.splitlines()
    assert line.startswith("asp-env: ")
    assert str(run) in line
    assert not out.exists()
