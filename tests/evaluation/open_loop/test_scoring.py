"""Metrics of every snippet: ground truth, subsets, metrics by hand, and batches."""

import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np
import pytest

from asp_env.data.classes import AgentClass
from asp_env.data.predictor import Forecast, make_forecast
from asp_env.data.recording import Recording
from asp_env.data.road_map import Ragged
from asp_env.data.scene import Scene
from asp_env.data.snippets import Future, SnippetIndex, gather_future, gather_scene, index_snippets
from asp_env.errors import AspEnvError
from asp_env.evaluation.open_loop import scoring
from asp_env.evaluation.open_loop.evaluate import make_rows
from asp_env.evaluation.open_loop.ground_truth import gather_ground_truth
from asp_env.evaluation.open_loop.scoring import (
    ForecastHistory,
    ForecastScores,
    MetricValues,
    score_forecasts,
)
from predictors.physical import ConstantVelocity, Oracle
from tests.builders import Drive, make_map, make_recording
from tests.evaluation.runs import forked
from tests.sim.worlds import car

HORIZON, DT_S = 15, 0.2
CV = ConstantVelocity(horizon=HORIZON, dt_s=DT_S)
ORACLE = Oracle(horizon=HORIZON, dt_s=DT_S)


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class Forks:
    """A predictor of three modes of 60, 25 and 15 %: straight on, and bent to either side."""

    name: str = "forks"
    privileged: bool = False
    dt_s: float = DT_S
    history: int = 0
    horizon: int = HORIZON
    trained_on: None = None
    metadata: Mapping[str, str] = dataclasses.field(default_factory=dict)

    def predict(self, scene: Scene, future: Future | None = None) -> Forecast:
        del future
        return forked(scene, steps=self.horizon, bend=1.0)


def index_of(*recordings: Recording) -> SnippetIndex:
    """All snippets with a history and a horizon of 3 s."""
    return index_snippets(recordings, dt_s=DT_S, horizon_s=3.0)


def score(
    *recordings: Recording, scenes: tuple[Recording, ...] | None = None, **predictors: Any
) -> ForecastScores:
    """Scores of predictors on all snippets."""
    return score_forecasts(
        predictors, index_of(*recordings), scenes=scenes or recordings, recorded=recordings
    )


@pytest.fixture(scope="module")
def scores() -> ForecastScores:
    """Three predictors on two recordings of the synthetic crossing."""
    recordings = (make_recording(), make_recording(seed=1))
    return score(*recordings, cv=CV, oracle=ORACLE, forks=Forks())


def test_ground_truth_agrees_with_scenes_and_futures() -> None:
    """Past, future, sizes, classes and maps are those of the targets of the scene."""
    recordings = [make_recording(), make_recording(seed=1)]
    index = index_of(*recordings)
    scene, future = gather_scene(recordings, index), gather_future(recordings, index)
    truth = gather_ground_truth(recordings, index)
    targets = (scene.targets[:, 0], scene.targets[:, 1])
    np.testing.assert_array_equal(truth.states[:, : index.history + 1], scene.states[targets])
    np.testing.assert_array_equal(truth.present, scene.target_states)
    np.testing.assert_array_equal(truth.future.states, future.states)
    np.testing.assert_array_equal(truth.future.valid, future.valid)
    np.testing.assert_array_equal(truth.sizes, scene.sizes[targets])
    np.testing.assert_array_equal(truth.classes, scene.classes[targets])
    np.testing.assert_array_equal(truth.situation, scene.targets[:, 0])
    assert all(
        truth.maps[m] is scene.maps[scene.map_index[s]]
        for m, s in zip(truth.map_index, truth.situation, strict=True)
    )
    np.testing.assert_array_equal(truth.agents[truth.situation, truth.slot], future.states)


def test_ground_truth_contains_agents_that_appear_later() -> None:
    """An agent that appears a second after the present is not in the scene."""
    recording = make_recording(drives=(car(-90, 5), car(50, 0, appears_s=4.0)), duration_s=6.2)
    index = index_of(recording)
    assert index.tick.tolist() == [15]
    truth = gather_ground_truth([recording], index)
    assert gather_scene([recording], index).ids.tolist() == [[1]]
    assert truth.agents_valid[0].sum(axis=1).tolist() == [15, 11]
    assert truth.slot.tolist() == [0]


def valid(column: MetricValues) -> np.ndarray:
    return column.values[column.valid]


def test_the_recorded_future_violates_no_rule(scores: ForecastScores) -> None:
    """The oracle has no error, is never off the road, never overlaps, and is consistent."""
    for metric in ("off-road", "overlap"):
        for selection in ("", "most-probable", "best-of-3"):
            values = valid(scores.of("oracle", metric, selection))
            assert len(values)
            assert not values.any()
    inconsistency = valid(scores.of("oracle", "inconsistency", "most-probable"))
    assert inconsistency == pytest.approx(0, abs=1e-4)
    assert not scores.of("oracle", "FDE", "best-of-3").values.any()


