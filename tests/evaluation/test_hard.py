"""The largest regret along the log of scenarios, and the selection `hard`."""

import json
from pathlib import Path

import numpy as np
import pytest

from asp_env.data.cache import cache_folder
from asp_env.data.predictor import load_predictor
from asp_env.data.scenarios.scenario import ScenarioSet, find_scenarios
from asp_env.data.source import Recordings, open_data
from asp_env.errors import AspEnvError
from asp_env.evaluation import hard
from asp_env.evaluation.closed_loop.drive import Drive
from asp_env.evaluation.hard import HARD_NOTE, is_hard, scenario_regrets, select_scenarios
from asp_env.evaluation.regret import load_candidate_planner, logged_states, regrets_at


@pytest.fixture(autouse=True)
def _own_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ASP_ENV_CACHE", str(tmp_path / "cache"))


@pytest.fixture(scope="module")
def sample() -> Recordings:
    """The sample of an intersection."""
    return open_data("sample:intersection")


@pytest.fixture(scope="module")
def interactive(sample: Recordings) -> ScenarioSet:
    """Its interactive scenarios."""
    found = find_scenarios(sample, source=sample.source, dt_s=0.2, history=15)
    return found.filtered("interactive")


def test_the_largest_over_all_states_and_cached(
    sample: Recordings, interactive: ScenarioSet, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As computed state by state; the second call computes nothing."""
    names = ("blind", "constant-velocity")
    largest = scenario_regrets(sample, interactive, names)
    states = logged_states(interactive)
    every = regrets_at(
        states,
        interactive,
        {name: load_predictor(name, horizon=15, dt_s=0.2) for name in names},
        load_candidate_planner("sampling"),
        scenes=sample,
        recorded=sample,
        horizon=15,
    )
    for column, name in enumerate(names):
        for number in range(len(interactive)):
            assert largest[number, column] == every[name][states.scenario == number].max()
    monkeypatch.setattr(hard, "regrets_at", None)
    np.testing.assert_array_equal(scenario_regrets(sample, interactive, names), largest)
    with pytest.raises(TypeError):  # other scenarios are another entry
        scenario_regrets(sample, interactive.select(np.arange(1, len(interactive))), names)
    for path in cache_folder().glob("regrets-*"):
        damaged = bytearray(path.read_bytes())
        damaged[-1] ^= 1
        path.write_bytes(damaged)
    with pytest.raises(TypeError):  # damaged entries are computed again
        scenario_regrets(sample, interactive, names)


def test_hard_scenarios(sample: Recordings, interactive: ScenarioSet) -> None:
    """The interactive ones with a regret above 10, and of those the ones that fit the rest."""
    chosen = select_scenarios(sample, "hard", dt_s=0.2, history=15)
    above = scenario_regrets(sample, interactive, ["constant-velocity"])[:, 0] > 10
    assert 0 < len(chosen) < len(interactive)
    names = [each.name for each in interactive.select(above)]
    assert [each.name for each in chosen] == names
    some = select_scenarios(sample, "length>=8, hard", dt_s=0.2, history=15)
    assert [each.name for each in some] == [each.name for each in chosen.filtered("length>=8")]


def test_without_hard_nothing_is_computed(sample: Recordings) -> None:
    """It is `choose_scenarios`, and the cache holds no regrets."""
    assert len(select_scenarios(sample, "", dt_s=0.2, history=15)) == len(
        find_scenarios(sample, source=sample.source, dt_s=0.2, history=15)
    )
    assert not list(cache_folder().glob("regrets-*"))
    assert not is_hard("left,density>5")
    assert is_hard("left, hard")


def test_no_hard_scenario_is_an_error(sample: Recordings, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(hard, "HARD_REGRET", 1e6)
    with pytest.raises(AspEnvError, match="use interactive instead of hard") as caught:
        select_scenarios(sample, "hard", dt_s=0.2, history=15)
    assert "\n" not in str(caught.value)


def test_results_say_what_hard_favours(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """On the terminal, in the manifest and in the report; the selection is frozen in a file."""
    out = tmp_path / "out"
    Drive(data="sample:intersection", out=out, scenarios="hard", max_scenarios=2).run()
    assert "favour every other predictor" in " ".join(capsys.readouterr().out.split())
    assert json.loads((out / "manifest.json").read_text())["note"] == HARD_NOTE
    assert "favour every other predictor against it" in (out / "report.html").read_text()
    assert len(json.loads((out / "scenarios.json").read_text())["scenarios"]) == 2
