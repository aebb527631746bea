"""Tests of films: positions between ticks, forecasts, plans and events."""

import dataclasses

import numpy as np
import pytest

from asp_env.errors import DataError
from asp_env.render.film import ALARM_COLOUR, WARNING_COLOUR, frames_of
from asp_env.render.frames import (
    CLASS_COLOURS,
    EGO_COLOUR,
    FAINT_COLOUR,
    PLAN_COLOUR,
    RECORDED_EGO_COLOUR,
)
from tests.render.films import make_film, make_rollout

FILM = make_film()
SIZE = {"size_px": (480, 480), "extent_m": 48.0}  # 10 pixels per metre


def pixel(image: np.ndarray, x_m: float, y_m: float, *, ego_x_m: float) -> tuple[int, ...]:
    """The colour at a point in metres."""
    row, column = int(240 - 10 * (y_m + 1.75)), int(240 + 10 * (x_m - ego_x_m))
    return tuple(image[row, column].tolist())


def test_times_of_frames() -> None:
    """One second at 10 frames per second: 0, 0.1, …, 0.9, then 1.0 eleven times."""
    times = FILM.times_s(10.0)
    np.testing.assert_allclose(times[:10], np.arange(10) / 10)
    assert times[10:].tolist() == [1.0] * 11
    slow = FILM.times_s(10.0, 0.25)
    np.testing.assert_allclose(slow[:40], np.arange(40) / 40)
    assert slow[40:].tolist() == [1.0] * 11
    np.testing.assert_allclose(FILM.times_s(7.0)[:8], [*np.arange(7) / 7, 1.0])


def test_positions_between_ticks() -> None:
    """At 0.3 s the ego has driven 3 m at 10 m/s, the car from 20 m to 17 m; trails end at ticks."""
    contents = FILM.contents(0.3)
    np.testing.assert_allclose(contents.states[:, -1, 0], [3, 17], atol=1e-5)
    np.testing.assert_allclose(contents.states[0, :-1, 0], [0, 2], atol=1e-5)
    assert contents.recorded_ego is not None
    np.testing.assert_allclose(contents.recorded_ego[:2], [-1, -1.75], atol=1e-5)


def test_an_agent_that_leaves_stands_still_until_the_next_tick() -> None:
    """The last valid tick of the car is 3, at 14 m; it is visible until 0.8 s."""
    for time_s, present in ((0.6, True), (0.79, True), (0.8, False), (1.0, False)):
        contents = FILM.contents(time_s)
        assert contents.valid[1, -1] == present
        assert not present or contents.states[1, -1, 0] == 14


def test_frames_at_ticks_show_the_states_of_the_rollout() -> None:
    """Rounding has no effect: 3 * 0.2 is slightly greater than 0.6."""
    for tick in range(6):
        contents = FILM.contents(tick * 0.2)
        assert np.array_equal(contents.states[:, -1], FILM.rollout.states[tick])
        assert contents.states.shape[1] == tick + 2


def test_past_steps_of_forecasts_and_plans_are_not_shown() -> None:
    """A forecast of tick 2 has all steps at 0.5 s and one less at tick 3."""
    early, late = FILM.contents(0.5), FILM.contents(0.6)
    assert (early.elapsed_steps.tolist(), late.elapsed_steps.tolist()) == ([0], [1])
    assert early.modes[0, 0, 0].tolist() == [14, 1.75]
    np.testing.assert_allclose(early.probabilities, [[0.75, 0.25]], rtol=1e-6)
    assert FILM.contents(0.2).elapsed_steps.tolist() == [1]
    assert FILM.contents(0.2).modes[0, 0, 0].tolist() == [18, 1.75]
    assert len(FILM.contents(0.8).plan) == 10
    assert FILM.contents(1.0).plan[0].tolist() == [
        12,
        -1.75,
    ]  # the plan of tick 4 without its first step


