"""Forecasts without weights, against numbers worked out by hand."""

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


def test_constant_velocity_goes_thirty_metres_in_three_seconds() -> None:
    """At 10 m/s along +x a target is 2 m further after one tick and 30 m after fifteen."""
    scene, _, _ = snippets_of(EAST)
    forecast = ConstantVelocity(horizon=15, dt_s=0.2).predict(scene)
    ahead = forecast.states[:, 0, :, 0] - scene.target_states[:, :1]
    np.testing.assert_allclose(ahead[:, 0], 2.0, atol=1e-4)
    np.testing.assert_allclose(ahead[:, -1], 30.0, atol=1e-4)
    np.testing.assert_allclose(forecast.states[..., 1], 2.0, atol=1e-6)
    assert not forecast.actions.any()
    assert forecast.actions_valid.all()


def test_constant_turn_rate_stays_on_its_circle() -> None:
    """A car that circles at constant steering ends within 5 cm of where it really is after 3 s."""
    scene, future, _ = snippets_of(CIRCLE)
    forecast = ConstantTurnRate(horizon=15, dt_s=0.2).predict(scene)
    error = np.linalg.norm(forecast.states[:, 0, :, :2] - future.states[..., :2], axis=-1)
    assert error.max() < 0.05
    np.testing.assert_allclose(forecast.actions[..., 1], 0.3, atol=2e-3)
    straight = ConstantVelocity(horizon=15, dt_s=0.2).predict(scene)
    missed = np.linalg.norm(straight.states[:, 0, -1, :2] - future.states[:, -1, :2], axis=-1)
    assert missed.min() > 5.0


def test_constant_turn_rate_reads_the_last_three_ticks_alone() -> None:
    """What a heading was more than 0.6 s ago does not matter."""
    scene, _, _ = snippets_of(CIRCLE)
    predictor = ConstantTurnRate(horizon=15, dt_s=0.2)
    before = predictor.predict(scene)
    scene.states[:, :, :-4, 2] += 1.0
    np.testing.assert_array_equal(predictor.predict(scene).states, before.states)
    scene.states[:, :, :-3, 2] += 0.1
    assert np.abs(predictor.predict(scene).states - before.states).max() > 0.1


def test_oracle_returns_the_recorded_future() -> None:
    """Its states are those of the recording, bit for bit."""
    scene, future, _ = snippets_of(EAST, CIRCLE)
    forecast = Oracle(horizon=15, dt_s=0.2).predict(scene, future)
    np.testing.assert_array_equal(forecast.states[:, 0], future.states)
    assert forecast.valid.all()


def test_oracle_without_a_future_is_refused() -> None:
    """No future, or too short a one, is one line that says what is missing."""
    scene, future, _ = snippets_of(EAST)
    with pytest.raises(AspEnvError, match="future of 15 ticks and was given none"):
        Oracle(horizon=15, dt_s=0.2).predict(scene)
    with pytest.raises(AspEnvError, match="future of 20 ticks and was given one of 15"):
        Oracle(horizon=20, dt_s=0.2).predict(scene, future)


@pytest.mark.parametrize("name", ["constant-velocity", "constant-turn-rate", "oracle"])
def test_superfluous_argument_is_refused(name: str) -> None:
    """`constant-velocity:runs/1` says that there is nothing to load."""
    with pytest.raises(AspEnvError, match=f"{name} takes no argument, 'runs/1' was given"):
        load_predictor(f"{name}:runs/1", horizon=15, dt_s=0.2)


def test_pedestrians_and_late_comers_are_left_out() -> None:
    """Only predicted classes seen for the predictor's own history are forecast."""
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
