"""Frames: what is where, in which colour."""

import dataclasses
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
from asp_env.render.canvas import SHADE
from asp_env.render.frames import CLASS_COLOURS, EGO_COLOUR, EGO_EDGE, FORECAST, draw_frame
from asp_env.render.ground import GROUND, PHOTO_STRENGTH, ROAD, draw_ground
from tests.builders import make_map

MAP = make_map()
HISTORY = 5


def make_scene(*agents: tuple[AgentClass, float, float, float]) -> Scene:
    """Agents (class, x, y, heading) of 4 m by 2 m that have not moved, the first one the ego."""
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
    """Modes of 20 m, to the north, the east, the south, of the scene's first target."""
    scene = scene.with_targets(scene.targets[:1])
    ways = np.array([(0, 20), (20, 0), (0, -20)], dtype=np.float32)[: len(probabilities)]
    share = np.linspace(0, 1, 11, dtype=np.float32)[1:, None]
    states = np.zeros((1, len(ways), 10, 4), dtype=np.float32)
    states[0, :, :, :2] = scene.target_states[0, :2] + ways[:, None] * share
    return make_forecast(
        scene,
        states=states,
        actions=None,
        log_probs=np.log(np.array([probabilities], dtype=np.float32)),
        valid=np.ones(1, dtype=bool),
    )


def pixel(image: np.ndarray, x_m: float, y_m: float, *, scale: float = 10.0) -> tuple[int, ...]:
    """The colour at a place relative to the middle of a picture."""
    height, width = image.shape[:2]
    return tuple(image[int(height / 2 - scale * y_m), int(width / 2 + scale * x_m)].tolist())


SIZE = {"size_px": (400, 400), "extent_m": 40.0}  # 10 pixels a metre


def test_places_and_colours() -> None:
    """The ego is in the middle; x goes right, y goes up; classes have their colours."""
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
    assert pixel(image, 0, -10) == GROUND  # the road is 7 m wide
    assert pixel(image, -10, 0) != GROUND
    assert pixel(image, -10, 1.7) == ROAD


def test_a_box_has_its_length_along_its_heading_and_a_wedge_at_its_front() -> None:
    """Heading +y: 4 m up, 2 m wide, dark wedge in the upper half and none in the lower."""
    scene = make_scene((AgentClass.CAR, 50.0, 40.0, np.pi / 2))
    image = draw_frame(scene, **SIZE)
    assert pixel(image, 0, 1.2) == SHADE
    assert pixel(image, 0, -1.2) == EGO_COLOUR
    assert pixel(image, 0.8, -1.8) == EGO_COLOUR
    assert pixel(image, 1.3, 0) == GROUND
    assert pixel(image, 0, 2.3) == GROUND
    assert pixel(image, 0, -1.97)[0] > (EGO_COLOUR[0] + EGO_EDGE[0]) / 2


def test_equal_arguments_give_equal_bits() -> None:
    """Whatever was drawn before, and the scene is left as it was."""
    scene = make_scene((AgentClass.CAR, 3.3, -1.7, 0.3), (AgentClass.VAN, 12.0, 1.7, 3.0))
    forecast = forecast_of(scene, (0.5, 0.3, 0.2))
    before = scene.states.copy()
    first = draw_frame(scene, forecast=forecast)
    for _ in range(ground.KEPT + 1):
        other = dataclasses.replace(scene, maps=(make_map(),))
        draw_frame(other)
    assert np.array_equal(draw_frame(scene, forecast=forecast), first)
    assert np.array_equal(scene.states, before)