def test_rates_lie_between_zero_and_one(scores: ForecastScores) -> None:
    """Rates of all modes are means of flags, those of one mode are flags."""
    for each in scores.metrics:
        if each.metric in ("off-road", "overlap", "infeasible", "miss"):
            values = valid(each)
            assert ((values >= 0) & (values <= 1)).all()
            if each.selection:
                assert set(np.unique(values)) <= {0.0, 1.0}


def test_every_target_is_in_one_subset_of_each_kind(scores: ForecastScores) -> None:
    """Moving or standing, one of the manoeuvres, one of the classes."""
    subsets = scores.subsets
    assert subsets["all"].all()
    np.testing.assert_array_equal(subsets["moving"], ~subsets["standing"])
    np.testing.assert_array_equal(subsets["standing"], subsets["manoeuvre:standing"])
    for prefix in ("manoeuvre:", "class:"):
        members = [member for name, member in subsets.items() if name.startswith(prefix)]
        assert all(member.any() for member in members)
        np.testing.assert_array_equal(np.sum(members, axis=0), 1)
    assert {"class:car", "class:van", "class:motorcycle", "manoeuvre:left"} <= set(subsets)


def test_scenes_may_differ_from_the_ground_truth() -> None:
    """Histories 1 m to the left of the recorded ones: every error is 1 m, subsets stay the same.

    Two cars drive at constant speed along x; the forecast starts from the shifted state.
    """
    westward = Drive(kind=AgentClass.CAR, start=(95.0, 1.75, np.pi, 11.0))
    recording = make_recording(drives=(car(-95, 8), westward), duration_s=14.0)
    states = recording.states + np.array([0, 1, 0, 0], dtype=np.float32)
    observed = dataclasses.replace(recording, states=states)
    exact, shifted = score(recording, cv=CV), score(recording, scenes=(observed,), cv=CV)
    for metric in ("ADE", "FDE"):
        assert shifted.of("cv", metric, "most-probable").values == pytest.approx(1.0, abs=1e-4)
        assert exact.of("cv", metric, "most-probable").values == pytest.approx(0, abs=1e-4)
    for name, member in exact.subsets.items():
        np.testing.assert_array_equal(shifted.subsets[name], member)


