"""The MTP view: what is drawn where and in which colour."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from asp_env.data.classes import AgentClass
from asp_env.data.road_map import LineType
from asp_env.errors import AspEnvError
from asp_env.views.mtp import MTP
from tests.views.scenes import busy_scene, make_map, make_scene, standing, traffic

BLACK, WHITE, RED = (0, 0, 0), (255, 255, 255), (255, 0, 0)
YELLOW, VIOLET, ORANGE = (255, 255, 0), (204, 0, 204), (255, 153, 51)
BLUE, LIGHT_BLUE = (0, 0, 255), (0, 153, 255)

SMALL = MTP.make((90, 90))
ROAD = make_map(
    [
        (LineType.CURB, [(-60, 6), (60, 6)]),
        (LineType.SOLID, [(-60, -6), (60, -6)]),
        (LineType.DASHED, [(-60, 0), (60, 0)]),
        (LineType.VIRTUAL, [(-60, -3), (60, -3)]),
    ],
    [[(-60, -6), (60, -6), (60, 6), (-60, 6)]],
)
"""A road along x, 12 m wide."""


def colour(raster: np.ndarray, row: int, column: int) -> tuple[int, ...]:
    """Red, green and blue of one pixel."""
    return tuple(int(value) for value in raster[:, row, column])


def only_at(state: int, agents: int = 2) -> np.ndarray:
    """Validity (1, agents, 16): all agents are present now except the last, which is at `state`."""
    valid = np.zeros((1, agents, 16), dtype=bool)
    valid[0, :-1, -1] = valid[0, -1, state] = True
    return valid


def test_channels() -> None:
    assert MTP().shape == (3, 360, 360)
    assert MTP.channels == ("red", "green", "blue")
    assert 0.2 * MTP().history == 2.0


def test_the_ground_by_hand() -> None:
    """Lines 6 m to the left and right are 30 pixels from column 180 and 1.5 pixels wide."""
    raster = MTP().render(make_scene(standing([(0.0, 0.0, 0.0)]), maps=(ROAD,)))[0]
    row = [colour(raster, 138, column) for column in range(140, 220)]
    # 149.25 to 150.75, 179.25 to 180.75 and 209.25 to 210.75 contain two pixel centres each
    expected = {149: BLUE, 150: BLUE, 179: LIGHT_BLUE, 180: LIGHT_BLUE, 209: BLUE, 210: BLUE}
    for column in range(140, 220):
        ground = WHITE if 150 <= column < 210 else BLACK
        assert row[column - 140] == expected.get(column, ground)


def test_the_target_by_hand() -> None:
    """A car of 4 m by 2 m is 20 by 10 red pixels around row 288 and column 180, over the lines."""
    raster = MTP().render(make_scene(standing([(0.0, 0.0, 0.0)]), maps=(ROAD,)))[0]
    red = (raster == np.array(RED)[:, None, None]).all(axis=0)
    expected = np.zeros((360, 360), dtype=bool)
    expected[278:298, 175:185] = True
    np.testing.assert_array_equal(red, expected)


@pytest.mark.parametrize("kind", list(AgentClass))
def test_colours_of_classes(kind: AgentClass) -> None:
    """10 m ahead and 6 m to the left is row 238 and column 150."""
    human = (AgentClass.PEDESTRIAN, AgentClass.BICYCLE, AgentClass.ANIMAL)
    expected = ORANGE if kind in human else VIOLET if kind == AgentClass.OTHER else YELLOW
    for heading in (0.0, 0.5 * math.pi, 2.0):
        cos, sin = math.cos(heading), math.sin(heading)
        there = (5.0 + 10 * cos - 6 * sin, 9.0 + 10 * sin + 6 * cos, heading)
        scene = make_scene(
            standing([(5.0, 9.0, heading), there]), classes=np.array([[0, int(kind)]])
        )
        raster = MTP().render(scene)[0]
        assert colour(raster, 238, 150) == expected
        assert colour(raster, 238, 210) == BLACK


def test_a_target_of_any_class_is_red() -> None:
    """In the rasters of other targets it has the colour of its class."""
    states = standing([(0.0, 0.0, 0.0), (10.0, 0.0, 0.0)])
    classes = np.array([[int(AgentClass.PEDESTRIAN), int(AgentClass.CAR)]])
    rasters = MTP().render(make_scene(states, classes=classes, targets=[(0, 0), (0, 1)]))
    assert colour(rasters[0], 288, 180) == RED
    assert colour(rasters[0], 238, 180) == YELLOW
    assert colour(rasters[1], 338, 180) == ORANGE


FADED = {
    # (state of 16, class): values 0.4 + 0.06 k, k = 0 at state 5 and 10 at state 15
    (5, AgentClass.CAR): (102, 102, 0),
    (9, AgentClass.CAR): (163, 163, 0),  # 0.64 · 255 = 163.2
    (14, AgentClass.CAR): (240, 240, 0),  # 0.94 · 255 = 239.7
    (15, AgentClass.CAR): YELLOW,
    (5, AgentClass.PEDESTRIAN): (102, 61, 20),  # 0.4 · (255, 153, 51) = (102, 61.2, 20.4)
    (9, AgentClass.PEDESTRIAN): (163, 98, 33),  # 0.64 · (255, 153, 51) = (163.2, 97.9, 32.6)
    # Violet is darker: its value increases from 0.4 to 0.8, by 0.04 per tick.
    (5, AgentClass.OTHER): (102, 0, 102),
    (9, AgentClass.OTHER): (143, 0, 143),  # 0.56 · 255 = 142.8
    (15, AgentClass.OTHER): VIOLET,
    (4, AgentClass.CAR): BLACK,
    (0, AgentClass.CAR): BLACK,
}


@pytest.mark.parametrize(("state", "kind"), FADED)
def test_the_past_fades(state: int, kind: AgentClass) -> None:
    """Two seconds ago a box has 0.4 of full brightness; older boxes are not drawn."""
    scene = make_scene(
        standing([(0.0, 0.0, 0.0), (10.0, 6.0, 0.0)]),
        valid=only_at(state),
        classes=np.array([[0, int(kind)]]),
    )
    assert colour(MTP().render(scene)[0], 238, 150) == FADED[state, kind]


def test_the_targets_own_past_fades() -> None:
    """At 5 m/s it was 10 m back two seconds ago, at row 338; its oldest box extends 2 m further."""
    states = standing([(0.0, 0.0, 0.0)])
    states[0, 0, :, 0] = 5 * 0.2 * np.arange(-15, 1)
    raster = MTP().render(make_scene(states))[0]
    assert colour(raster, 347, 180) == (102, 0, 0)
    assert colour(raster, 348, 180) == BLACK
    # Boxes are 1 m apart: the last metre of each earlier one is visible, 5 rows.
    shown = [colour(raster, row, 180)[0] for row in range(347, 297, -5)]
    assert shown == [102, 117, 133, 148, 163, 178, 194, 209, 224, 240]


def test_past_of_a_left_hand_curve_lies_behind_on_the_left() -> None:
    angle = np.linspace(-0.9, 0.0, 16)
    states = np.zeros((1, 1, 16, 4))
    states[0, 0] = np.stack(
        [20 * np.sin(angle), 20 - 20 * np.cos(angle), angle, np.full(16, 6.0)], axis=1
    )
    red = MTP().render(make_scene(states))[0, 0]
    # Two seconds ago, at an angle of 0.6, its centre was 11.29 m back and 3.49 m to the left, and a
    # point 1.8 m behind that 12.78 m and 4.51 m: 63.9 rows and 22.5 columns.
    assert red[288 + 63, 180 - 23] == 102
    assert red[298:, 185:].max() == 0


def pixel_of_two(
    first: AgentClass, second: AgentClass, states: tuple[int, int] = (15, 15)
) -> tuple[int, ...]:
    """The pixel of two agents at the same position, each present at one state."""
    valid = only_at(states[1], agents=3)
    valid[0, 1] = False
    valid[0, 1, states[0]] = True
    scene = make_scene(
        standing([(0.0, 0.0, 0.0), (10.0, 6.0, 0.0), (10.0, 6.0, 0.0)]),
        valid=valid,
        classes=np.array([[0, int(first), int(second)]]),
    )
    return colour(MTP().render(scene)[0], 238, 150)


@pytest.mark.parametrize("swapped", [False, True])
def test_who_lies_above(swapped: bool) -> None:
    """Humans above objects above vehicles at one tick; what is newer above all that is older."""

    def two(below: AgentClass, above: AgentClass, states: tuple[int, int]) -> tuple[int, ...]:
        if swapped:
            return pixel_of_two(above, below, (states[1], states[0]))
        return pixel_of_two(below, above, states)

    car, thing, human = AgentClass.CAR, AgentClass.OTHER, AgentClass.PEDESTRIAN
    assert two(car, thing, (15, 15)) == VIOLET
    assert two(thing, human, (15, 15)) == ORANGE
    assert two(car, human, (15, 15)) == ORANGE
    assert two(human, car, (14, 15)) == YELLOW
    assert two(car, car, (5, 15)) == YELLOW


def test_the_target_is_drawn_over_all_other_agents() -> None:
    """Its present and its oldest box cover standing pedestrians."""
    states = standing([(0.0, 0.0, 0.0), (0.0, 0.0, 0.0), (-10.0, 0.0, 0.0)])
    states[0, 0, :, 0] = 5 * 0.2 * np.arange(-15, 1)
    classes = np.array([[0, *[int(AgentClass.PEDESTRIAN)] * 2]])
    raster = MTP().render(make_scene(states, classes=classes))[0]
    assert colour(raster, 288, 180) == RED
    assert colour(raster, 347, 180) == (102, 0, 0)


def test_a_scene_without_targets_gives_no_rasters() -> None:
    assert SMALL.render(make_scene(standing([(0.0, 0.0, 0.0)]), targets=[])).shape == (0, 3, 90, 90)


def test_longer_histories_are_cut_and_shorter_ones_rejected() -> None:
    states = traffic(0)
    np.testing.assert_array_equal(
        SMALL.render(make_scene(states)), SMALL.render(make_scene(states[:, :, 5:]))
    )
    with pytest.raises(AspEnvError, match="needs 10 past ticks, the scene has 9"):
        SMALL.render(make_scene(states[:, :, 6:]))


def test_arrays_that_do_not_fit_are_rejected() -> None:
    with pytest.raises(AspEnvError, match=r"uint8 \(5, 3, 90, 90\)"):
        SMALL.render(busy_scene(), np.zeros((5, 12, 90, 60), dtype=np.uint8))


@given(
    x=st.floats(5, 50), y=st.floats(-30, 30), heading=st.floats(-3, 3), ego_heading=st.floats(-3, 3)
)
def test_pedestrians_are_visible_at_coarse_scale(
    x: float, y: float, heading: float, ego_heading: float
) -> None:
    """0.5 m by 0.5 m at 0.8 m per pixel sets one to four orange pixels."""
    cos, sin = math.cos(ego_heading), math.sin(ego_heading)
    scene = make_scene(
        standing([(0.0, 0.0, ego_heading), (cos * x - sin * y, sin * x + cos * y, heading)]),
        size_m=(0.5, 0.5),
        classes=np.array([[0, int(AgentClass.PEDESTRIAN)]]),
        maps=(ROAD,),
    )
    orange = (SMALL.render(scene)[0] == np.array(ORANGE)[:, None, None]).all(axis=0).sum()
    assert 1 <= orange <= 4
