"""Predictors without weights, against numbers derived by hand."""

import math

import numpy as np
import pytest

from asp_env.data.classes import AgentClass
from asp_env.data.predictor import load_predictor
from asp_env.data.scene import Scene
from asp_env.data.snippets import (
    Future,
    SnippetIndex,
    gather_future,
    gather_scene,
    index_snippets,
)
from asp_env.errors import AspEnvError
from predictors.physical import ConstantTurnRate, ConstantVelocity, Oracle
from tests.builders import Drive, make_recording

EAST = Drive(kind=AgentClass.CAR, start=(-50.0, 2.0, 0.0, 10.0))
CIRCLE = Drive(kind=AgentClass.CAR, start=(0.0, 0.0, 0.0, 5.0), phases=((600.0, 0.0, 0.3),))


def snippets_of(*drives: Drive) -> tuple[Scene, Future, SnippetIndex]:
    """Scene and future of all snippets of a recording of 10 s."""
    recordings = [make_recording(drives=drives, duration_s=10.0)]
    index = index_snippets(recordings, dt_s=0.2, horizon_s=3.0)
    return gather_scene(recordings, index), gather_future(recordings, index), index


def test_constant_velocity_moves_30_m_in_3_s() -> None:
    """At 10 m/s along +x a target is 2 m ahead after one tick and 30 m ahead after fifteen."""
    scene, _, _ = snippets_of(EAST)
    forecast = ConstantVelocity(horizon=15, dt_s=0.2).predict(scene)
    ahead = forecast.states[:, 0, :, 0] - scene.target_states[:, :1]
    np.testing.assert_allclose(ahead[:, 0], 2.0, atol=1e-4)
    np.testing.assert_allclose(ahead[:, -1], 30.0, atol=1e-4)
    np.testing.assert_allclose(forecast.states[..., 1], 2.0, atol=1e-6)
    assert not forecast.actions.any()
    assert forecast.actions_valid.all()


def test_constant_turn_rate_stays_on_its_circle() -> None:
    """A car that circles at constant steering is forecast to within 5 cm after 3 s."""
    scene, future, _ = snippets_of(CIRCLE)
    forecast = ConstantTurnRate(horizon=15, dt_s=0.2).predict(scene)
    error = np.linalg.norm(forecast.states[:, 0, :, :2] - future.states[..., :2], axis=-1)
    assert error.max() < 0.05
    np.testing.assert_allclose(forecast.actions[..., 1], 0.3, atol=2e-3)
    straight = ConstantVelocity(horizon=15, dt_s=0.2).predict(scene)
    straight_error = np.linalg.norm(
        straight.states[:, 0, -1, :2] - future.states[:, -1, :2], axis=-1
    )
    assert straight_error.min() > 5.0


def test_constant_turn_rate_reads_only_the_last_three_ticks() -> None:
    """Headings of more than 0.6 s ago have no influence."""
    scene, _, _ = snippets_of(CIRCLE)
    predictor = ConstantTurnRate(horizon=15, dt_s=0.2)
    before = predictor.predict(scene)
    scene.states[:, :, :-4, 2] += 1.0
    np.testing.assert_array_equal(predictor.predict(scene).states, before.states)
    scene.states[:, :, :-3, 2] += 0.1
    assert np.abs(predictor.predict(scene).states - before.states).max() > 0.1


def test_oracle_returns_the_recorded_future() -> None:
    scene, future, _ = snippets_of(EAST, CIRCLE)
    forecast = Oracle(horizon=15, dt_s=0.2).predict(scene, future)
    np.testing.assert_array_equal(forecast.states[:, 0], future.states)
    assert forecast.valid.all()


def one_target(
    kind: AgentClass, now: tuple[float, float, float, float]
) -> tuple[Scene, np.ndarray, np.ndarray]:
    """A scene of one agent in that state, and a future of 15 ticks of NaN, none of them valid."""
    recordings = [make_recording(drives=(EAST,), duration_s=10.0)]
    index = index_snippets(recordings, dt_s=0.2, horizon_s=3.0).select(np.array([0]))
    scene = gather_scene(recordings, index)
    scene.states[0, 0] = now
    scene.classes[0, 0] = kind
    states = np.full((1, 15, 4), np.nan, dtype=np.float32)
    return scene, states, np.zeros((1, 15), dtype=bool)


def test_oracle_continues_after_the_end_of_the_recording() -> None:
    """A car brakes at 2 m/s² from 10 m/s for 14 ticks, then continues at 4.4 m/s: 0.88 m per tick.

    After k ticks its speed is 10 - 0.4k m/s and its distance 2k - 0.04k² m: 20.16 m after 14 ticks,
    21.04 m after 15.
    """
    scene, states, valid = one_target(AgentClass.CAR, (0.0, 0.0, 0.0, 10.0))
    k = np.arange(1, 15)
    states[0, :14] = np.stack([2 * k - 0.04 * k**2, 0 * k, 0 * k, 10 - 0.4 * k], axis=-1)
    valid[0, :14] = True
    forecast = Oracle(horizon=15, dt_s=0.2).predict(scene, Future(states=states, valid=valid))
    assert forecast.valid.tolist() == [True]
    np.testing.assert_array_equal(forecast.states[0, 0, :14], states[0, :14])
    np.testing.assert_allclose(forecast.states[0, 0, 14], [21.04, 0, 0, 4.4], atol=1e-5)
    np.testing.assert_allclose(forecast.actions[0, 0, :14, 0], -2.0, atol=1e-3)
    assert forecast.actions[0, 0, 14, 0] == pytest.approx(0.0, abs=1e-3)


