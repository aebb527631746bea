"""Planning regret at logged states."""

import csv
from pathlib import Path

import numpy as np
import pytest

from asp_env.data.predictor import load_predictor
from asp_env.data.scenarios.scenario import ScenarioSet, find_scenarios
from asp_env.data.source import Recordings, open_data
from asp_env.errors import AspEnvError
from asp_env.evaluation import regret
from asp_env.evaluation.open_loop.evaluate import Evaluate, evaluate
from asp_env.evaluation.regret import (
    LoggedStates,
    RegretScores,
    load_candidate_planner,
    logged_states,
    regrets_at,
)
from tests.crossing_files import write_crossing
from tests.sim.worlds import car

NOWHERE = Path("not-written")
NAMES = ("constant-velocity", "blend:0.5", "oracle")


@pytest.fixture(scope="module")
def scenarios(recordings: Recordings) -> ScenarioSet:
    """All scenarios of `crossings`."""
    return find_scenarios(recordings, source="crossings", dt_s=0.2, history=15)


def _regrets(
    recordings: Recordings, scenarios: ScenarioSet, states: LoggedStates, *names: str
) -> dict[str, np.ndarray]:
    return regrets_at(
        states,
        scenarios,
        {name: load_predictor(name, horizon=15, dt_s=0.2) for name in names},
        load_candidate_planner("sampling"),
        scenes=recordings,
        recorded=recordings,
        horizon=15,
    )


def test_states_are_three_ticks_apart(scenarios: ScenarioSet) -> None:
    """A scenario of 75 ticks has 25 states, one of 76 has 26; the last tick has no next one."""
    states = logged_states(scenarios)
    for number, scenario in enumerate(scenarios):
        own = states.tick[states.scenario == number]
        end = scenario.start_tick + scenario.length
        assert own.tolist() == list(range(scenario.start_tick, end, 3))


def test_fewer_states_are_evenly_spaced(scenarios: ScenarioSet) -> None:
    every, few = logged_states(scenarios), logged_states(scenarios, 5)
    rows = [round(share * (len(every) - 1) / 4) for share in range(5)]
    assert few.tick.tolist() == every.tick[rows].tolist()
    assert few.scenario.tolist() == every.scenario[rows].tolist()
    with pytest.raises(AspEnvError, match="0 states: expected at least 1"):
        logged_states(scenarios, 0)


def test_the_oracle_has_no_regret_and_constant_velocity_has(
    recordings: Recordings, scenarios: ScenarioSet
) -> None:
    found = _regrets(recordings, scenarios, logged_states(scenarios), *NAMES)
    assert (found["oracle"] == 0).all()
    assert min(each.min() for each in found.values()) >= 0
    assert found["constant-velocity"].mean() > found["blend:0.5"].mean() > 0


def test_batches_change_no_bit(
    recordings: Recordings, scenarios: ScenarioSet, monkeypatch: pytest.MonkeyPatch
) -> None:
    states = logged_states(scenarios, 30)
    before = _regrets(recordings, scenarios, states, *NAMES)
    monkeypatch.setattr(regret, "BATCH", 7)
    after = _regrets(recordings, scenarios, states, *NAMES)
    for name in NAMES:
        assert after[name].tobytes() == before[name].tobytes()


def test_a_stop_that_is_not_forecast_costs_a_collision(tmp_path: Path) -> None:
    """The leader, 12 m ahead at 10 m/s, brakes at 5 m/s²; constant velocity does not foresee it.

    A collision costs 50 to 100, all else a few. Once both stand, constant velocity is right.
    """
    brakes = car(-60, 10, (4.2, 0.0, 0.0), (2.0, -5.0, 0.0))
    follows = car(-76.5, 10, (4.4, 0.0, 0.0), (2.0, -5.0, 0.0), (4.0, 0, 0), (5, 1.5, 0))
    recordings = open_data(write_crossing(tmp_path, drives=((follows, brakes),), seconds=16.0))
    scenarios = find_scenarios(recordings, source="", dt_s=0.2, history=15)
    ego = np.flatnonzero(scenarios.ego_id == 1)[:1]
    at = LoggedStates(scenario=ego, tick=np.array([21]))
    found = _regrets(recordings, scenarios, at, "constant-velocity", "blind")
    assert min(found["constant-velocity"][0], found["blind"][0]) > 30
    later = LoggedStates(scenario=ego, tick=np.array([45]))  # both stand
    assert _regrets(recordings, scenarios, later, "constant-velocity")["constant-velocity"][0] < 1


def test_estimates_by_hand() -> None:
    """Mean regrets 1 and 2: half is removed; ln(1 + 0) and ln(1 + 2) have a mean of 0.549."""
    scores = RegretScores(
        regrets={"x": np.array([0.0, 2.0]), "constant-velocity": np.array([4.0, 0.0])},
        subsets={"all": np.ones(2, dtype=bool), "left": np.array([False, True])},
        recording=np.array([0, 0]),
    )
    found = {each[:2]: each[2] for each in scores.estimates("x")}
    assert found["all", "regret"].value == 1.0
    assert found["all", "log1p regret"].value == pytest.approx(0.5 * np.log(3))
    assert found["all", "regret removed"].value == 0.5
    assert ("left", "regret removed") not in found  # constant velocity has none there
    assert found["left", "regret"].value == 2.0
    reference = {each[:2]: each[2] for each in scores.estimates("constant-velocity")}
    assert ("all", "regret removed") not in reference


def test_evaluate_measures_regret(
    crossings: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Constant velocity is the reference without being named; rows are by tag of the scenario."""
    out = tmp_path / "out"
    Evaluate(data=str(crossings), out=out, predictors=("oracle", "blend:0.5"), max_states=60).run()
    with (out / "metrics.csv").open(newline="") as file:
        rows = {
            (row["predictor"], row["subset"], row["metric"]): row for row in csv.DictReader(file)
        }
    oracle = rows["oracle", "all", "regret removed"]
    assert (oracle["value"], oracle["low"], oracle["high"], oracle["n"]) == ("1", "1", "1", "60")
    assert (oracle["planner"], oracle["selection"]) == ("", "")
    assert 0 < float(rows["blend:0.5", "all", "regret removed"]["value"]) < 1
    assert ("oracle", "straight", "regret") in rows
    assert not any(name == "constant-velocity" for name, _, _ in rows)
    printed = capsys.readouterr().out
    assert "planning regret, sampling, all scenarios" in printed
    assert "Regret removed" in (out / "report.html").read_text()


@pytest.mark.parametrize("planner", ["none", ""])
def test_evaluate_without_a_planner(crossings: Path, planner: str) -> None:
    result = evaluate(Evaluate(data=str(crossings), out=NOWHERE, planner=planner))
    assert not any("regret" in row.metric for row in result.rows)
    assert result.manifest["planner"] == "none"
    assert result.manifest["states"] == 0


def test_planners_without_candidates_are_refused(crossings: Path) -> None:
    with pytest.raises(AspEnvError, match="planner 'idm': does not choose from candidates"):
        evaluate(Evaluate(data=str(crossings), out=NOWHERE, planner="idm"))


def test_causal_histories_are_compared_with_the_recorded_truth(crossings: Path) -> None:
    """The oracle forecasts from filtered states and is still the truth."""
    for history in ("recorded", "causal"):
        result = evaluate(
            Evaluate(
                data=str(crossings), out=NOWHERE, predictors=("oracle",), history=history,
                max_states=40,
            )
        )  # fmt: skip
        values = [row.value for row in result.rows if row.metric == "regret"]
        assert values
        assert set(values) == {0.0}
