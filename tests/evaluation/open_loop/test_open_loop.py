"""`asp-env evaluate` on data whose metrics are known."""

import csv
from pathlib import Path

import numpy as np
import pytest

from asp_env.data.classes import AgentClass
from asp_env.errors import AspEnvError
from asp_env.evaluation.open_loop.evaluate import Evaluate, evaluate
from asp_env.evaluation.results import Row
from asp_env.evaluation.selection import load_predictors
from predictors.physical import ConstantVelocity
from tests.builders import Drive
from tests.crossing_files import write_crossing
from tests.sim.worlds import car

NOWHERE = Path("not-written")


def _evaluate(data: Path, *predictors: str, **options) -> dict[tuple[str, ...], Row]:
    result = evaluate(Evaluate(data=str(data), out=NOWHERE, predictors=predictors, **options))
    return {(r.predictor, r.selection, r.subset, r.metric): r for r in result.rows}


def test_constant_velocity_has_no_error_at_constant_velocity(tmp_path):
    """Two cars drive straight on at 8 and 11 m/s: every error is zero to 2 mm.

    The NLL is that of a Gaussian of 1 m at its centre, log 2π. One recording gives no interval.
    """
    westward = Drive(kind=AgentClass.CAR, start=(95.0, 1.75, np.pi, 11.0))
    write_crossing(tmp_path, drives=((car(-95, 8), westward),), seconds=14.0)
    rows = _evaluate(tmp_path, "constant-velocity", "constant-turn-rate")
    errors = {key: row for key, row in rows.items() if key[3] != "FDE / constant velocity"}
    assert {key[0] for key in errors} == {"constant-velocity", "constant-turn-rate"}
    for key, row in errors.items():
        # brier-FDE adds (1 - p)², and p is 1
        exact = np.log(2 * np.pi) if key[3] == "NLL" else 0.0
        assert row.value == pytest.approx(exact, abs=2e-3), key
        assert (row.low, row.high) == (None, None)


def test_constant_acceleration_by_hand(tmp_path):
    """At 0.5 m/s² the forecast is ¼t² metres short after t seconds: FDE is 2.25 m after 3 s.

    ADE is ¼ · 0.04 · (1² + … + 15²)/15 = 0.8267 m, MAE half of it (y has no error), MSE
    1/2 · (¼ · 0.04)² · (1⁴ + … + 15⁴)/15 = 0.5941 m², and every target is missed by over 2 m.
    """
    recording = (car(-90, 5, (20.0, 0.5, 0.0)),)
    write_crossing(tmp_path, drives=(recording, recording), seconds=12.0)
    rows = _evaluate(tmp_path, "constant-velocity")
    expected = {"FDE": 2.25, "ADE": 0.82667, "MAE": 0.41333, "MSE": 0.59411, "miss": 1.0}
    for selection in ("most-probable", "best-of-3"):
        for metric, value in expected.items():
            row = rows["constant-velocity", selection, "all", metric]
            assert row.value == pytest.approx(value, abs=2e-3), metric
            # ticks 15, 18, …, 45 of two equal recordings
            assert row.n == 2 * 11
            assert row.low == pytest.approx(value, abs=2e-3)


def test_the_oracle_has_no_error(crossings):
    """All errors are zero, and so is the ratio to constant velocity, whose errors are not."""
    rows = _evaluate(crossings, "constant-velocity", "oracle")
    for selection in ("most-probable", "best-of-3"):
        for metric in ("MAE", "MSE", "ADE", "FDE", "miss"):
            assert rows["oracle", selection, "all", metric].value == 0.0
        ratio = rows["oracle", selection, "moving", "FDE / constant velocity"]
        assert (ratio.value, ratio.low, ratio.high) == (0.0, 0.0, 0.0)
        assert rows["constant-velocity", selection, "all", "FDE"].value > 0.1


def test_delays_by_hand(tmp_path):
    """At 0.5 m/s², 0.4 s late: ¼ · 3.4² m short at constant velocity, 2.89 m after 3 s.

    With `delayed:14:constant-turn-rate`, which needs 17 ticks of history, all predictors are
    compared on the targets that have them: at ticks 18, 21, …, 45, one fewer than without.
    """
    recording = (car(-90, 5, (20.0, 0.5, 0.0)),)
    write_crossing(tmp_path, drives=(recording, recording), seconds=12.0)
    late = ("delayed:2:constant-velocity", "delayed:14:constant-turn-rate")
    for predictors, count in ((late[:1], 11), (late, 10)):
        rows = _evaluate(tmp_path, *predictors)
        for name, error_m in zip(predictors, (2.89, 0.25 * 5.8**2), strict=False):
            row = rows[name, "most-probable", "all", "FDE"]
            assert row.value == pytest.approx(error_m, abs=5e-3)
            assert row.n == 2 * count


