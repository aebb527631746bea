"""Films of rollouts: what is where between the ticks, and what is told of it."""

import dataclasses

import numpy as np
import pytest

from asp_env.errors import DataError
from asp_env.render.film import ALARM, WARNING, frames_of
from asp_env.render.frames import CLASS_COLOURS, EGO_COLOUR, FAINT, GHOST, PLAN
from tests.render.films import make_film, make_rollout

FILM = make_film()
SIZE = {"size_px": (480, 480), "extent_m": 48.0}  # 10 pixels a metre


def pixel(image: np.ndarray, x_m: float, y_m: float, *, ego_x_m: float) -> tuple[int, ...]:
    """The colour at a place in the world."""
    row, column = int(240 - 10 * (y_m + 1.75)), int(240 + 10 * (x_m - ego_x_m))
    return tuple(image[row, column].tolist())


def test_times_by_hand() -> None:
    """One second at 10 pictures a second: 0, 0.1, …, 0.9, then 1.0 and ten more of it."""
    times = FILM.times_s(10.0)
    np.testing.assert_allclose(times[:10], np.arange(10) / 10)
    assert times[10:].tolist() == [1.0] * 11
    slow = FILM.times_s(10.0, 0.25)
    np.testing.assert_allclose(slow[:40], np.arange(40) / 40)
    assert slow[40:].tolist() == [1.0] * 11
    np.testing.assert_allclose(FILM.times_s(7.0)[:8], [*np.arange(7) / 7, 1.0])


def test_positions_between_ticks() -> None:
    """At 0.3 s the ego has gone 3 m of 10 m/s, the car from 20 m to 17 m; trails stay at ticks."""
    moment = FILM.moment(0.3)
    np.testing.assert_allclose(moment.states[:, -1, 0], [3, 17], atol=1e-5)
    np.testing.assert_allclose(moment.states[0, :-1, 0], [0, 2], atol=1e-5)
    assert moment.logged_ego is not None
    np.testing.assert_allclose(moment.logged_ego[:2], [-1, -1.75], atol=1e-5)


def test_who_leaves_stays_till_the_next_tick() -> None:
    """The car is there last at tick 3, at 14 m: until 0.8 s, without moving."""
    for time_s, there in ((0.6, True), (0.79, True), (0.8, False), (1.0, False)):
        moment = FILM.moment(time_s)
        assert moment.valid[1, -1] == there
        assert not there or moment.states[1, -1, 0] == 14


def test_at_ticks_the_rollout_itself_is_shown() -> None:
    """No rounding on the way: 3 ticks of 0.2 s are a little more than 0.6 s."""
    for tick in range(6):
        moment = FILM.moment(tick * 0.2)
        assert np.array_equal(moment.states[:, -1], FILM.rollout.states[tick])
        assert moment.states.shape[1] == tick + 2


def test_forecasts_and_plans_lose_what_has_passed() -> None:
    """Said at tick 2: whole at 0.5 s, at tick 3 one step less; the last plan is of tick 4."""
    early, late = FILM.moment(0.5), FILM.moment(0.6)
    assert (early.steps_gone.tolist(), late.steps_gone.tolist()) == ([0], [1])
    assert early.modes[0, 0, 0].tolist() == [14, 1.75]
    np.testing.assert_allclose(early.probabilities, [[0.75, 0.25]], rtol=1e-6)
    assert FILM.moment(0.2).steps_gone.tolist() == [1]
    assert FILM.moment(0.2).modes[0, 0, 0].tolist() == [18, 1.75]
    assert len(FILM.moment(0.8).plan) == 10
    assert FILM.moment(1.0).plan[0].tolist() == [12, -1.75]  # of tick 4, without its first step


