"""Every snippet's metrics: what they are judged by, who is in which subset, what bounds memory."""

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
from asp_env.evaluation.open_loop import judging
from asp_env.evaluation.open_loop.evaluate import rows_of
from asp_env.evaluation.open_loop.judging import (
    ForecastHistory,
    Judgement,
    gather_ground_truth,
    judge,
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
    """Three modes, 60, 25 and 15 %: straight on, and bending away to either side."""

    name: str = "forks"
    privileged: bool = False
    dt_s: float = DT_S
    history: int = 0
    horizon: int = HORIZON
    trained_on: None = None
    metadata: Mapping[str, str] = dataclasses.field(default_factory=dict)

    def predict(self, scene: Scene, future: Future | None = None) -> Forecast:
        """Reads no future."""
        del future
        return forked(scene, steps=self.horizon, bend=1.0)


def index_of(*recordings: Recording) -> SnippetIndex:
    """All snippets of 3 s and 3 s."""
    return index_snippets(recordings, dt_s=DT_S, horizon_s=3.0)


def judged(*recordings: Recording, scenes: tuple[Recording, ...] | None = None, **predictors: Any):
    """What is found out about predictors on all snippets."""
    return judge(
        predictors, index_of(*recordings), scenes=scenes or recordings, recorded=recordings
    )


@pytest.fixture(scope="module")
def found() -> Judgement:
    """Three predictors on the made-up crossing, twice."""
    recordings = (make_recording(), make_recording(seed=1))
    return judged(*recordings, cv=CV, oracle=ORACLE, forks=Forks())


def test_recorded_agrees_with_scenes_and_futures() -> None:
    """Past, future, sizes, classes and maps are those of the scene's targets."""
    recordings = [make_recording(), make_recording(seed=1)]
    index = index_of(*recordings)
    scene, future = gather_scene(recordings, index), gather_future(recordings, index)
    recorded = gather_ground_truth(recordings, index)
    at = (scene.targets[:, 0], scene.targets[:, 1])
    np.testing.assert_array_equal(recorded.states[:, : index.history + 1], scene.states[at])
    np.testing.assert_array_equal(recorded.present, scene.target_states)
    np.testing.assert_array_equal(recorded.future.states, future.states)
    np.testing.assert_array_equal(recorded.future.valid, future.valid)
    np.testing.assert_array_equal(recorded.sizes, scene.sizes[at])
    np.testing.assert_array_equal(recorded.classes, scene.classes[at])
    np.testing.assert_array_equal(recorded.situation, scene.targets[:, 0])
    assert all(
        recorded.maps[m] is scene.maps[scene.map_index[s]]
        for m, s in zip(recorded.map_index, recorded.situation, strict=True)
    )
    np.testing.assert_array_equal(recorded.others[recorded.situation, recorded.slot], future.states)


def test_others_count_whenever_they_come() -> None:
    """Somebody who appears a second after now is not in the scene, but in what was recorded."""
    recording = make_recording(drives=(car(-90, 5), car(50, 0, appears_s=4.0)), duration_s=6.2)
    index = index_of(recording)
    assert index.tick.tolist() == [15]
    recorded = gather_ground_truth([recording], index)
    assert gather_scene([recording], index).ids.tolist() == [[1]]
    assert recorded.others_valid[0].sum(axis=1).tolist() == [15, 11]
    assert recorded.slot.tolist() == [0]


def test_the_recorded_future_breaks_no_rule(found: Judgement) -> None:
    """The oracle: no error, never off the road, over anybody, or at odds with itself."""
    for metric in ("off-road", "overlap"):
        for selection in ("", "most-probable", "best-of-3"):
            each = found.of("oracle", metric, selection)
            assert each.valid.any()
            assert not each.values[each.valid].any()
    same = found.of("oracle", "inconsistency", "most-probable")
    assert same.values[same.valid] == pytest.approx(0, abs=1e-4)
    assert not found.of("oracle", "FDE", "best-of-3").values.any()


def test_shares_lie_between_zero_and_one(found: Judgement) -> None:
    """Rates of all modes are means of flags, those of one mode are flags."""
    for each in found.judged:
        if each.metric in ("off-road", "overlap", "infeasible", "miss"):
            value = each.values[each.valid]
            assert ((value >= 0) & (value <= 1)).all()
            if each.selection:
                assert set(np.unique(value)) <= {0.0, 1.0}


def test_subsets_part_everybody(found: Judgement) -> None:
    """Moving and standing, the manoeuvres, and the classes: each target is in one of each."""
    subsets = found.subsets
    assert subsets["all"].all()
    np.testing.assert_array_equal(subsets["moving"], ~subsets["standing"])
    np.testing.assert_array_equal(subsets["standing"], subsets["manoeuvre:standing"])
    for prefix in ("manoeuvre:", "class:"):
        members = [member for name, member in subsets.items() if name.startswith(prefix)]
        assert all(member.any() for member in members)
        np.testing.assert_array_equal(np.sum(members, axis=0), 1)
    assert {"class:car", "class:van", "class:motorcycle", "manoeuvre:left"} <= set(subsets)


def test_scenes_may_come_from_elsewhere() -> None:
    """Histories 1 m to the left of what was recorded: every error is 1 m, subsets stay.

    Two cars at steady speed along x; the forecast starts from the shifted state.
    """
    westward = Drive(kind=AgentClass.CAR, start=(95.0, 1.75, np.pi, 11.0))
    recording = make_recording(drives=(car(-95, 8), westward), duration_s=14.0)
    aside = recording.states + np.array([0, 1, 0, 0], dtype=np.float32)
    seen = dataclasses.replace(recording, states=aside)
    straight, shifted = judged(recording, cv=CV), judged(recording, scenes=(seen,), cv=CV)
    for metric in ("ADE", "FDE"):
        each = shifted.of("cv", metric, "most-probable")
        assert each.values == pytest.approx(1.0, abs=1e-4)
        assert straight.of("cv", metric, "most-probable").values == pytest.approx(0, abs=1e-4)
    for name, member in straight.subsets.items():
        np.testing.assert_array_equal(shifted.subsets[name], member)


def test_who_leaves_the_road_has_no_off_road_rate() -> None:
    """A car along the road counts; one that drives beside it, or on a map without area, does not.

    The one whose forecast goes straight on where the road along y ends is off it.
    """
    beside = car(-80, 5, y_m=8.0)
    found = judged(make_recording(drives=(car(-90, 5), beside), duration_s=12.0), cv=CV)
    each = found.of("cv", "off-road", "most-probable")
    assert each.valid.tolist() == [True, False] * (len(each.valid) // 2)
    assert not each.values[each.valid].any()
    empty = dataclasses.replace(make_map(), drivable=Ragged.pack([]))
    bare = make_recording(drives=(car(-90, 5),), duration_s=12.0, road_map=empty)
    each = judged(bare, cv=CV).of("cv", "off-road", "")
    assert not each.valid.any()


def test_a_forecast_into_the_one_ahead_overlaps() -> None:
    """A car at 10 m/s that brakes with 2.5 m/s² from now, 25 m behind one that waits.

    It halts 20 m on; constant velocity goes on for 30 m and meets the waiting car's rear.
    """
    braking = car(-60, 10, (3.0, 0.0, 0.0), (4.0, -2.5, 0.0))
    waiting = car(-5.0, 0, appears_s=0.2)
    found = judged(make_recording(drives=(braking, waiting), duration_s=8.0), cv=CV, oracle=ORACLE)
    assert found.of("cv", "overlap", "most-probable").values[0] == 1.0
    assert found.of("oracle", "overlap", "most-probable").values[0] == 0.0


def test_modes_are_counted_one_by_one() -> None:
    """Modes that end 2.25 m to either side of a road of 3.5 m, from 1.75 m right of its middle.

    The right one leaves it by 0.5 m: a third of all modes, but not the most probable, nor the best.
    The true end is 5.06 m² / 2 nearer to the middle one of 60 %.
    """
    found = judged(make_recording(drives=(car(-99, 8),), duration_s=11.0), forks=Forks())
    assert found.of("forks", "off-road", "").values == pytest.approx(1 / 3)
    for selection in ("most-probable", "best-of-3"):
        assert not found.of("forks", "off-road", selection).values.any()
    density = 0.6 + 0.4 * np.exp(-(2.25**2) / 2)
    expected = np.log(2 * np.pi) - np.log(density)
    assert found.of("forks", "NLL", "").values == pytest.approx(expected, abs=1e-3)
    assert found.of("forks", "Brier", "").values == pytest.approx(0.4**2 + 0.25**2 + 0.15**2)
    rows = rows_of(found, {"forks": Forks()}, data="d", horizon_s=3.0)
    (ece,) = [row for row in rows if (row.metric, row.subset) == ("ECE", "moving")]
    # three bins of a third of all modes each: |0.6 - 1|, |0.25 - 0| and |0.15 - 0|; the last two
    # are neighbours of one bin width and more, so nothing cancels
    assert ece.value == pytest.approx((0.4 + 0.25 + 0.15) / 3, abs=1e-6)
    assert ece.selection == ""


def test_each_rule_is_best_at_what_it_looks_at(found: Judgement) -> None:
    """Snippet by snippet no other rule has a lower FDE than `fde`, or a lower ADE than `ade`."""
    recordings = (make_recording(), make_recording(seed=1))
    by: dict[str, Judgement] = {"fde": found}
    for rule in ("ade", "paper"):
        by[rule] = judge(
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


def test_one_mode_has_no_calibration(found: Judgement) -> None:
    """Only the forks have a Brier score and an ECE."""
    assert [each.name for each in found.modes] == ["forks"]
    assert not found.of("cv", "Brier", "").valid.any()
    assert found.of("forks", "Brier", "").valid.all()


def test_batches_do_not_matter(found: Judgement, monkeypatch: pytest.MonkeyPatch) -> None:
    """Seven snippets at a time give the same bits, inconsistency across batches included."""
    monkeypatch.setattr(judging, "BATCH", 7)
    recordings = (make_recording(), make_recording(seed=1))
    again = judged(*recordings, cv=CV, oracle=ORACLE, forks=Forks())
    assert found.of("cv", "inconsistency", "most-probable").valid.any()
    for one, other in zip(found.judged, again.judged, strict=True):
        np.testing.assert_array_equal(one.values, other.values)
        np.testing.assert_array_equal(one.valid, other.valid)


def test_consecutive_forecasts_by_hand() -> None:
    """At constant acceleration a = 0.5 m/s², 0.6 s later the speed is 0.3 m/s higher.

    At a time t after the later forecast they are 0.3 t + ½ · 0.5 · 0.6² m apart, on average over
    t = 0.2 … 2.4 s: 0.3 · 1.3 + 0.09 = 0.48 m. The first snippet has no earlier one.
    """
    speeding = car(-90, 5, (20.0, 0.5, 0.0))
    found = judged(make_recording(drives=(speeding,), duration_s=12.0), cv=CV)
    each = found.of("cv", "inconsistency", "most-probable")
    assert each.valid.tolist() == [False] + [True] * 10
    assert each.values[1:] == pytest.approx(0.48, abs=5e-3)


def test_earlier_forecasts_are_kept_no_longer_than_needed() -> None:
    """Rows of tracks a and b at ticks 0 and 3, and of b at 6; a gap ends a chain."""
    index = SnippetIndex(
        recording=np.zeros(6, dtype=np.int64),
        track=np.array([0, 1, 0, 1, 1, 0]),
        tick=np.array([0, 0, 3, 3, 6, 9]),
        dt_s=DT_S,
        history=15,
        horizon_ticks=15,
    )
    earlier = ForecastHistory(index)
    assert earlier.apart == 3
    said = np.arange(6.0)[:, None, None] * np.ones((6, 2, 2))
    before, paired = earlier.exchange("cv", slice(0, 3), said[:3])
    assert paired.tolist() == [False, False, True]
    assert before[2].max() == 0.0
    before, paired = earlier.exchange("cv", slice(3, 6), said[3:])
    assert paired.tolist() == [True, True, False]
    assert before[:2, 0, 0].tolist() == [1.0, 3.0]
    assert all(len(kept) == 0 for _, kept in earlier._kept.values())


def test_what_was_not_judged_is_one_line(found: Judgement) -> None:
    """The name, the metric and the selection."""
    with pytest.raises(AspEnvError, match="cv: no metric 'PDM' of all modes was judged"):
        found.of("cv", "PDM", "")


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class Silent(Forks):
    """Says nothing of anybody."""

    def predict(self, scene: Scene, future: Future | None = None) -> Forecast:
        """Leaves all targets out."""
        del future
        states = np.zeros((len(scene.targets), 1, self.horizon, 4), dtype=np.float32)
        nobody = np.zeros(len(scene.targets), dtype=bool)
        sure = np.zeros((len(scene.targets), 1), dtype=np.float32)
        return make_forecast(scene, states=states, actions=None, log_probs=sure, valid=nobody)


def test_who_leaves_targets_out_is_refused() -> None:
    """Tables would compare different targets."""
    with pytest.raises(AspEnvError, match="forks leaves out targets"):
        judged(make_recording(), silent=Silent())
    with pytest.raises(AspEnvError, match="forecasts less than 15 ticks"):
        judged(make_recording(), short=ConstantVelocity(horizon=10, dt_s=DT_S))
