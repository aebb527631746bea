"""What predictors may know: neither the future, nor where the world lies."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from asp_env.data.classes import AgentClass
from asp_env.data.predictor import Predictor, load_predictor
from asp_env.data.recording import Recording
from asp_env.data.road_map import Ragged
from asp_env.data.snippets import Future, gather_future, gather_scene
from asp_env.errors import AspEnvError
from asp_env.geometry import wrap_angle
from predictors.models.chaining import CHAININGS
from tests.builders import DRIVES, Drive, make_recording
from tests.conformance.predictor_cases import (
    LEARNED,
    PHYSICAL,
    RECORDING,
    Case,
    ask,
    assert_same,
    every,
    situations,
    snippets,
    tried,
)

turning = tried(PHYSICAL + tuple(case for case in LEARNED if case.view == "vectors"))


@every
def test_unprivileged_predictors_read_no_future(predictor: Predictor) -> None:
    """Handed a false future, a predictor that is not privileged forecasts the same."""
    scene, future = situations(predictor)
    false = Future(states=future.states + 50, valid=future.valid)
    if predictor.privileged:
        true = predictor.predict(scene, future)
        assert not np.array_equal(true.states, predictor.predict(scene, false).states)
    else:
        assert_same(predictor.predict(scene), predictor.predict(scene, false))


@every
def test_what_is_recorded_later_changes_nothing(predictor: Predictor) -> None:
    """With another recording from the next frame on, forecasts are the same bit for bit.

    Everybody is elsewhere then, one leaves at once and another one comes. Who is privileged
    forecasts something else.
    """
    index = snippets(predictor.horizon)
    index = index.select(index.tick == 30)
    assert len(index) > 3
    other = with_another_future(RECORDING, frame=30 * 5)
    here, there = (
        ask(predictor, gather_scene([r], index), gather_future([r], index))
        for r in (RECORDING, other)
    )
    if predictor.privileged:
        assert not np.array_equal(here.states, there.states)
    else:
        assert_same(here, there)


@pytest.mark.parametrize("chaining", CHAININGS)
def test_only_chaining_by_oracle_is_privileged(chaining: str, folder: Path) -> None:
    """It says so, and is refused without a future; beam, top-1 and full need none."""
    case = Case("ssp-asp", "vectors", chaining)
    predictor = load_predictor(case.save(folder), horizon=case.horizon, dt_s=0.2)
    assert predictor.privileged == (chaining == "oracle")
    assert predictor.metadata["chaining"] == chaining
    if predictor.privileged:
        with pytest.raises(AspEnvError, match="needs the recorded future of 30 ticks"):
            predictor.predict(situations(predictor)[0])


@turning
def test_moving_the_world_moves_the_forecast(predictor: Predictor) -> None:
    """Turned by 1 rad and shifted by (30, -20) m, the forecast is turned and shifted, to 1e-4."""
    uneven = without_symmetry(RECORDING)
    scene, future = situations(predictor, uneven)
    there, there_future = situations(predictor, moved(uneven, angle_rad=1.0, shift_m=(30.0, -20.0)))
    here = ask(predictor, scene, future)
    expected = move(here.states, angle_rad=1.0, shift_m=(30.0, -20.0))
    found = ask(predictor, there, there_future)
    np.testing.assert_allclose(found.states[..., :2], expected[..., :2], atol=1e-4)
    np.testing.assert_allclose(wrap_angle(found.states[..., 2] - expected[..., 2]), 0, atol=1e-4)
    np.testing.assert_allclose(found.states[..., 3], expected[..., 3], atol=1e-4)
    np.testing.assert_allclose(found.log_probs, here.log_probs, atol=1e-4)


def with_another_future(recording: Recording, *, frame: int) -> Recording:
    """The same up to a frame; then all are elsewhere, the first is gone and one more has come."""
    comes = Drive(kind=AgentClass.CAR, start=(5.0, 5.0, 1.0, 3.0), appears_s=(frame + 1) / 25)
    first = dataclasses.replace(DRIVES[0], leaves_s=frame / 25)
    other = make_recording(drives=(first, *DRIVES[1:], comes), road_map=recording.road_map)
    lengths = np.diff(other.starts)
    rows = np.arange(len(other.states)) - np.repeat(other.starts[:-1], lengths)
    at = np.repeat(other.first_frames, lengths) + rows
    states = other.states.copy()
    states[at > frame] += np.float32(40.0)
    return dataclasses.replace(other, states=states)


def move(states: np.ndarray, *, angle_rad: float, shift_m: tuple[float, float]) -> np.ndarray:
    """States [x, y, heading, speed] of a world that is turned about the origin, then shifted."""
    heading = wrap_angle(states[..., 2] + angle_rad)
    xy = move_points(states[..., :2], angle_rad=angle_rad, shift_m=shift_m)
    return np.concatenate([xy, heading[..., None], states[..., 3:]], axis=-1).astype(states.dtype)


def move_points(
    points: np.ndarray, *, angle_rad: float, shift_m: tuple[float, float]
) -> np.ndarray:
    """Points of that world."""
    cos, sin = np.cos(angle_rad), np.sin(angle_rad)
    x = cos * points[..., 0] - sin * points[..., 1] + shift_m[0]
    y = sin * points[..., 0] + cos * points[..., 1] + shift_m[1]
    return np.stack([x, y], axis=-1)


def without_symmetry(recording: Recording) -> Recording:
    """The same with lines a little aside: of two that are equally near, rounding picks one."""
    lines = recording.road_map.lines
    lines = dataclasses.replace(lines, points=lines.points + np.array([0.13, 0.07]))
    return dataclasses.replace(
        recording, road_map=dataclasses.replace(recording.road_map, lines=lines)
    )


def moved(recording: Recording, *, angle_rad: float, shift_m: tuple[float, float]) -> Recording:
    """The same recording in a world that is turned and shifted, with its map."""

    def turned(ragged: Ragged) -> Ragged:
        points = move_points(ragged.points, angle_rad=angle_rad, shift_m=shift_m)
        return dataclasses.replace(ragged, points=points)

    road_map = dataclasses.replace(
        recording.road_map,
        lines=turned(recording.road_map.lines),
        drivable=turned(recording.road_map.drivable),
        lanes=turned(recording.road_map.lanes),
    )
    states = move(recording.states, angle_rad=angle_rad, shift_m=shift_m)
    return dataclasses.replace(recording, states=states, road_map=road_map)