def test_oracle_of_a_pedestrian_that_stops() -> None:
    """North at 1 m/s for three ticks, then standing at 0.6 m, also after the recorded ticks."""
    north = math.pi / 2
    scene, states, valid = one_target(AgentClass.PEDESTRIAN, (5.0, 0.0, north, 1.0))
    states[0, :5, 0] = 5.0
    states[0, :5, 1] = [0.2, 0.4, 0.6, 0.6, 0.6]
    states[0, :5, 2] = north
    states[0, :5, 3] = [1.0, 1.0, 0.0, 0.0, 0.0]
    valid[0, :5] = True
    forecast = Oracle(horizon=15, dt_s=0.2).predict(scene, Future(states=states, valid=valid))
    assert forecast.valid.tolist() == [True]
    np.testing.assert_array_equal(forecast.states[0, 0, :5], states[0, :5])
    np.testing.assert_allclose(forecast.states[0, 0, 5:], [[5.0, 0.6, north, 0.0]] * 10, atol=1e-6)


def test_oracle_interpolates_headings_across_pi() -> None:
    """Recorded at ticks 1 and 5 only: a quarter of the difference each tick, headings through ±π.

    From (0, 0) at 3.1 rad and 4 m/s to (-4, 2) at -3.1 rad and 8 m/s: half-way at (-2, 1), ±π and
    6 m/s. After tick 5 it continues 1.6 m per tick at -3.1 rad.
    """
    scene, states, valid = one_target(AgentClass.BICYCLE, (0.8, 0.0, 3.1, 4.0))
    states[0, 0] = (0.0, 0.0, 3.1, 4.0)
    states[0, 4] = (-4.0, 2.0, -3.1, 8.0)
    valid[0, [0, 4]] = True
    forecast = Oracle(horizon=15, dt_s=0.2).predict(scene, Future(states=states, valid=valid))
    states = forecast.states[0, 0]
    np.testing.assert_allclose(states[1, [0, 1, 3]], [-1.0, 0.5, 5.0], atol=1e-6)
    np.testing.assert_allclose(states[2, [0, 1, 3]], [-2.0, 1.0, 6.0], atol=1e-6)
    assert abs(states[2, 2]) == pytest.approx(math.pi, abs=1e-5)
    ahead = [-4 + 16 * math.cos(3.1), 2 - 16 * math.sin(3.1), -3.1, 8.0]
    np.testing.assert_allclose(states[14], ahead, atol=1e-5)


def test_oracle_omits_absent_and_unrecorded_targets() -> None:
    """A target that is absent now, or recorded at no future tick, is not forecast."""
    scene, states, valid = one_target(AgentClass.CAR, (0.0, 0.0, 0.0, 10.0))
    oracle = Oracle(horizon=15, dt_s=0.2)
    assert not oracle.predict(scene, Future(states=states, valid=valid)).valid.any()
    states[0], valid[0] = 1.0, True
    assert oracle.predict(scene, Future(states=states, valid=valid)).valid.all()
    scene.valid[0, 0, -1] = False
    assert not oracle.predict(scene, Future(states=states, valid=valid)).valid.any()


def test_oracle_needs_a_future() -> None:
    """The error names the missing ticks if there is no future or a shorter one."""
    scene, future, _ = snippets_of(EAST)
    with pytest.raises(AspEnvError, match="future of 15 ticks and was given none"):
        Oracle(horizon=15, dt_s=0.2).predict(scene)
    with pytest.raises(AspEnvError, match="future of 20 ticks and was given one of 15"):
        Oracle(horizon=20, dt_s=0.2).predict(scene, future)


@pytest.mark.parametrize("name", ["constant-velocity", "constant-turn-rate", "oracle"])
def test_argument_is_refused(name: str) -> None:
    """`constant-velocity:runs/1` is refused: there is nothing to load."""
    with pytest.raises(AspEnvError, match=f"{name} takes no argument, 'runs/1' was given"):
        load_predictor(f"{name}:runs/1", horizon=15, dt_s=0.2)


def test_pedestrians_and_short_histories_are_not_forecast() -> None:
    """Only predicted classes that are valid for the predictor's own history are forecast."""
    walker = Drive(kind=AgentClass.PEDESTRIAN, start=(0.0, 5.0, 0.0, 1.0))
    late = Drive(kind=AgentClass.CAR, start=(-20.0, 0.0, 0.0, 5.0), appears_s=2.8)
    scene, _, _ = snippets_of(EAST, walker, late)
    at_3_s = np.flatnonzero(scene.tick == 15)
    assert len(at_3_s) == 1
    slots = np.arange(3)
    targets = np.stack([np.full(3, at_3_s[0]), slots], axis=-1)
    scene = scene.with_targets(targets)
    assert scene.ids[at_3_s[0]].tolist() == [1, 2, 3]
    straight = ConstantVelocity(horizon=15, dt_s=0.2).predict(scene)
    assert straight.valid.tolist() == [True, False, True]
    turning = ConstantTurnRate(horizon=15, dt_s=0.2).predict(scene)
    assert turning.valid.tolist() == [True, False, False]
    assert not turning.states[1:].any()
