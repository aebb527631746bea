"""The ChauffeurNet view: what is drawn where."""

import math

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from asp_env.data.road_map import LineType
from asp_env.errors import AspEnvError
from asp_env.views.chauffeurnet import SNAPSHOTS, ChauffeurNet
from asp_env.views.view import View
from tests.views.scenes import (
    COARSE,
    busy_scene,
    channel,
    cross_map,
    make_map,
    make_scene,
    standing,
    traffic,
)

SMALL = ChauffeurNet(
    View(height_px=32, width_px=32, metres_per_pixel=1.0, anchor_row_px=24.0, anchor_column_px=16.0)
)


def test_channels() -> None:
    """Twelve channels in the documented order, 12x360x240 by default."""
    assert ChauffeurNet().shape == (12, 360, 240)
    assert ChauffeurNet.channels[:4] == ("road_boundary", "ego_box", "ego_trail", "agents_0")
    assert ChauffeurNet.channels[-1] == "agents_8"
    assert ChauffeurNet.history == 15


def test_lone_ego_on_an_empty_map() -> None:
    """Only the ego's own box is there: 4 m by 2 m are 20 by 10 pixels around row 288."""
    picture = ChauffeurNet().draw(make_scene(standing([(7.0, 3.0, 0.7)])))[0]
    expected = np.zeros((360, 240), dtype=np.uint8)
    expected[278:298, 115:125] = 255
    np.testing.assert_array_equal(picture[channel("ego_box")], expected)
    drawn = np.flatnonzero(picture.any(axis=(1, 2))).tolist()
    assert drawn == [channel("ego_box"), channel("ego_trail")]
    assert (picture[channel("ego_trail")] > 0).sum() == 4  # standing leaves a dot of 2 by 2


def test_empty_scene_draws_the_map_alone() -> None:
    """Without a history and without others, only the map and the ego's box are there."""
    valid = np.zeros((1, 3, 16), dtype=bool)
    valid[0, 0, -1] = True
    states = standing([(0.0, 0.0, 0.0)] * 3)
    picture = ChauffeurNet().draw(make_scene(states, valid=valid, maps=(cross_map(),)))[0]
    drawn = np.flatnonzero(picture.any(axis=(1, 2))).tolist()
    assert drawn == [channel("road_boundary"), channel("ego_box")]


def test_no_targets() -> None:
    """A scene without targets gives no pictures."""
    scene = make_scene(standing([(0.0, 0.0, 0.0)]), targets=[])
    assert COARSE.draw(scene).shape == (0, 12, 90, 60)


def test_values_are_0_and_255() -> None:
    """Pictures are binary."""
    assert np.unique(ChauffeurNet().draw(busy_scene())).tolist() == [0, 255]


@pytest.mark.parametrize("heading", [0.0, 0.5 * math.pi, math.pi, -0.5 * math.pi, 0.3])
def test_left_is_left(heading: float) -> None:
    """A car 10 m ahead and 6 m to the left is 50 rows up and 30 columns to the left."""
    cos, sin = math.cos(heading), math.sin(heading)
    other = (5.0 + 10 * cos - 6 * sin, 9.0 + 10 * sin + 6 * cos, heading)
    picture = ChauffeurNet().draw(make_scene(standing([(5.0, 9.0, heading), other])))[0]
    rows, columns = np.nonzero(picture[channel("agents_8")])
    assert rows.mean() + 0.5 == pytest.approx(238, abs=0.5)
    assert columns.mean() + 0.5 == pytest.approx(90, abs=0.5)


