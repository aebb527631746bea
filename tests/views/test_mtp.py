"""The MTP view: what is drawn where, in which colour."""

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


def colour(picture: np.ndarray, row: int, column: int) -> tuple[int, ...]:
    """Red, green and blue of a pixel."""
    return tuple(int(value) for value in picture[:, row, column])


def only_at(state: int, agents: int = 2) -> np.ndarray:
    """Validity (1, agents, 16): all are there now but the last, which is there at one state."""
    valid = np.zeros((1, agents, 16), dtype=bool)
    valid[0, :-1, -1] = valid[0, -1, state] = True
    return valid


def test_channels() -> None:
    """Red, green and blue, 3x360x360 by default, from two seconds of history."""
    assert MTP().shape == (3, 360, 360)
    assert MTP.channels == ("red", "green", "blue")
    assert 0.2 * MTP.history == 2.0


def test_the_ground_by_hand() -> None:
    """Lines 6 m to the left and right are 30 pixels from column 180, 1.5 wide; between is road."""
    picture = MTP().draw(make_scene(standing([(0.0, 0.0, 0.0)]), maps=(ROAD,)))[0]
    row = [colour(picture, 138, column) for column in range(140, 220)]
    # 149.25 to 150.75, 179.25 to 180.75 and 209.25 to 210.75: the middles of two pixels each.
    expected = {149: BLUE, 150: BLUE, 179: LIGHT_BLUE, 180: LIGHT_BLUE, 209: BLUE, 210: BLUE}
    for column in range(140, 220):
        ground = WHITE if 150 <= column < 210 else BLACK
        assert row[column - 140] == expected.get(column, ground)


def test_the_target_by_hand() -> None:
    """A car of 4 m by 2 m is 20 by 10 red pixels around row 288 and column 180, above its lines."""
    picture = MTP().draw(make_scene(standing([(0.0, 0.0, 0.0)]), maps=(ROAD,)))[0]
    red = (picture == np.array(RED)[:, None, None]).all(axis=0)
    expected = np.zeros((360, 360), dtype=bool)
    expected[278:298, 175:185] = True
    np.testing.assert_array_equal(red, expected)


@pytest.mark.parametrize("kind", list(AgentClass))
def test_colours_of_classes(kind: AgentClass) -> None:
    """10 m ahead and 6 m to the left, row 238 and column 150, in its class's colour."""
    human = (AgentClass.PEDESTRIAN, AgentClass.BICYCLE, AgentClass.ANIMAL)
    expected = ORANGE if kind in human else VIOLET if kind == AgentClass.OTHER else YELLOW
    for heading in (0.0, 0.5 * math.pi, 2.0):
        cos, sin = math.cos(heading), math.sin(heading)
        there = (5.0 + 10 * cos - 6 * sin, 9.0 + 10 * sin + 6 * cos, heading)
        scene = make_scene(
            standing([(5.0, 9.0, heading), there]), classes=np.array([[0, int(kind)]])
        )
        picture = MTP().draw(scene)[0]
        assert colour(picture, 238, 150) == expected
        assert colour(picture, 238, 210) == BLACK


def test_the_target_is_red_of_any_class() -> None:
    """As a pedestrian, too; and seen from another, it has the colour of its class."""
    states = standing([(0.0, 0.0, 0.0), (10.0, 0.0, 0.0)])
    classes = np.array([[int(AgentClass.PEDESTRIAN), int(AgentClass.CAR)]])
    pictures = MTP().draw(make_scene(states, classes=classes, targets=[(0, 0), (0, 1)]))
    assert colour(pictures[0], 288, 180) == RED
    assert colour(pictures[0], 238, 180) == YELLOW
    assert colour(pictures[1], 338, 180) == ORANGE


FADED = {
    # (state of 16, class): of values 0.4 + 0.06 k, k = 0 at state 5 and 10 at state 15
    (5, AgentClass.CAR): (102, 102, 0),
    (9, AgentClass.CAR): (163, 163, 0),  # 0.64 · 255 = 163.2
    (14, AgentClass.CAR): (240, 240, 0),  # 0.94 · 255 = 239.7
    (15, AgentClass.CAR): YELLOW,
    (5, AgentClass.PEDESTRIAN): (102, 61, 20),  # 0.4 · (255, 153, 51) = (102, 61.2, 20.4)
    (9, AgentClass.PEDESTRIAN): (163, 98, 33),  # 0.64 · (255, 153, 51) = (163.2, 97.9, 32.6)
    # Violet is darker: its value rises from 0.4 to 0.8 only, by 0.04 a tick.
    (5, AgentClass.OTHER): (102, 0, 102),
    (9, AgentClass.OTHER): (143, 0, 143),  # 0.56 · 255 = 142.8
    (15, AgentClass.OTHER): VIOLET,
    (4, AgentClass.CAR): BLACK,
    (0, AgentClass.CAR): BLACK,
}


@pytest.mark.parametrize(("state", "kind"), FADED)
def test_the_past_fades(state: int, kind: AgentClass) -> None:
    """Two seconds ago a box has 0.4 of full brightness; what is older is not drawn."""
    scene = make_scene(
        standing([(0.0, 0.0, 0.0), (10.0, 6.0, 0.0)]),
        valid=only_at(state),
        classes=np.array([[0, int(kind)]]),
    )
    assert colour(MTP().draw(scene)[0], 238, 150) == FADED[state, kind]


