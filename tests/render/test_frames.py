"""Tests of frames: positions and colours."""

import dataclasses
import struct
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from asp_env.data.classes import AgentClass
from asp_env.data.predictor import Forecast, make_forecast
from asp_env.data.recording import Background
from asp_env.data.scene import Scene
from asp_env.errors import AspEnvError, DataError
from asp_env.render import ground
from asp_env.render.canvas import SHADE_COLOUR
from asp_env.render.frames import (
    CLASS_COLOURS,
    EGO_COLOUR,
    EGO_EDGE_COLOUR,
    FORECAST_COLOUR,
    draw_frame,
)
from asp_env.render.ground import GROUND_COLOUR, PHOTO_STRENGTH, ROAD_COLOUR, draw_ground
from tests.builders import make_map

MAP = make_map()
HISTORY = 5


def make_scene(*agents: tuple[AgentClass, float, float, float]) -> Scene:
    """Standing agents (class, x, y, heading) of 4 m by 2 m, the ego first."""
    count = len(agents)
    poses = np.array([agent[1:] for agent in agents], dtype=np.float32)
    now = np.concatenate([poses, np.zeros((count, 1), dtype=np.float32)], axis=1)
    states = np.repeat(now[None, :, None], HISTORY + 1, axis=2)
    return Scene(
        states=states,
        actions=np.zeros((1, count, HISTORY, 2), dtype=np.float32),
        valid=np.ones((1, count, HISTORY + 1), dtype=bool),
        sizes=np.tile(np.array([4, 2], dtype=np.float32), (1, count, 1)),
        classes=np.array([[int(agent[0]) for agent in agents]]),
        ids=np.arange(count)[None],
        tick=np.array([62]),
        targets=np.array([(0, slot) for slot in range(count)]),
        route=np.zeros((1, 0, 2), dtype=np.float32),
        route_valid=np.zeros((1, 0), dtype=bool),
        maps=(MAP,),
        map_index=np.array([0]),
        dt_s=0.2,
    )


def forecast_of(scene: Scene, probabilities: tuple[float, ...]) -> Forecast:
    """Modes of 20 m to the north, east and south for the first target of the scene."""
    scene = scene.with_targets(scene.targets[:1])
    ends = np.array([(0, 20), (20, 0), (0, -20)], dtype=np.float32)[: len(probabilities)]
    share = np.linspace(0, 1, 11, dtype=np.float32)[1:, None]
    states = np.zeros((1, len(ends), 10, 4), dtype=np.float32)
    states[0, :, :, :2] = scene.target_states[0, :2] + ends[:, None] * share
    return make_forecast(
        scene,
        states=states,
        actions=None,
        log_probs=np.log(np.array([probabilities], dtype=np.float32)),
        valid=np.ones(1, dtype=bool),
    )


def pixel(image: np.ndarray, x_m: float, y_m: float, *, scale: float = 10.0) -> tuple[int, ...]:
    """The colour at a point relative to the middle of an image, in metres."""
    height, width = image.shape[:2]
    return tuple(image[int(height / 2 - scale * y_m), int(width / 2 + scale * x_m)].tolist())


SIZE = {"size_px": (400, 400), "extent_m": 40.0}  # 10 pixels per metre


def test_positions_and_colours() -> None:
    """The ego is in the middle, x points right and y up, each class has its colour."""
    scene = make_scene(
        (AgentClass.CAR, 50.0, 0.0, 0.0),
        (AgentClass.TRUCK, 60.0, 1.0, 0.0),
        (AgentClass.PEDESTRIAN, 50.0, 10.0, 0.0),
    )
    image = draw_frame(scene, **SIZE)
    assert image.shape == (400, 400, 3)
    assert pixel(image, 0, 0) == EGO_COLOUR
    assert pixel(image, 10, 1) == CLASS_COLOURS[AgentClass.TRUCK]
    assert pixel(image, 0, 10) == CLASS_COLOURS[AgentClass.PEDESTRIAN]
    assert pixel(image, 0, -10) == GROUND_COLOUR  # the road is 7 m wide
    assert pixel(image, -10, 0) != GROUND_COLOUR
    assert pixel(image, -10, 1.7) == ROAD_COLOUR


def test_boxes_point_along_the_heading() -> None:
    """With heading +y a box is 4 m high and 2 m wide, with a dark wedge in its upper half."""
    scene = make_scene((AgentClass.CAR, 50.0, 40.0, np.pi / 2))
    image = draw_frame(scene, **SIZE)
    assert pixel(image, 0, 1.2) == SHADE_COLOUR
    assert pixel(image, 0, -1.2) == EGO_COLOUR
    assert pixel(image, 0.8, -1.8) == EGO_COLOUR
    assert pixel(image, 1.3, 0) == GROUND_COLOUR
    assert pixel(image, 0, 2.3) == GROUND_COLOUR
    assert pixel(image, 0, -1.97)[0] > (EGO_COLOUR[0] + EGO_EDGE_COLOUR[0]) / 2