def test_rollouts_without_plans_and_forecasts() -> None:
    """Rollouts of the expert have none."""
    rollout = dataclasses.replace(
        make_rollout(),
        plans=np.zeros((0, 1, 2), dtype=np.float32),
        forecast_states=np.zeros((0, 1, 1, 2), dtype=np.float32),
        forecast_log_probs=np.zeros((0, 1), dtype=np.float32),
        forecast_slots=np.zeros(0, dtype=np.int64),
        forecast_ticks=np.zeros(0, dtype=np.int64),
    )
    contents = make_film(rollout).contents(0.5)
    assert (len(contents.plan), len(contents.modes)) == (0, 0)
    image = make_film(rollout).frame(0.5, **SIZE)
    assert pixel(image, 10, -1.75, ego_x_m=5) != PLAN_COLOUR
    assert pixel(image, 5, -1.2, ego_x_m=5) == EGO_COLOUR


def test_positions_and_colours() -> None:
    """At tick 2 the ego is at 4 m, the recorded ego at 0 m and the car at 16 m."""
    image = FILM.frame(0.4, **SIZE)
    assert pixel(image, 4, -1.2, ego_x_m=4) == EGO_COLOUR
    assert pixel(image, 16.5, 1.2, ego_x_m=4) == CLASS_COLOURS[FILM.rollout.classes[1]]
    near = np.subtract(pixel(image, 10, -1.75, ego_x_m=4), PLAN_COLOUR)
    assert np.abs(near).max() < 16
    edge = np.subtract(pixel(image, -2, -1.2, ego_x_m=4), RECORDED_EGO_COLOUR)
    assert np.abs(edge).max() < 60
    assert np.abs(np.subtract(pixel(image, 0, -1.2, ego_x_m=4), RECORDED_EGO_COLOUR)).max() > 100


def test_equal_arguments_give_equal_bits() -> None:
    """A frame does not depend on frames drawn before."""
    first = FILM.frame(0.5, **SIZE)
    FILM.frame(0.9, size_px=(320, 240), extent_m=None)
    assert np.array_equal(FILM.frame(0.5, **SIZE), first)


def test_events_are_marked() -> None:
    """A badge names the most specific event; a rectangle and the time line are coloured."""
    assert FILM.contents(0.3).alarms == ()
    assert FILM.contents(0.5).alarms == (("at-fault collision", ALARM_COLOUR),)
    assert FILM.contents(1.0).alarms == (("off-road", WARNING_COLOUR),)
    before, during = FILM.frame(0.38, **SIZE), FILM.frame(0.4, **SIZE)
    around = (4 + 2.6, -1.75 + 0.8)  # the rectangle is 5.2 m by 3.2 m
    assert pixel(during, *around, ego_x_m=4) == ALARM_COLOUR
    assert pixel(before, *around, ego_x_m=4) != ALARM_COLOUR
    line = during[-2]
    assert tuple(line[20]) == FAINT_COLOUR
    assert {tuple(line[column]) for column in range(210, 382)} == {
        ALARM_COLOUR
    }  # ticks 2 to 4 of 5
    assert tuple(line[-1]) == WARNING_COLOUR


def test_films_follow_each_other() -> None:
    """Two films at 2 frames per second: 2 moving frames each, then the last one three times."""
    frames = list(frames_of([FILM, FILM], size_px=(64, 48), extent_m=30.0, fps=2.0, speed=1.0))
    assert len(frames) == 2 * (2 + 1 + 2)
    assert np.array_equal(frames[0], FILM.frame(0.0, size_px=(64, 48), extent_m=30.0))
    assert np.array_equal(frames[4], FILM.frame(1.0, size_px=(64, 48), extent_m=30.0))
    assert np.array_equal(frames[5], frames[0])


@pytest.mark.parametrize("name", ["states", "plans", "forecast_states", "route"])
def test_positions_that_are_not_finite_are_refused(name: str) -> None:
    value = getattr(make_rollout(), name)
    broken = np.full((3, 2), np.nan, dtype=np.float32) if name == "route" else value.copy()
    broken.flat[0] = np.nan
    with pytest.raises(DataError, match=f"{name}: expected finite numbers"):
        make_film(dataclasses.replace(make_rollout(), **{name: broken}))
