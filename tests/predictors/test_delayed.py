"""Delayed forecasts: those that another predictor made earlier."""

import dataclasses
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from asp_env.data.classes import AgentClass
from asp_env.data.predictor import Forecast, fill_missing, load_predictor
from asp_env.data.scene import Scene
from asp_env.data.snippets import (
    Future,
    SnippetIndex,
    gather_future,
    gather_scene,
    index_snippets,
)
from asp_env.errors import AspEnvError
from predictors.delayed import Delayed
from predictors.physical import ConstantVelocity
from tests.builders import Drive, make_recording
from tests.predictors.tiny import save_random

RECORDING = make_recording()
BRAKING = Drive(kind=AgentClass.CAR, start=(0.0, 0.0, 0.0, 16.0), phases=((600.0, -1.0, 0.0),))


def snippets(*, history: int = 20, horizon: int = 15) -> SnippetIndex:
    """All snippets of the recording."""
    return index_snippets([RECORDING], dt_s=0.2, horizon_s=0.2 * horizon, history_s=0.2 * history)


def both(index: SnippetIndex) -> tuple[Scene, Future]:
    """Scene and future."""
    return gather_scene([RECORDING], index), gather_future([RECORDING], index)


def predicted(name: str, scene: Scene, future: Future, *, horizon: int = 15) -> Forecast:
    """The forecast by a predictor of that name."""
    predictor = load_predictor(name, horizon=horizon, dt_s=0.2)
    return predictor.predict(scene, future if predictor.privileged else None)


def test_a_braking_car_seen_two_ticks_late() -> None:
    """At -1 m/s², 0.4 s ago it was 0.4 v + 0.08 m behind and drove at v + 0.4 m/s.

    At constant velocity it covers 3.4 (v + 0.4) m in 3.4 s: 3 s from now it is at 3 v + 1.28 m.
    """
    recordings = [make_recording(drives=(BRAKING,), duration_s=10.0)]
    index = index_snippets(recordings, dt_s=0.2, horizon_s=3.0)
    scene = gather_scene(recordings, index)
    forecast = load_predictor("delayed:2:constant-velocity", horizon=15, dt_s=0.2).predict(scene)
    x, v = scene.target_states[:, 0], scene.target_states[:, 3]
    np.testing.assert_allclose(forecast.states[:, 0, -1, 0], x + 3 * v + 1.28, atol=0.01)
    np.testing.assert_allclose(forecast.states[:, 0, :, 3], (v + 0.4)[:, None].repeat(15, 1), 1e-3)
    np.testing.assert_array_equal(forecast.tick, index.tick)
    assert not forecast.actions.any()


@pytest.mark.parametrize("kind", ["constant-turn-rate", "ffw-asp", "mtp"])
def test_it_is_the_forecast_of_the_earlier_scene(kind: str, tmp_path: Path) -> None:
    """Made from the scene three ticks earlier; of a trained predictor the first 12 of 15 ticks."""
    name, ticks = kind, 15
    if kind != "constant-turn-rate":
        save_random(tmp_path / "run", kind, "vectors", horizon=15, seed=0, preset="cpu")
        name, ticks = f"{kind}:{tmp_path / 'run'}", 12
    index = snippets()
    earlier = dataclasses.replace(index, tick=index.tick - 3, horizon_ticks=18)
    delayed = predicted(f"delayed:3:{name}", *both(index))
    before = predicted(name, *both(earlier), horizon=18)
    assert delayed.valid.all()
    shown = slice(3, 3 + ticks)
    np.testing.assert_allclose(delayed.states[:, :, :ticks], before.states[:, :, shown], atol=1e-4)
    np.testing.assert_allclose(delayed.log_probs, before.log_probs, atol=1e-5)
    np.testing.assert_array_equal(delayed.actions_valid, before.actions_valid)
    if kind != "mtp":
        found, expected = delayed.actions[:, :, :ticks], before.actions[:, :, shown]
        np.testing.assert_allclose(found, expected, atol=1e-4)


def test_a_fixed_horizon_is_continued_straight(tmp_path: Path) -> None:
    """Of 15 ticks, delayed by 3, the last three continue at the speed and heading of the 12th."""
    save_random(tmp_path / "run", "ffw-asp", "vectors", horizon=15, seed=0, preset="cpu")
    delayed = load_predictor(f"delayed:3:ffw-asp:{tmp_path / 'run'}", horizon=15, dt_s=0.2)
    assert (delayed.horizon, delayed.history) == (15, 18)
    assert delayed.trained_on is not None
    assert delayed.metadata["view"] == "vectors"
    states = delayed.predict(both(snippets())[0]).states.astype(np.float64)
    last = states[:, :, 11:12]
    np.testing.assert_array_equal(states[:, :, 12:, 2:], last[..., 2:].repeat(3, axis=2))
    ahead_m = last[..., 3] * 0.2 * np.array([1, 2, 3])
    expected = last[..., :2] + ahead_m[..., None] * np.stack(
        [np.cos(last[..., 2]), np.sin(last[..., 2])], axis=-1
    )
    np.testing.assert_allclose(states[:, :, 12:, :2], expected, atol=1e-4)