def test_trail_of_a_left_hand_curve_lies_on_the_left() -> None:
    """Who came round a left-hand curve has its trail on the left, behind its back."""
    angle = np.linspace(-0.9, 0.0, 16)
    states = np.zeros((1, 1, 16, 4))
    states[0, 0] = np.stack(
        [20 * np.sin(angle), 20 - 20 * np.cos(angle), angle, np.full(16, 6.0)], axis=1
    )
    trail = ChauffeurNet().draw(make_scene(states))[0, channel("ego_trail")]
    rows, columns = np.nonzero(trail)
    assert rows.min() >= 286
    # 20 m - 20 m · cos 0.9 = 7.57 m to the left, but 14.4 m back the picture ends: 6.1 m.
    assert columns.min() == pytest.approx(120 - 5 * 6.1, abs=3)
    assert columns.max() <= 121


def test_without_the_ego_trail() -> None:
    """Its channel stays and is empty; all others are as they were."""
    scene = busy_scene()
    shown, hidden = (ChauffeurNet(ego_trail=trail).draw(scene) for trail in (True, False))
    others = [i for i, name in enumerate(ChauffeurNet.channels) if name != "ego_trail"]
    assert shown[:, channel("ego_trail")].any()
    assert not hidden[:, channel("ego_trail")].any()
    np.testing.assert_array_equal(hidden[:, others], shown[:, others])


def test_snapshots_are_those_of_the_paper() -> None:
    """An agent seen at state s alone is drawn in the channel of s, and nowhere if there is none."""
    for state in range(16):
        valid = np.zeros((1, 2, 16), dtype=bool)
        valid[0, 0, -1] = valid[0, 1, state] = True
        scene = make_scene(standing([(0.0, 0.0, 0.0), (10.0, 0.0, 0.0)]), valid=valid)
        drawn = np.flatnonzero(COARSE.draw(scene)[0, 3:].any(axis=(1, 2))).tolist()
        assert drawn == [i for i, snapshot in enumerate(SNAPSHOTS) if snapshot == state]
    assert SNAPSHOTS == (0, 2, 4, 6, 8, 9, 11, 13, 15)


def test_longer_histories_are_cut() -> None:
    """Of 20 past ticks the last 15 are drawn."""
    states = traffic(0)
    longer = np.concatenate([states[:, :, :5] + 1.0, states], axis=2)
    np.testing.assert_array_equal(COARSE.draw(make_scene(longer)), COARSE.draw(make_scene(states)))


def test_shorter_histories_are_refused() -> None:
    """14 past ticks are one too few."""
    with pytest.raises(AspEnvError, match="needs 15 past ticks, the scene has 14"):
        COARSE.draw(make_scene(traffic(0)[:, :, 1:]))


def test_lines_that_bound() -> None:
    """Curbs and solid lines are drawn, dashed and virtual ones are not."""
    for kind in LineType:
        scene = make_scene(
            standing([(0.0, 0.0, 0.0)]), maps=(make_map([(kind, [(5, 5), (20, 5)])]),)
        )
        drawn = COARSE.draw(scene)[0, channel("road_boundary")].any()
        assert drawn == (kind in (LineType.CURB, LineType.SOLID))


def test_each_situation_has_its_map() -> None:
    """A line 5 m to the left on one map and to the right on the other."""
    maps = tuple(make_map([(LineType.CURB, [(5, y), (20, y)])]) for y in (5, -5))
    states = np.repeat(standing([(0.0, 0.0, 0.0)]), 2, axis=0)
    pictures = ChauffeurNet().draw(make_scene(states, targets=[(1, 0), (0, 0)], maps=maps))
    _, columns_second = np.nonzero(pictures[0, 0])
    _, columns_first = np.nonzero(pictures[1, 0])
    assert set(columns_first) <= {94, 95}
    assert set(columns_second) <= {144, 145}


@pytest.mark.parametrize(
    "out",
    [
        np.zeros((5, 12, 90, 61), dtype=np.uint8),
        np.zeros((5, 12, 90, 60), dtype=np.float32),
        np.zeros((5, 12, 60, 90), dtype=np.uint8).swapaxes(2, 3),
    ],
    ids=["shape", "dtype", "order"],
)
def test_memory_that_does_not_fit_is_refused(out: np.ndarray) -> None:
    """Another shape, type or memory order is refused, with the one expected."""
    with pytest.raises(AspEnvError, match=r"uint8 \(5, 12, 90, 60\)"):
        COARSE.draw(busy_scene(), out)