def test_equal_arguments_give_equal_bits() -> None:
    """Frames do not depend on frames drawn before, and drawing does not change the scene."""
    scene = make_scene((AgentClass.CAR, 3.3, -1.7, 0.3), (AgentClass.VAN, 12.0, 1.7, 3.0))
    forecast = forecast_of(scene, (0.5, 0.3, 0.2))
    before = scene.states.copy()
    first = draw_frame(scene, forecast=forecast)
    for _ in range(ground.CACHE_SIZE + 1):
        other = dataclasses.replace(scene, maps=(make_map(),))
        draw_frame(other)
    assert np.array_equal(draw_frame(scene, forecast=forecast), first)
    assert np.array_equal(scene.states, before)


def test_probable_modes_are_wider_and_more_opaque() -> None:
    """Modes to the north and east have probabilities of 0.7 and 0.3."""
    scene = make_scene((AgentClass.CAR, 50.0, 40.0, np.pi / 4))
    plain = draw_frame(scene, **SIZE)
    image = draw_frame(scene, forecast=forecast_of(scene, (0.7, 0.3)), **SIZE)
    north = (image != plain).any(axis=-1)[40:120, 160:240]
    east = (image != plain).any(axis=-1)[160:240, 280:360]
    assert north.sum() > east.sum() > 80
    red = [abs(pixel(image, *at)[0] - FORECAST_COLOUR[0]) for at in ((0.0, 10.0), (10.0, 0.0))]
    assert red[0] < red[1]
    assert not (image != plain).any(axis=-1)[260:].any()


def test_a_plan_starts_at_the_ego_and_is_more_opaque_than_the_route() -> None:
    """Both extend 15 m to the west."""
    scene = make_scene((AgentClass.CAR, 50.0, 40.0, np.pi))
    path = np.stack([50 - np.arange(1, 16), np.full(15, 40)], axis=-1).astype(np.float32)
    plain = draw_frame(scene, **SIZE)
    planned = draw_frame(scene, plan=path, **SIZE)
    routed = draw_frame(
        dataclasses.replace(scene, route=path[None], route_valid=np.ones((1, 15), dtype=bool)),
        **SIZE,
    )
    change = [
        abs(np.subtract(pixel(image, -8, 0), pixel(plain, -8, 0))).sum()
        for image in (planned, routed)
    ]
    assert change[0] > change[1] > 0
    assert pixel(planned, -2.3, 0) != GROUND_COLOUR  # between the box and the first point
    assert pixel(planned, -17, 0) == GROUND_COLOUR


def test_trails_fade() -> None:
    """The trail of a car that came from the west at 10 m/s."""
    scene = make_scene((AgentClass.CAR, 50.0, 40.0, 0.0))
    states = scene.states.copy()
    states[0, 0, :, 0] -= 2.0 * np.arange(HISTORY, -1, -1)
    image = draw_frame(dataclasses.replace(scene, states=states), **SIZE)
    late, early = (pixel(image, at, 0)[2] for at in (-3.0, -9.0))
    assert late > early > GROUND_COLOUR[2]


@settings(max_examples=20, deadline=None)
@given(x=st.integers(-60, 60), y=st.integers(-60, 60))
def test_the_ground_moves_by_whole_pixels(x: int, y: int) -> None:
    """From 1 m further east, the same ground is 10 pixels further left."""
    _, one = draw_ground(MAP, None, (float(x), float(y)), 10.0, (120, 90))
    _, other = draw_ground(MAP, None, (x + 1.0, float(y)), 10.0, (120, 90))
    assert np.array_equal(one[:, 10:], other[:, :-10])