def test_a_shorter_horizon_than_asked_for_is_reported(tmp_path: Path) -> None:
    """A predictor of 3 s does not become one of 6 s."""
    save_random(tmp_path / "run", "ffw-asp", "vectors", horizon=15, seed=0, preset="cpu")
    delayed = load_predictor(f"delayed:3:ffw-asp:{tmp_path / 'run'}", horizon=30, dt_s=0.2)
    assert delayed.horizon == 15


def test_the_truth_does_not_age() -> None:
    """`delayed:5:oracle` forecasts the states of `oracle`, bit for bit."""
    scene, future = both(snippets())
    delayed, oracle = (
        predicted("delayed:5:oracle", scene, future),
        predicted("oracle", scene, future),
    )
    np.testing.assert_array_equal(delayed.states, oracle.states)
    np.testing.assert_array_equal(delayed.valid, oracle.valid)


def test_delays_add_up() -> None:
    scene, future = both(snippets())
    for name in ("constant-turn-rate", "blend:0.5"):
        once = predicted(f"delayed:3:{name}", scene, future)
        twice = predicted(f"delayed:1:delayed:2:{name}", scene, future)
        np.testing.assert_array_equal(once.states, twice.states)


def test_agents_that_have_just_appeared_get_constant_velocity() -> None:
    """A car that appears one tick ago is not in the forecast of two ticks ago."""
    late = Drive(kind=AgentClass.CAR, start=(-20.0, 0.0, 0.0, 5.0), appears_s=2.8)
    recordings = [make_recording(drives=(BRAKING, late), duration_s=10.0)]
    index = index_snippets(recordings, dt_s=0.2, horizon_s=3.0)
    scene = gather_scene(recordings, index.select(index.tick == 15))
    scene = scene.with_targets(np.array([[0, 0], [0, 1]]))
    assert scene.ids[0].tolist() == [1, 2]
    for ticks, expected in ((1, [True, True]), (2, [True, False])):
        name = f"delayed:{ticks}:constant-velocity"
        forecast = load_predictor(name, horizon=15, dt_s=0.2).predict(scene)
        assert forecast.valid.tolist() == expected
        filled = fill_missing(forecast, scene)
        straight = ConstantVelocity(horizon=15, dt_s=0.2).predict(scene)
        assert filled.valid.all()
        np.testing.assert_allclose(filled.states[1], straight.states[1], atol=1e-4)


@dataclass(frozen=True, slots=True, kw_only=True)
class Spy(ConstantVelocity):
    """Constant velocity that stores the scenes it is given."""

    seen: list[Scene]

    def predict(self, scene: Scene, future: Future | None = None) -> Forecast:
        self.seen.append(scene)
        return ConstantVelocity(horizon=self.horizon, dt_s=self.dt_s).predict(scene, future)


def test_the_earlier_scene_holds_nothing_later() -> None:
    """States and actions end earlier, and agents that have appeared since have no id or size."""
    scene, _ = both(snippets())
    spy = Spy(horizon=19, dt_s=0.2, seen=[])
    Delayed(inner=spy, ticks=4, horizon=15).predict(scene)
    (before,) = spy.seen
    assert before.history == scene.history - 4
    np.testing.assert_array_equal(before.tick, scene.tick - 4)
    np.testing.assert_array_equal(before.states, scene.states[:, :, :-4])
    np.testing.assert_array_equal(before.actions, scene.actions[:, :, :-4])
    absent = ~scene.valid[:, :, :-4].any(axis=-1)
    assert (absent & scene.valid[:, :, -1]).any()
    assert (before.ids[absent] == -1).all()
    assert not before.sizes[absent].any()


@pytest.mark.parametrize(
    "name",
    ["delayed", "delayed:2", "delayed:2:", "delayed:x:oracle", "delayed:0:blind",
     "delayed:-1:oracle", "delayed:1.5:oracle"],
)  # fmt: skip
def test_bad_delays_are_refused(name: str) -> None:
    with pytest.raises(AspEnvError, match=f"predictor {name}: expected delayed:TICKS:NAME"):
        load_predictor(name, horizon=15, dt_s=0.2)


def test_errors_of_the_other_predictor_are_passed_on() -> None:
    for name, message in (
        ("delayed:2:constant-velocty", "unknown predictor 'constant-velocty'"),
        ("delayed:2:blend:3", "predictor blend:3: expected blend:SHARE"),
        ("delayed:2:oracle:x", "oracle takes no argument"),
    ):
        with pytest.raises(AspEnvError, match=message):
            load_predictor(name, horizon=15, dt_s=0.2)


def test_a_short_history_is_reported() -> None:
    scene, _ = both(snippets(history=15))
    delayed = load_predictor("delayed:13:constant-turn-rate", horizon=15, dt_s=0.2)
    with pytest.raises(AspEnvError, match="delayed:13:constant-turn-rate needs 16 past ticks, the"):
        delayed.predict(scene)