def test_targets_that_leave_the_road_have_no_off_road_rate() -> None:
    """A car on the road counts; one that drives beside it, or on a map without area, does not."""
    beside = car(-80, 5, y_m=8.0)
    scores = score(make_recording(drives=(car(-90, 5), beside), duration_s=12.0), cv=CV)
    off_road = scores.of("cv", "off-road", "most-probable")
    assert off_road.valid.tolist() == [True, False] * (len(off_road.valid) // 2)
    assert not valid(off_road).any()
    empty = dataclasses.replace(make_map(), drivable=Ragged.pack([]))
    without_area = make_recording(drives=(car(-90, 5),), duration_s=12.0, road_map=empty)
    assert not score(without_area, cv=CV).of("cv", "off-road", "").valid.any()


def test_a_forecast_into_the_agent_ahead_overlaps() -> None:
    """A car at 10 m/s brakes with 2.5 m/s² from now on, 25 m behind a waiting one.

    It stops after 20 m; at constant velocity it reaches the rear of the waiting car within 30 m.
    """
    braking = car(-60, 10, (3.0, 0.0, 0.0), (4.0, -2.5, 0.0))
    waiting = car(-5.0, 0, appears_s=0.2)
    scores = score(make_recording(drives=(braking, waiting), duration_s=8.0), cv=CV, oracle=ORACLE)
    assert scores.of("cv", "overlap", "most-probable").values[0] == 1.0
    assert scores.of("oracle", "overlap", "most-probable").values[0] == 0.0


def test_metrics_of_several_modes_by_hand() -> None:
    """Modes end 0 and ±2.25 m beside a car in a lane of 3.5 m, 1.75 m right of the road's middle.

    The right one is 0.5 m off the road: a third of all modes, but neither the most probable nor
    the best one. In the density of the true end, the outer modes have a weight of
    exp(-2.25² / 2).
    """
    scores = score(make_recording(drives=(car(-99, 8),), duration_s=11.0), forks=Forks())
    assert scores.of("forks", "off-road", "").values == pytest.approx(1 / 3)
    for selection in ("most-probable", "best-of-3"):
        assert not scores.of("forks", "off-road", selection).values.any()
    density = 0.6 + 0.4 * np.exp(-(2.25**2) / 2)
    expected = np.log(2 * np.pi) - np.log(density)
    assert scores.of("forks", "NLL", "").values == pytest.approx(expected, abs=1e-3)
    assert scores.of("forks", "Brier", "").values == pytest.approx(0.4**2 + 0.25**2 + 0.15**2)
    rows = make_rows(scores, {"forks": Forks()}, {"forks": ["forks"]}, data="d", horizon_s=3.0)
    (ece,) = [row for row in rows if (row.metric, row.subset) == ("ECE", "moving")]
    # Three bins of a third of all modes each: |0.6 - 1|, |0.25 - 0| and |0.15 - 0|.
    assert ece.value == pytest.approx((0.4 + 0.25 + 0.15) / 3, abs=1e-6)
    assert ece.selection == ""


def test_each_mode_rule_minimizes_its_error(scores: ForecastScores) -> None:
    """On every snippet no other rule has a lower FDE than `fde`, or a lower ADE than `ade`."""
    recordings = (make_recording(), make_recording(seed=1))
    by: dict[str, ForecastScores] = {"fde": scores}
    for rule in ("ade", "paper"):
        by[rule] = score_forecasts(
            {"forks": Forks()},
            index_of(*recordings),
            scenes=recordings,
            recorded=recordings,
            best_by=rule,
        )
    for metric, best in (("FDE", "fde"), ("ADE", "ade")):
        lowest = by[best].of("forks", metric, "best-of-3").values
        others = [by[rule].of("forks", metric, "best-of-3").values for rule in by if rule != best]
        assert all((lowest <= other).all() for other in others)
        assert any((lowest < other).any() for other in others)


def test_one_mode_has_no_calibration(scores: ForecastScores) -> None:
    """Only the predictor of several modes has a Brier score and an ECE."""
    assert [each.name for each in scores.modes] == ["forks"]
    assert not scores.of("cv", "Brier", "").valid.any()
    assert scores.of("forks", "Brier", "").valid.all()


def test_batch_size_changes_nothing(
    scores: ForecastScores, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Seven snippets at a time give the same bits, also of the inconsistency across batches."""
    monkeypatch.setattr(scoring, "BATCH", 7)
    recordings = (make_recording(), make_recording(seed=1))
    again = score(*recordings, cv=CV, oracle=ORACLE, forks=Forks())
    assert scores.of("cv", "inconsistency", "most-probable").valid.any()
    for one, other in zip(scores.metrics, again.metrics, strict=True):
        np.testing.assert_array_equal(one.values, other.values)
        np.testing.assert_array_equal(one.valid, other.valid)


def test_inconsistency_by_hand() -> None:
    """At a constant acceleration of 0.5 m/s² the speed is 0.3 m/s higher after 0.6 s.

    At a time t after the later forecast, the two forecasts are 0.3 t + ½ · 0.5 · 0.6² m apart; on
    average over t = 0.2 … 2.4 s: 0.3 · 1.3 + 0.09 = 0.48 m. The first snippet has no earlier one.
    """
    accelerating = car(-90, 5, (20.0, 0.5, 0.0))
    scores = score(make_recording(drives=(accelerating,), duration_s=12.0), cv=CV)
    inconsistency = scores.of("cv", "inconsistency", "most-probable")
    assert inconsistency.valid.tolist() == [False] + [True] * 10
    assert inconsistency.values[1:] == pytest.approx(0.48, abs=5e-3)


def test_earlier_forecasts_are_stored_as_long_as_needed() -> None:
    """Rows of tracks 0 and 1 at ticks 0 and 3, and of track 1 at 6; a gap ends a chain."""
    index = SnippetIndex(
        recording=np.zeros(6, dtype=np.int64),
        track=np.array([0, 1, 0, 1, 1, 0]),
        tick=np.array([0, 0, 3, 3, 6, 9]),
        dt_s=DT_S,
        history=15,
        horizon_ticks=15,
    )
    history = ForecastHistory(index)
    assert history.apart_ticks == 3
    positions = np.arange(6.0)[:, None, None] * np.ones((6, 2, 2))
    before, paired = history.update("cv", slice(0, 3), positions[:3])
    assert paired.tolist() == [False, False, True]
    assert before[2].max() == 0.0
    before, paired = history.update("cv", slice(3, 6), positions[3:])
    assert paired.tolist() == [True, True, False]
    assert before[:2, 0, 0].tolist() == [1.0, 3.0]
    assert all(len(stored) == 0 for _, stored in history._stored.values())


def test_an_unknown_metric_is_an_error(scores: ForecastScores) -> None:
    with pytest.raises(AspEnvError, match="cv: no metric 'PDM' of all modes was computed"):
        scores.of("cv", "PDM", "")


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class Silent(Forks):
    """A predictor that omits all targets."""

    def predict(self, scene: Scene, future: Future | None = None) -> Forecast:
        del future
        targets = len(scene.targets)
        return make_forecast(
            scene,
            states=np.zeros((targets, 1, self.horizon, 4), dtype=np.float32),
            actions=None,
            log_probs=np.zeros((targets, 1), dtype=np.float32),
            valid=np.zeros(targets, dtype=bool),
        )


def test_incomplete_forecasts_are_errors() -> None:
    """Otherwise tables would compare predictors on different targets."""
    with pytest.raises(AspEnvError, match="forks omits targets"):
        score(make_recording(), silent=Silent())
    with pytest.raises(AspEnvError, match="forecasts less than 15 ticks"):
        score(make_recording(), short=ConstantVelocity(horizon=10, dt_s=DT_S))