def test_a_mode_is_drawn_the_wider_and_stronger_the_more_probable() -> None:
    """Modes to the north at 0.7 and to the east at 0.3, over ground: count and compare pixels."""
    scene = make_scene((AgentClass.CAR, 50.0, 40.0, np.pi / 4))
    plain = draw_frame(scene, **SIZE)
    image = draw_frame(scene, forecast=forecast_of(scene, (0.7, 0.3)), **SIZE)
    north = (image != plain).any(axis=-1)[40:120, 160:240]
    east = (image != plain).any(axis=-1)[160:240, 280:360]
    assert north.sum() > east.sum() > 80
    red = [abs(pixel(image, *at)[0] - FORECAST[0]) for at in ((0.0, 10.0), (10.0, 0.0))]
    assert red[0] < red[1]
    assert not (image != plain).any(axis=-1)[260:].any()


def test_a_plan_starts_at_the_ego_and_a_route_is_faint() -> None:
    """Both run 15 m to the west; the plan changes a pixel on its way more than the route does."""
    scene = make_scene((AgentClass.CAR, 50.0, 40.0, np.pi))
    way = np.stack([50 - np.arange(1, 16), np.full(15, 40)], axis=-1).astype(np.float32)
    plain = draw_frame(scene, **SIZE)
    planned = draw_frame(scene, plan=way, **SIZE)
    routed = draw_frame(
        dataclasses.replace(scene, route=way[None], route_valid=np.ones((1, 15), dtype=bool)),
        **SIZE,
    )
    change = [
        abs(np.subtract(pixel(image, -8, 0), pixel(plain, -8, 0))).sum()
        for image in (planned, routed)
    ]
    assert change[0] > change[1] > 0
    assert pixel(planned, -2.3, 0) != GROUND  # between the box and the first point
    assert pixel(planned, -17, 0) == GROUND


def test_trails_fade() -> None:
    """A car that came from the west at 10 m/s: its trail is fainter, the longer ago."""
    scene = make_scene((AgentClass.CAR, 50.0, 40.0, 0.0))
    states = scene.states.copy()
    states[0, 0, :, 0] -= 2.0 * np.arange(HISTORY, -1, -1)
    image = draw_frame(dataclasses.replace(scene, states=states), **SIZE)
    late, early = (pixel(image, at, 0)[2] for at in (-3.0, -9.0))
    assert late > early > GROUND[2]


@settings(max_examples=20, deadline=None)
@given(x=st.integers(-60, 60), y=st.integers(-60, 60))
def test_the_ground_moves_by_whole_pixels(x: int, y: int) -> None:
    """Seen from 1 m further east, the same ground lies 10 pixels further left."""
    _, one = draw_ground(MAP, None, (float(x), float(y)), 10.0, (120, 90))
    _, other = draw_ground(MAP, None, (x + 1.0, float(y)), 10.0, (120, 90))
    assert np.array_equal(one[:, 10:], other[:, :-10])


def test_a_large_map_is_drawn_as_a_small_one(monkeypatch: pytest.MonkeyPatch) -> None:
    """Only the part that shows, with the same bits, but for lines that the border cuts."""
    kept = draw_ground(MAP, None, (5.0, -2.0), 10.0, (300, 200))
    monkeypatch.setattr(ground, "MAX_PIXELS", 0)
    fresh = draw_ground(MAP, None, (5.0, -2.0), 10.0, (300, 200))
    assert fresh[0] == kept[0]
    assert np.array_equal(fresh[1][3:-3, 3:-3], kept[1][3:-3, 3:-3])
    assert (fresh[1] != GROUND).any()


def test_far_from_the_map_there_is_bare_ground() -> None:
    """No error, and one colour."""
    _, image = draw_ground(MAP, None, (5000.0, -5000.0), 10.0, (50, 40))
    assert (image == GROUND).all()


def test_the_whole_map_is_shown_without_an_extent() -> None:
    """All four ends of the crossing's roads, 100 m from its centre, are in the picture."""
    scene = make_scene((AgentClass.CAR, 90.0, 1.0, 0.0))
    image = draw_frame(scene, size_px=(500, 500), extent_m=None)
    scale = 500 / 200 / 1.06
    for x, y in ((95, -2), (-95, 2), (2, 95), (-2, -95)):
        assert pixel(image, x, y, scale=scale) == ROAD
    assert pixel(image, 90, 1, scale=scale) == EGO_COLOUR


