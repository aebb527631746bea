"""Laws on the input of predictors: neither the future nor the frame of the recording matters."""

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
    PHYSICAL,
    RECORDING,
    TRAINED,
    Case,
    assert_same,
    every,
    predict,
    situations,
    snippets_for,
    with_predictors,
)

equivariant = with_predictors(PHYSICAL + tuple(case for case in TRAINED if case.view == "vectors"))


@every
def test_unprivileged_predictors_read_no_future(predictor: Predictor) -> None:
    """A wrong future does not change the forecast of a predictor that is not privileged."""
    scene, future = situations(predictor)
    false = Future(states=future.states + 50, valid=future.valid)
    if predictor.privileged:
        true = predictor.predict(scene, future)
        assert not np.array_equal(true.states, predictor.predict(scene, false).states)
    else:
        assert_same(predictor.predict(scene), predictor.predict(scene, false))


@every
def test_later_frames_change_nothing(predictor: Predictor) -> None:
    """A recording that differs from the next frame on yields the same bits.

    In it all agents move elsewhere, one leaves and another one appears. Privileged predictors
    forecast something else.
    """
    index = snippets_for(predictor)
    index = index.select(index.tick == 30)
    assert len(index) > 3
    other = with_another_future(RECORDING, frame=30 * 5)
    before, after = (
        predict(predictor, gather_scene([r], index), gather_future([r], index))
        for r in (RECORDING, other)
    )
    if predictor.privileged:
        assert not np.array_equal(before.states, after.states)
    else:
        assert_same(before, after)


@pytest.mark.parametrize("chaining", CHAININGS)
def test_only_the_chaining_oracle_is_privileged(chaining: str, folder: Path) -> None:
    """It needs a future; beam, top-1 and full need none."""
    case = Case("ssp-asp", "vectors", chaining)
    predictor = load_predictor(case.save(folder), horizon=case.horizon, dt_s=0.2)
    assert predictor.privileged == (chaining == "oracle")
    assert predictor.metadata["chaining"] == chaining
    if predictor.privileged:
        with pytest.raises(AspEnvError, match="needs the recorded future of 30 ticks"):
            predictor.predict(situations(predictor)[0])


@equivariant
def test_forecasts_are_equivariant(predictor: Predictor) -> None:
    """Rotating the world by 1 rad and shifting it by (30, -20) m does the same to the forecast.

    To 0.1 mm or, for positions up to 1 km away, to 0.5 mm, since headings are 32-bit numbers.
    """
    recording = without_symmetry(RECORDING)
    scene, future = situations(predictor, recording)
    moved_scene, moved_future = situations(
        predictor, moved(recording, angle_rad=1.0, shift_m=(30.0, -20.0))
    )
    forecast = predict(predictor, scene, future)
    expected = move(forecast.states, angle_rad=1.0, shift_m=(30.0, -20.0))
    found = predict(predictor, moved_scene, moved_future)
    atol_m = max(1e-4, 5e-7 * float(np.abs(expected[..., :2]).max()))
    np.testing.assert_allclose(found.states[..., :2], expected[..., :2], atol=atol_m)
    np.testing.assert_allclose(wrap_angle(found.states[..., 2] - expected[..., 2]), 0, atol=1e-4)
    np.testing.assert_allclose(found.states[..., 3], expected[..., 3], atol=1e-4)
    np.testing.assert_allclose(found.log_probs, forecast.log_probs, atol=1e-4)


def with_another_future(recording: Recording, *, frame: int) -> Recording:
    """Equal up to a frame; then all agents are elsewhere, the first has left, one has appeared."""
    added = Drive(kind=AgentClass.CAR, start=(5.0, 5.0, 1.0, 3.0), appears_s=(frame + 1) / 25)
    first = dataclasses.replace(DRIVES[0], leaves_s=frame / 25)
    other = make_recording(drives=(first, *DRIVES[1:], added), road_map=recording.road_map)
    lengths = np.diff(other.starts)
    rows = np.arange(len(other.states)) - np.repeat(other.starts[:-1], lengths)
    frames = np.repeat(other.first_frames, lengths) + rows
    states = other.states.copy()
    states[frames > frame] += np.float32(40.0)
    return dataclasses.replace(other, states=states)


def move(states: np.ndarray, *, angle_rad: float, shift_m: tuple[float, float]) -> np.ndarray:
    """States [x, y, heading, speed] rotated about the origin, then shifted."""
    heading = wrap_angle(states[..., 2] + angle_rad)
    xy = move_points(states[..., :2], angle_rad=angle_rad, shift_m=shift_m)
    return np.concatenate([xy, heading[..., None], states[..., 3:]], axis=-1).astype(states.dtype)


def move_points(
    points: np.ndarray, *, angle_rad: float, shift_m: tuple[float, float]
) -> np.ndarray:
    """Points [x, y] rotated about the origin, then shifted."""
    cos, sin = np.cos(angle_rad), np.sin(angle_rad)
    x = cos * points[..., 0] - sin * points[..., 1] + shift_m[0]
    y = sin * points[..., 0] + cos * points[..., 1] + shift_m[1]
    return np.stack([x, y], axis=-1)


def without_symmetry(recording: Recording) -> Recording:
    """The recording with shifted lines, so that no two are equally near."""
    lines = recording.road_map.lines
    lines = dataclasses.replace(lines, points=lines.points + np.array([0.13, 0.07]))
    return dataclasses.replace(
        recording, road_map=dataclasses.replace(recording.road_map, lines=lines)
    )


def moved(recording: Recording, *, angle_rad: float, shift_m: tuple[float, float]) -> Recording:
    """The recording and its map rotated about the origin, then shifted."""

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
