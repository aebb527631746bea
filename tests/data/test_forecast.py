"""Forecasts at the crossing, and how missing ones are filled in."""

import dataclasses
import math

import numpy as np
import pytest

from asp_env.data.predictor import Forecast, constant_velocity, fill_missing, make_forecast
from asp_env.data.scene import Scene
from asp_env.data.snippets import gather_scene, index_snippets
from tests.builders import make_recording

STEPS = 5


def scene_of(*slots: int) -> Scene:
    """The crossing at tick 15, 3 s, with some slots as targets.

    Slot 0 drives along +x at 8 m/s from -90 m, slot 1 along -x and brakes, slot 5 circles, slot 6
    is a bicycle at 4 m/s from -70 m, and slot 9 is empty.
    """
    recording = make_recording()
    index = index_snippets([recording], dt_s=0.2, horizon_s=3.0)
    scene = gather_scene([recording], index.select((index.tick == 15) | (index.tick == 36)))
    return scene.with_targets(np.array([(0, slot) for slot in slots]))


def forecast_of(scene: Scene, valid: list[bool], *, modes: int = 3) -> Forecast:
    """Modes with all states 7, the first mode being the most probable."""
    shape = (len(valid), modes, STEPS)
    weights = np.arange(modes, 0, -1) / np.arange(1, modes + 1).sum()
    return make_forecast(
        scene,
        states=np.full((*shape, 4), 7.0),
        actions=None,
        log_probs=np.tile(np.log(weights), (len(valid), 1)),
        valid=np.array(valid),
    )


def test_constant_velocity() -> None:
    """After 3 s slot 0 is at -90 + 24 = -66 m, and then drives 1.6 m per tick."""
    states = constant_velocity(scene_of(0, 6), steps=STEPS)
    ahead = np.arange(1, STEPS + 1)
    np.testing.assert_allclose(states[0, :, 0], -66 + 1.6 * ahead, atol=1e-3)
    np.testing.assert_allclose(states[1, :, 0], -58 + 0.8 * ahead, atol=1e-3)
    np.testing.assert_allclose(states[:, :, 1], [[-1.75] * STEPS, [-4.5] * STEPS], atol=1e-3)
    np.testing.assert_allclose(
        states[:, :, 2:], np.array([[[0, 8]], [[0, 4]]]) + 0 * ahead[:, None]
    )


def test_constant_velocity_backwards() -> None:
    scene = scene_of(0)
    scene.states[0, 0, -1] = (10.0, 5.0, math.pi / 2, -2.0)
    states = constant_velocity(scene, steps=2)
    np.testing.assert_allclose(states[0, :, :2], [(10, 4.6), (10, 4.2)], atol=1e-5)


def test_make_forecast() -> None:
    """Rows have the ids and ticks of their targets; invalid rows are zeros."""
    scene = scene_of(5, 6)
    forecast = forecast_of(scene, [True, False])
    assert forecast.ids.tolist() == [6, 9]
    assert forecast.tick.tolist() == [15, 15]
    assert forecast.targets.tolist() == [[0, 5], [0, 6]]
    assert forecast.dt_s == 0.2
    assert (forecast.states[0] == 7).all()
    assert not forecast.states[1].any()
    assert forecast.states.dtype == forecast.log_probs.dtype == np.float32
    assert not forecast.actions_valid.any()
    np.testing.assert_allclose(forecast.probabilities[0], [3 / 6, 2 / 6, 1 / 6], rtol=1e-6)


def test_actions_are_valid_where_the_forecast_is() -> None:
    scene = scene_of(5, 6)
    forecast = make_forecast(
        scene,
        states=np.zeros((2, 1, STEPS, 4)),
        actions=np.ones((2, 1, STEPS, 2)),
        log_probs=np.zeros((2, 1)),
        valid=np.array([True, False]),
    )
    assert forecast.actions_valid.tolist() == [True, False]
    assert (forecast.actions[0] == 1).all()
    assert not forecast.actions[1].any()


def test_most_probable() -> None:
    """Of equally probable modes it is the first."""
    forecast = forecast_of(scene_of(0, 1), [True, True])
    log_probs = np.log(np.array([(0.2, 0.5, 0.3), (0.4, 0.2, 0.4)], dtype=np.float32))
    assert dataclasses.replace(forecast, log_probs=log_probs).most_probable.tolist() == [1, 0]


def test_fill_missing() -> None:
    """The bicycle gets constant velocity in equally probable modes; other rows do not change."""
    scene = scene_of(0, 6, 9)
    filled = fill_missing(forecast_of(scene, [True, False, False]), scene)
    assert filled.valid.tolist() == [True, True, False]
    assert (filled.states[0] == 7).all()
    straight = constant_velocity(scene, steps=STEPS)[1]
    for mode in range(3):
        np.testing.assert_array_equal(filled.states[1, mode], straight)
    assert not filled.states[2].any()  # an empty slot
    np.testing.assert_allclose(filled.probabilities[:2], [[1 / 2, 1 / 3, 1 / 6], [1 / 3] * 3], 1e-6)
    assert not filled.actions_valid.any()


def test_complete_forecast_is_returned_unchanged() -> None:
    scene = scene_of(0, 1)
    forecast = forecast_of(scene, [True, True])
    assert fill_missing(forecast, scene) is forecast


@pytest.mark.parametrize("modes", [1, 3])
def test_filled_probabilities_sum_to_one(modes: int) -> None:
    """Even if the predictor left the log-probabilities of other targets at zero."""
    scene = scene_of(0, 6)
    empty = dataclasses.replace(
        forecast_of(scene, [False, False], modes=modes),
        log_probs=np.zeros((2, modes), dtype=np.float32),
    )
    np.testing.assert_allclose(fill_missing(empty, scene).probabilities.sum(axis=1), 1, rtol=1e-6)