def test_a_photograph_lies_where_its_scale_says(tmp_path: Path) -> None:
    """Pixel (column, row) of 0.5 m shows (column / 2, -row / 2): a red block of 10 m is found."""
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
        red = round(PHOTO_STRENGTH * 255 + (1 - PHOTO_STRENGTH) * GROUND[0])
        inside, outside = ((42.0, -22.0), (48.0, -28.0)), ((38.0, -25.0), (45.0, -18.0))
        assert {pixel(image, x - 20, y + 60, scale=scale)[0] for x, y in inside} == {red}
        assert all(pixel(image, x - 20, y + 60, scale=scale)[0] < 60 for x, y in outside)


def test_what_cannot_be_drawn_is_refused(tmp_path: Path) -> None:
    """One line each: no such situation, no size, no extent, no photograph."""
    scene = make_scene((AgentClass.CAR, 0.0, 0.0, 0.0))
    with pytest.raises(AspEnvError, match="situation 1: the scene has 1"):
        draw_frame(scene, situation=1)
    with pytest.raises(AspEnvError, match="at least 1 pixel"):
        draw_frame(scene, size_px=(0, 10))
    with pytest.raises(AspEnvError, match="expected a positive number or None"):
        draw_frame(scene, extent_m=0.0)
    with pytest.raises(DataError, match="not a picture that can be read"):
        draw_frame(scene, background=Background(path=tmp_path / "no.png", metres_per_pixel=0.1))


def test_people_are_never_too_small_to_be_seen() -> None:
    """At 1 pixel a metre a pedestrian is 8 pixels wide with its dark edge, and has no wedge."""
    scene = make_scene((AgentClass.CAR, 0.0, 0.0, 0.0), (AgentClass.PEDESTRIAN, 20.0, 0.0, 0.0))
    image = draw_frame(scene, size_px=(100, 100), extent_m=100.0)
    people = (image == CLASS_COLOURS[AgentClass.PEDESTRIAN]).all(axis=-1)
    rows, columns = np.nonzero(people)
    assert 16 <= len(rows) <= 36
    assert np.abs(rows - 49.5).max() <= 3
    assert np.abs(columns - 69.5).max() <= 3


def test_the_road_goes_on_beyond_the_photograph(tmp_path: Path) -> None:
    """A photograph of 10 m by 10 m below the crossing: the road in the north keeps its colour."""
    path = tmp_path / "00_background.png"
    assert cv2.imwrite(str(path), np.full((100, 100, 3), 255, dtype=np.uint8))
    background = Background(path=path, metres_per_pixel=0.1)
    scene = make_scene((AgentClass.CAR, -20.0, 1.75, 0.0))
    image = draw_frame(scene, background=background, **SIZE)
    assert pixel(image, 10, 0) == ROAD
    scene = make_scene((AgentClass.CAR, 0.0, 1.75, 0.0))
    image = draw_frame(scene, background=background, **SIZE)
    assert pixel(image, 5, -3.0)[0] > 150


def test_of_an_earlier_forecast_the_rest_is_shown() -> None:
    """Ten steps of 2 m to the north, said 3 ticks ago: the first point is the fourth, at 8 m."""
    scene = make_scene((AgentClass.CAR, 50.0, 40.0, np.pi / 2))
    forecast = forecast_of(scene, (1.0,))
    late = dataclasses.replace(forecast, tick=forecast.tick - 3)
    bent = late.states.copy()
    bent[:, :, :3, 0] += 30.0
    assert np.array_equal(
        draw_frame(scene, forecast=late, **SIZE),
        draw_frame(scene, forecast=dataclasses.replace(late, states=bent), **SIZE),
    )
    gone = dataclasses.replace(forecast, tick=forecast.tick - 10)
    assert np.array_equal(draw_frame(scene, forecast=gone, **SIZE), draw_frame(scene, **SIZE))