def test_standing_targets_are_not_in_the_moving_subset(tmp_path):
    """One car drives, the other one waits all the time."""
    waiting = car(30, 0, y_m=1.75, appears_s=0.2)
    write_crossing(tmp_path, drives=((car(-95, 8), waiting),), seconds=14.0)
    rows = _evaluate(tmp_path, "constant-velocity")
    both = rows["constant-velocity", "best-of-3", "all", "FDE"].n
    moving = rows["constant-velocity", "best-of-3", "moving", "FDE"].n
    # ticks 15, 18, …, 54, but 18, 21, …, 54 for the car that appears a tick later
    assert (both, moving) == (14 + 13, 14)


def test_the_manifest_states_the_data_and_the_rule(crossings, recordings):
    manifest = evaluate(Evaluate(data=str(crossings), out=NOWHERE)).manifest
    assert manifest["data_hash"] == recordings.data_hash()
    assert manifest["recordings"] == 3
    assert manifest["part"] == "all, of which no predictor saw any"
    assert manifest["snippets"] > manifest["moving snippets"] > 50
    assert manifest["predictors"] == {"constant-velocity": {}, "constant-turn-rate": {}}
    assert manifest["privileged"] == []
    assert manifest["best_by"] == "fde"
    other = evaluate(Evaluate(data=str(crossings), out=NOWHERE, best_by="paper")).manifest
    assert other["best_by"] == "paper"
    assert "within 5°" in other["best-of-3"]


def test_running_twice_gives_the_same_bits(crossings):
    """Also the intervals are equal."""
    assert _evaluate(crossings, "constant-turn-rate") == _evaluate(crossings, "constant-turn-rate")


def test_a_run_writes_its_folder(crossings, tmp_path, capsys):
    """It contains three files, and a table is printed."""
    out = tmp_path / "out"
    Evaluate(data=str(crossings), out=out, predictors=("constant-velocity",)).run()
    assert {path.name for path in out.iterdir()} == {"metrics.csv", "manifest.json", "report.html"}
    with (out / "metrics.csv").open(newline="") as file:
        assert {row["predictor"] for row in csv.DictReader(file)} == {"constant-velocity"}
    assert "constant-velocity" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("names", "what"),
    [
        ((), "none given"),
        (("oracle", "oracle"), "oracle is named 2 times"),
        (("orcale",), r"unknown predictor 'orcale' \(did you mean 'oracle'"),
        (("oracle:run",), "takes no argument"),
    ],
)
def test_wrong_predictor_names_are_errors_of_one_line(names, what):
    with pytest.raises(AspEnvError, match=what) as caught:
        load_predictors(names, horizon=15, dt_s=0.2)
    assert "\n" not in str(caught.value)


def test_a_predictor_with_a_shorter_horizon_is_an_error(monkeypatch):
    short = ConstantVelocity(horizon=10, dt_s=0.2)
    loader = "asp_env.evaluation.selection.load_predictor"
    monkeypatch.setattr(loader, lambda *_, **__: short)
    with pytest.raises(AspEnvError, match="forecasts 2 s, less than --horizon 3"):
        load_predictors(["short"], horizon=15, dt_s=0.2)


def test_a_horizon_that_is_no_whole_number_of_ticks_is_an_error(crossings):
    with pytest.raises(AspEnvError, match="no whole number of ticks"):
        _evaluate(crossings, "oracle", horizon=3.1)


def test_data_without_snippets_are_an_error(tmp_path):
    """Three seconds are shorter than 0.6 s of history, the least, and a horizon of 3 s."""
    write_crossing(tmp_path, drives=((car(-90, 5),),), seconds=3.0)
    with pytest.raises(AspEnvError, match=r"no recording lasts 3\.6 s, for 0\.6 s of history"):
        _evaluate(tmp_path, "oracle")


PARKED = Drive(kind=AgentClass.CAR, start=(25.0, -6.0, 0.0, 0.0))


@pytest.mark.parametrize("parked", [False, True])
def test_parked_vehicles_count_if_asked_for(tmp_path, parked):
    """Both cars are there for ticks 0 to 70 and have snippets at 15, 18, …, 54: 14 each."""
    write_crossing(tmp_path, drives=((car(-95, 8), PARKED),), seconds=14.0)
    result = evaluate(
        Evaluate(
            data=str(tmp_path),
            out=NOWHERE,
            predictors=("constant-velocity",),
            planner="none",
            parked=parked,
        )
    )
    counts = {row.subset: row.n for row in result.rows if row.metric == "FDE"}
    assert counts["moving"] == 14
    assert counts["all"] == 14 + 14 * parked
    assert counts.get("standing", 0) == 14 * parked
    assert result.manifest["parked"] is parked
    assert result.manifest["snippets"] == counts["all"]