def test_maps_that_are_too_large_for_the_cache_look_the_same(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Pixels are equal except at the border, which cuts lines."""
    cached = draw_ground(MAP, None, (5.0, -2.0), 10.0, (300, 200))
    monkeypatch.setattr(ground, "MAX_PIXELS", 0)
    uncached = draw_ground(MAP, None, (5.0, -2.0), 10.0, (300, 200))
    assert uncached[0] == cached[0]
    assert np.array_equal(uncached[1][3:-3, 3:-3], cached[1][3:-3, 3:-3])
    assert (uncached[1] != GROUND_COLOUR).any()


def test_far_from_the_map_there_is_bare_ground() -> None:
    _, image = draw_ground(MAP, None, (5000.0, -5000.0), 10.0, (50, 40))
    assert (image == GROUND_COLOUR).all()


def test_the_whole_map_is_shown_without_an_extent() -> None:
    """The image includes the ends of all four roads, 100 m from the centre."""
    scene = make_scene((AgentClass.CAR, 90.0, 1.0, 0.0))
    image = draw_frame(scene, size_px=(500, 500), extent_m=None)
    scale = 500 / 200 / 1.06
    for x, y in ((95, -2), (-95, 2), (2, 95), (-2, -95)):
        assert pixel(image, x, y, scale=scale) == ROAD_COLOUR
    assert pixel(image, 90, 1, scale=scale) == EGO_COLOUR


def test_the_background_image_has_the_right_position(tmp_path: Path) -> None:
    """Pixel (column, row) of 0.5 m shows the point (column / 2, -row / 2)."""
    photo = np.zeros((80, 120, 3), dtype=np.uint8)
    photo[40:60, 80:100] = (0, 0, 255)  # OpenCV writes blue, green, red
    path = tmp_path / "00_background.png"
    assert cv2.imwrite(str(path), photo)
    background = Background(path=path, metres_per_pixel=0.5)
    scene = make_scene((AgentClass.CAR, 20.0, -60.0, 0.0))
    for scale, size in ((10.0, 800), (1.0, 80)):
        image = draw_frame(
            scene, size_px=(size, size), extent_m=size / scale, background=background
        )
        red = round(PHOTO_STRENGTH * 255 + (1 - PHOTO_STRENGTH) * GROUND_COLOUR[0])
        inside, outside = ((42.0, -22.0), (48.0, -28.0)), ((38.0, -25.0), (45.0, -18.0))
        assert {pixel(image, x - 20, y + 60, scale=scale)[0] for x, y in inside} == {red}
        assert all(pixel(image, x - 20, y + 60, scale=scale)[0] < 60 for x, y in outside)


def test_bad_arguments_are_refused(tmp_path: Path) -> None:
    scene = make_scene((AgentClass.CAR, 0.0, 0.0, 0.0))
    with pytest.raises(AspEnvError, match="situation 1: the scene has 1"):
        draw_frame(scene, situation=1)
    with pytest.raises(AspEnvError, match="at least 1 pixel"):
        draw_frame(scene, size_px=(0, 10))
    with pytest.raises(AspEnvError, match="expected a positive number or None"):
        draw_frame(scene, extent_m=0.0)
    with pytest.raises(DataError, match="not an image that can be read"):
        draw_frame(scene, background=Background(path=tmp_path / "no.png", metres_per_pixel=0.1))
    huge = tmp_path / "huge.png"
    cv2.imwrite(str(huge), np.zeros((2, 2, 3), dtype=np.uint8))
    content = huge.read_bytes()
    header = b"IHDR" + struct.pack(">II", 65_535, 65_535) + content[24:29]
    checksum = struct.pack(">I", zlib.crc32(header))
    huge.write_bytes(content[:12] + header + checksum + content[33:])
    with pytest.raises(DataError, match=r"huge\.png: not an image that can be read"):
        draw_frame(scene, background=Background(path=huge, metres_per_pixel=0.1))


def test_pedestrians_are_always_visible() -> None:
    """At 1 pixel per metre a pedestrian is 8 pixels wide with its dark edge, without a wedge."""
    scene = make_scene((AgentClass.CAR, 0.0, 0.0, 0.0), (AgentClass.PEDESTRIAN, 20.0, 0.0, 0.0))
    image = draw_frame(scene, size_px=(100, 100), extent_m=100.0)
    pedestrian = (image == CLASS_COLOURS[AgentClass.PEDESTRIAN]).all(axis=-1)
    rows, columns = np.nonzero(pedestrian)
    assert 16 <= len(rows) <= 36
    assert np.abs(rows - 49.5).max() <= 3
    assert np.abs(columns - 69.5).max() <= 3


def test_the_road_is_drawn_beyond_the_background_image(tmp_path: Path) -> None:
    """The image covers 10 m by 10 m south of the crossing, the road is north of it."""
    path = tmp_path / "00_background.png"
    assert cv2.imwrite(str(path), np.full((100, 100, 3), 255, dtype=np.uint8))
    background = Background(path=path, metres_per_pixel=0.1)
    scene = make_scene((AgentClass.CAR, -20.0, 1.75, 0.0))
    image = draw_frame(scene, background=background, **SIZE)
    assert pixel(image, 10, 0) == ROAD_COLOUR
    scene = make_scene((AgentClass.CAR, 0.0, 1.75, 0.0))
    image = draw_frame(scene, background=background, **SIZE)
    assert pixel(image, 5, -3.0)[0] > 150


def test_only_the_remaining_steps_of_an_earlier_forecast_are_shown() -> None:
    """Of ten steps forecast 3 ticks ago, the first three do not change the frame."""
    scene = make_scene((AgentClass.CAR, 50.0, 40.0, np.pi / 2))
    forecast = forecast_of(scene, (1.0,))
    earlier = dataclasses.replace(forecast, tick=forecast.tick - 3)
    bent = earlier.states.copy()
    bent[:, :, :3, 0] += 30.0
    assert np.array_equal(
        draw_frame(scene, forecast=earlier, **SIZE),
        draw_frame(scene, forecast=dataclasses.replace(earlier, states=bent), **SIZE),
    )
    expired = dataclasses.replace(forecast, tick=forecast.tick - 10)
    assert np.array_equal(draw_frame(scene, forecast=expired, **SIZE), draw_frame(scene, **SIZE))