@given(
    x=st.floats(-10, 50),
    y=st.floats(-20, 20),
    heading=st.floats(-3, 3),
    ego_heading=st.floats(-3, 3),
)
def test_pedestrians_stay_visible_at_coarse_scale(
    x: float, y: float, heading: float, ego_heading: float
) -> None:
    """0.5 m by 0.5 m at 0.8 m per pixel is one to four pixels, in all nine snapshots."""
    cos, sin = math.cos(ego_heading), math.sin(ego_heading)
    other = (cos * x - sin * y, sin * x + cos * y, heading)
    scene = make_scene(standing([(0.0, 0.0, ego_heading), other]), size_m=(0.5, 0.5))
    counts = (COARSE.draw(scene)[0, 3:] > 0).sum(axis=(1, 2))
    assert (counts >= 1).all()
    assert (counts <= 4).all()


@given(heading=st.floats(-3, 3), x=st.floats(-5, 5), y=st.floats(-5, 5))
def test_lines_stay_whole_at_coarse_scale(heading: float, x: float, y: float) -> None:
    """A curb across the picture is one piece from edge to edge, at any angle."""
    road_map = make_map([(LineType.CURB, [(-99, 1), (-8, 0), (-3, 1), (2, 0), (99, 3)])])
    scene = make_scene(standing([(x, y, heading)]), maps=(road_map,))
    drawn = COARSE.draw(scene)[0, channel("road_boundary")]
    assert cv2.connectedComponents(drawn, connectivity=8)[0] == 2
    assert (drawn > 0).sum() >= 18  # at least as many rows or columns as lie behind the ego


GOLDEN = """
................................
................................
................................
................................
................................
................................
................................
................................
................................
..................8888..........
................678888..........
...............667..............
..............555...............
.............344................
............333......###########
............22.......###########
............22......##..........
............11.....##...........
............01.....##...........
............00.....##...........
...................##...........
...................##...........
...............EE..##...........
...............EE..##...........
...............EE..##...........
...............EE..##...........
...............tt..##...........
...............tt..##....8......
...............tt..##...........
...............tt..##...........
...............tt..##...........
...................##...........
"""


def as_text(picture: np.ndarray) -> str:
    """One letter a pixel: ego E, trail t, agents 0 (oldest) to 8 (now, on top), boundary #."""
    text = np.full(picture.shape[1:], ".", dtype="<U1")
    marks = {0: "#", **{3 + i: str(i) for i in range(9)}, 2: "t", 1: "E"}
    for index, mark in marks.items():
        text[picture[index] > 0] = mark
    return "\n" + "\n".join("".join(row) for row in text) + "\n"


def test_golden_picture() -> None:
    """32 m by 32 m at 1 m per pixel: north is up, and a car turns off to the east."""
    times = 0.2 * np.arange(-15, 1)
    ego = np.stack([0 * times, 2 * times, 0 * times + 0.5 * math.pi, 0 * times + 2], axis=1)
    angle = np.clip(0.5 * times + 1.5, 0, None)  # a quarter of a circle of 8 m, clockwise
    car = np.stack(
        [-3 - 8 * np.cos(angle) + 8, 6 + 8 * np.sin(angle), 0.5 * math.pi - angle, 0 * times + 4],
        axis=1,
    )
    walker = np.tile([9.4, -3.4, 0.3, 0.0], (16, 1))
    scene = make_scene(
        np.stack([ego, car, walker])[None],
        sizes_m=np.array([[(4.0, 2.0), (4.0, 2.0), (0.5, 0.5)]]),
        maps=(make_map([(LineType.CURB, [(4, -10), (4, 6), (6, 9), (18, 9)])]),),
    )
    assert as_text(SMALL.draw(scene)[0]) == GOLDEN