def test_the_targets_own_past_fades() -> None:
    """At 5 m/s it was 10 m back two seconds ago, at row 338: its oldest box reaches 2 m further."""
    states = standing([(0.0, 0.0, 0.0)])
    states[0, 0, :, 0] = 5 * 0.2 * np.arange(-15, 1)
    picture = MTP().draw(make_scene(states))[0]
    assert colour(picture, 347, 180) == (102, 0, 0)
    assert colour(picture, 348, 180) == BLACK
    # Boxes 1 m apart: of each earlier one the last metre shows, 5 rows.
    shown = [colour(picture, row, 180)[0] for row in range(347, 297, -5)]
    assert shown == [102, 117, 133, 148, 163, 178, 194, 209, 224, 240]


def test_left_hand_curve_lies_on_the_left() -> None:
    """Who came round a left-hand curve has its fading past on the left, behind its back."""
    angle = np.linspace(-0.9, 0.0, 16)
    states = np.zeros((1, 1, 16, 4))
    states[0, 0] = np.stack(
        [20 * np.sin(angle), 20 - 20 * np.cos(angle), angle, np.full(16, 6.0)], axis=1
    )
    red = MTP().draw(make_scene(states))[0, 0]
    # Two seconds ago, at an angle of 0.6, its centre was 11.29 m back and 3.49 m to the left, and a
    # point 1.8 m behind that 12.78 m and 4.51 m: 63.9 rows and 22.5 columns.
    assert red[288 + 63, 180 - 23] == 102
    assert red[298:, 185:].max() == 0


def picture_of_two(
    first: AgentClass, second: AgentClass, states: tuple[int, int] = (15, 15)
) -> tuple[int, ...]:
    """The pixel of two agents at one place, each at one state."""
    valid = only_at(states[1], agents=3)
    valid[0, 1] = False
    valid[0, 1, states[0]] = True
    scene = make_scene(
        standing([(0.0, 0.0, 0.0), (10.0, 6.0, 0.0), (10.0, 6.0, 0.0)]),
        valid=valid,
        classes=np.array([[0, int(first), int(second)]]),
    )
    return colour(MTP().draw(scene)[0], 238, 150)


@pytest.mark.parametrize("swapped", [False, True])
def test_who_lies_above(swapped: bool) -> None:
    """Humans above objects above vehicles at one tick; what is newer above all that is older."""

    def two(below: AgentClass, above: AgentClass, states: tuple[int, int]) -> tuple[int, ...]:
        if swapped:
            return picture_of_two(above, below, (states[1], states[0]))
        return picture_of_two(below, above, states)

    car, thing, human = AgentClass.CAR, AgentClass.OTHER, AgentClass.PEDESTRIAN
    assert two(car, thing, (15, 15)) == VIOLET
    assert two(thing, human, (15, 15)) == ORANGE
    assert two(car, human, (15, 15)) == ORANGE
    assert two(human, car, (14, 15)) == YELLOW
    assert two(car, car, (5, 15)) == YELLOW


def test_the_target_lies_above_all() -> None:
    """Its box now, and its oldest one, over a pedestrian that stands there."""
    states = standing([(0.0, 0.0, 0.0), (0.0, 0.0, 0.0), (-10.0, 0.0, 0.0)])
    states[0, 0, :, 0] = 5 * 0.2 * np.arange(-15, 1)
    classes = np.array([[0, *[int(AgentClass.PEDESTRIAN)] * 2]])
    picture = MTP().draw(make_scene(states, classes=classes))[0]
    assert colour(picture, 288, 180) == RED
    assert colour(picture, 347, 180) == (102, 0, 0)


def test_no_targets() -> None:
    """A scene without targets gives no pictures."""
    assert SMALL.draw(make_scene(standing([(0.0, 0.0, 0.0)]), targets=[])).shape == (0, 3, 90, 90)


def test_histories_are_cut_or_refused() -> None:
    """Of 15 past ticks the last 10 are drawn; 9 are one too few."""
    states = traffic(0)
    np.testing.assert_array_equal(
        SMALL.draw(make_scene(states)), SMALL.draw(make_scene(states[:, :, 5:]))
    )
    with pytest.raises(AspEnvError, match="needs 10 past ticks, the scene has 9"):
        SMALL.draw(make_scene(states[:, :, 6:]))


def test_memory_that_does_not_fit_is_refused() -> None:
    """Pictures of the other view do not fit."""
    with pytest.raises(AspEnvError, match=r"uint8 \(5, 3, 90, 90\)"):
        SMALL.draw(busy_scene(), np.zeros((5, 12, 90, 60), dtype=np.uint8))


@given(
    x=st.floats(5, 50), y=st.floats(-30, 30), heading=st.floats(-3, 3), ego_heading=st.floats(-3, 3)
)
def test_pedestrians_stay_visible_at_coarse_scale(
    x: float, y: float, heading: float, ego_heading: float
) -> None:
    """0.5 m by 0.5 m at 0.8 m per pixel is one to four orange pixels."""
    cos, sin = math.cos(ego_heading), math.sin(ego_heading)
    scene = make_scene(
        standing([(0.0, 0.0, ego_heading), (cos * x - sin * y, sin * x + cos * y, heading)]),
        size_m=(0.5, 0.5),
        classes=np.array([[0, int(AgentClass.PEDESTRIAN)]]),
        maps=(ROAD,),
    )
    orange = (SMALL.draw(scene)[0] == np.array(ORANGE)[:, None, None]).all(axis=0).sum()
    assert 1 <= orange <= 4