def test_without_plans_and_forecasts() -> None:
    """The expert's drives have none: nothing but who is there is shown."""
    rollout = dataclasses.replace(
        make_rollout(),
        plans=np.zeros((0, 1, 2), dtype=np.float32),
        forecast_states=np.zeros((0, 1, 1, 2), dtype=np.float32),
        forecast_log_probs=np.zeros((0, 1), dtype=np.float32),
        forecast_slots=np.zeros(0, dtype=np.int64),
        forecast_ticks=np.zeros(0, dtype=np.int64),
    )
    moment = make_film(rollout).moment(0.5)
    assert (len(moment.plan), len(moment.modes)) == (0, 0)
    image = make_film(rollout).frame(0.5, **SIZE)
    assert pixel(image, 10, -1.75, ego_x_m=5) != PLAN
    assert pixel(image, 5, -1.2, ego_x_m=5) == EGO_COLOUR


def test_places_and_colours() -> None:
    """At tick 2 the ego is at 4 m, its log at 0, the car at 16 m, and the plan in between."""
    image = FILM.frame(0.4, **SIZE)
    assert pixel(image, 4, -1.2, ego_x_m=4) == EGO_COLOUR
    assert pixel(image, 16.5, 1.2, ego_x_m=4) == CLASS_COLOURS[FILM.rollout.classes[1]]
    near = np.subtract(pixel(image, 10, -1.75, ego_x_m=4), PLAN)
    assert np.abs(near).max() < 16
    edge = np.subtract(pixel(image, -2, -1.2, ego_x_m=4), GHOST)
    assert np.abs(edge).max() < 60
    assert np.abs(np.subtract(pixel(image, 0, -1.2, ego_x_m=4), GHOST)).max() > 100


def test_equal_arguments_give_equal_bits() -> None:
    """A picture does not depend on those drawn before."""
    first = FILM.frame(0.5, **SIZE)
    FILM.frame(0.9, size_px=(320, 240), extent_m=None)
    assert np.array_equal(FILM.frame(0.5, **SIZE), first)


def test_what_is_wrong_is_told_where_it_is() -> None:
    """The graver name alone for the collision; a frame about the ego; spells below."""
    assert FILM.moment(0.3).alarms == ()
    assert FILM.moment(0.5).alarms == (("at-fault collision", ALARM),)
    assert FILM.moment(1.0).alarms == (("off-road", WARNING),)
    calm, crash = FILM.frame(0.38, **SIZE), FILM.frame(0.4, **SIZE)
    around = (4 + 2.6, -1.75 + 0.8)  # the frame is 5.2 m by 3.2 m
    assert pixel(crash, *around, ego_x_m=4) == ALARM
    assert pixel(calm, *around, ego_x_m=4) != ALARM
    line = crash[-2]
    assert tuple(line[20]) == FAINT
    assert {tuple(line[column]) for column in range(210, 382)} == {ALARM}  # ticks 2 to 4 of 5
    assert tuple(line[-1]) == WARNING


def test_films_follow_each_other() -> None:
    """Two films at 2 pictures a second: 2 that move, the last one and its still, twice."""
    frames = list(frames_of([FILM, FILM], size_px=(64, 48), extent_m=30.0, fps=2.0, speed=1.0))
    assert len(frames) == 2 * (2 + 1 + 2)
    assert np.array_equal(frames[0], FILM.frame(0.0, size_px=(64, 48), extent_m=30.0))
    assert np.array_equal(frames[4], FILM.frame(1.0, size_px=(64, 48), extent_m=30.0))
    assert np.array_equal(frames[5], frames[0])


@pytest.mark.parametrize("name", ["states", "plans", "forecast_states", "route"])
def test_what_has_no_place_is_refused(name: str) -> None:
    """A position that is no number."""
    value = getattr(make_rollout(), name)
    broken = np.full((3, 2), np.nan, dtype=np.float32) if name == "route" else value.copy()
    broken.flat[0] = np.nan
    with pytest.raises(DataError, match=f"{name}: expected finite numbers"):
        make_film(dataclasses.replace(make_rollout(), **{name: broken}))
