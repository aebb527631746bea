"""The ChauffeurNet view: what is drawn in which channel and where."""

import dataclasses
import math

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from asp_env.data.road_map import LineType
from asp_env.errors import AspEnvError
from asp_env.views.chauffeurnet import SNAPSHOT_TICKS, ChauffeurNet
from asp_env.views.raster import Viewport
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
    Viewport(
        height_px=32, width_px=32, metres_per_pixel=1.0, anchor_row_px=24.0, anchor_column_px=16.0
    )
)


def test_channels_are_in_the_documented_order() -> None:
    assert ChauffeurNet().shape == (12, 360, 240)
    assert ChauffeurNet.channels[:4] == ("road_boundary", "ego_box", "ego_trail", "agents_0")
    assert ChauffeurNet.channels[-1] == "agents_8"
    assert ChauffeurNet().history == 15


def test_lone_ego_on_an_empty_map() -> None:
    """Only the ego's box is drawn: 4 m by 2 m are 20 by 10 pixels around row 288."""
    raster = ChauffeurNet().render(make_scene(standing([(7.0, 3.0, 0.7)])))[0]
    expected = np.zeros((360, 240), dtype=np.uint8)
    expected[278:298, 115:125] = 255
    np.testing.assert_array_equal(raster[channel("ego_box")], expected)
    drawn = np.flatnonzero(raster.any(axis=(1, 2))).tolist()
    assert drawn == [channel("ego_box"), channel("ego_trail")]
    assert (
        raster[channel("ego_trail")] > 0
    ).sum() == 4  # the trail of a standing ego is a dot of 2 by 2


def test_without_history_and_other_agents_only_map_and_ego_box_are_drawn() -> None:
    valid = np.zeros((1, 3, 16), dtype=bool)
    valid[0, 0, -1] = True
    states = standing([(0.0, 0.0, 0.0)] * 3)
    raster = ChauffeurNet().render(make_scene(states, valid=valid, maps=(cross_map(),)))[0]
    drawn = np.flatnonzero(raster.any(axis=(1, 2))).tolist()
    assert drawn == [channel("road_boundary"), channel("ego_box")]


def test_a_scene_without_targets_gives_no_rasters() -> None:
    scene = make_scene(standing([(0.0, 0.0, 0.0)]), targets=[])
    assert COARSE.render(scene).shape == (0, 12, 90, 60)


def test_values_are_0_and_255() -> None:
    assert np.unique(ChauffeurNet().render(busy_scene())).tolist() == [0, 255]


@pytest.mark.parametrize("heading", [0.0, 0.5 * math.pi, math.pi, -0.5 * math.pi, 0.3])
def test_left_is_left(heading: float) -> None:
    """A car 10 m ahead and 6 m to the left is 50 rows up and 30 columns to the left."""
    cos, sin = math.cos(heading), math.sin(heading)
    other = (5.0 + 10 * cos - 6 * sin, 9.0 + 10 * sin + 6 * cos, heading)
    raster = ChauffeurNet().render(make_scene(standing([(5.0, 9.0, heading), other])))[0]
    rows, columns = np.nonzero(raster[channel("agents_8")])
    assert rows.mean() + 0.5 == pytest.approx(238, abs=0.5)
    assert columns.mean() + 0.5 == pytest.approx(90, abs=0.5)


def test_trail_of_a_left_hand_curve_lies_behind_on_the_left() -> None:
    angle = np.linspace(-0.9, 0.0, 16)
    states = np.zeros((1, 1, 16, 4))
    states[0, 0] = np.stack(
        [20 * np.sin(angle), 20 - 20 * np.cos(angle), angle, np.full(16, 6.0)], axis=1
    )
    trail = ChauffeurNet().render(make_scene(states))[0, channel("ego_trail")]
    rows, columns = np.nonzero(trail)
    assert rows.min() >= 286
    # 20 m - 20 m · cos 0.9 = 7.57 m to the left, but the raster ends 14.4 m back, at 6.1 m.
    assert columns.min() == pytest.approx(120 - 5 * 6.1, abs=3)
    assert columns.max() <= 121


def test_without_the_ego_trail_only_its_channel_is_empty() -> None:
    scene = busy_scene()
    shown, hidden = (ChauffeurNet(ego_trail=trail).render(scene) for trail in (True, False))
    others = [i for i, name in enumerate(ChauffeurNet.channels) if name != "ego_trail"]
    assert shown[:, channel("ego_trail")].any()
    assert not hidden[:, channel("ego_trail")].any()
    np.testing.assert_array_equal(hidden[:, others], shown[:, others])


def test_snapshots_are_those_of_the_paper() -> None:
    """An agent observed only at state s is drawn in the channel of s, if there is one."""
    for state in range(16):
        valid = np.zeros((1, 2, 16), dtype=bool)
        valid[0, 0, -1] = valid[0, 1, state] = True
        scene = make_scene(standing([(0.0, 0.0, 0.0), (10.0, 0.0, 0.0)]), valid=valid)
        drawn = np.flatnonzero(COARSE.render(scene)[0, 3:].any(axis=(1, 2))).tolist()
        assert drawn == [i for i, snapshot in enumerate(SNAPSHOT_TICKS) if snapshot == state]
    assert SNAPSHOT_TICKS == (0, 2, 4, 6, 8, 9, 11, 13, 15)


def test_snapshots_are_regular_intervals_rounded_to_ticks() -> None:
    """Nine snapshots of 3 s are 1.875 ticks apart; each is at most half a tick off, 7.5 at 8."""
    regular = np.arange(9) * 15 / 8
    assert np.round(regular).tolist() == list(SNAPSHOT_TICKS)  # halves to even
    assert np.abs(regular - SNAPSHOT_TICKS).max() == 0.5


def test_of_longer_histories_the_last_15_ticks_are_drawn() -> None:
    states = traffic(0)
    longer = np.concatenate([states[:, :, :5] + 1.0, states], axis=2)
    np.testing.assert_array_equal(
        COARSE.render(make_scene(longer)), COARSE.render(make_scene(states))
    )


def test_shorter_histories_are_rejected() -> None:
    with pytest.raises(AspEnvError, match="needs 15 past ticks, the scene has 14"):
        COARSE.render(make_scene(traffic(0)[:, :, 1:]))


def test_only_curbs_and_solid_lines_are_drawn() -> None:
    for kind in LineType:
        scene = make_scene(
            standing([(0.0, 0.0, 0.0)]), maps=(make_map([(kind, [(5, 5), (20, 5)])]),)
        )
        drawn = COARSE.render(scene)[0, channel("road_boundary")].any()
        assert drawn == (kind in (LineType.CURB, LineType.SOLID))


def test_each_situation_is_drawn_on_its_map() -> None:
    """A line lies 5 m to the left on one map and 5 m to the right on the other."""
    maps = tuple(make_map([(LineType.CURB, [(5, y), (20, y)])]) for y in (5, -5))
    states = np.repeat(standing([(0.0, 0.0, 0.0)]), 2, axis=0)
    rasters = ChauffeurNet().render(make_scene(states, targets=[(1, 0), (0, 0)], maps=maps))
    _, columns_second = np.nonzero(rasters[0, 0])
    _, columns_first = np.nonzero(rasters[1, 0])
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
def test_arrays_that_do_not_fit_are_rejected(out: np.ndarray) -> None:
    with pytest.raises(AspEnvError, match=r"uint8 \(5, 12, 90, 60\)"):
        COARSE.render(busy_scene(), out)


@given(
    x=st.floats(-10, 50),
    y=st.floats(-20, 20),
    heading=st.floats(-3, 3),
    ego_heading=st.floats(-3, 3),
)
def test_pedestrians_are_visible_at_coarse_scale(
    x: float, y: float, heading: float, ego_heading: float
) -> None:
    """0.5 m by 0.5 m at 0.8 m per pixel sets one to four pixels in all nine snapshots."""
    cos, sin = math.cos(ego_heading), math.sin(ego_heading)
    other = (cos * x - sin * y, sin * x + cos * y, heading)
    scene = make_scene(standing([(0.0, 0.0, ego_heading), other]), size_m=(0.5, 0.5))
    counts = (COARSE.render(scene)[0, 3:] > 0).sum(axis=(1, 2))
    assert (counts >= 1).all()
    assert (counts <= 4).all()


@given(heading=st.floats(-3, 3), x=st.floats(-5, 5), y=st.floats(-5, 5))
def test_lines_have_no_gaps_at_coarse_scale(heading: float, x: float, y: float) -> None:
    """A curb across the raster is one connected component, at any angle."""
    road_map = make_map([(LineType.CURB, [(-99, 1), (-8, 0), (-3, 1), (2, 0), (99, 3)])])
    scene = make_scene(standing([(x, y, heading)]), maps=(road_map,))
    drawn = COARSE.render(scene)[0, channel("road_boundary")]
    assert cv2.connectedComponents(drawn, connectivity=8)[0] == 2
    assert (drawn > 0).sum() >= 18  # at least the rows behind the ego


@pytest.mark.parametrize("width_px", [1, 5, 8, 60, 63, 64, 240])
@pytest.mark.parametrize("ego_trail", [True, False])
def test_packed_rasters_are_the_rasters_as_bits(width_px: int, ego_trail: bool) -> None:
    """Bit for bit, for widths that fill their last byte and for others."""
    viewport = dataclasses.replace(Viewport(), width_px=width_px, anchor_column_px=0.5 * width_px)
    view = ChauffeurNet(viewport, ego_trail)
    scene = busy_scene()
    scene.valid[0, 3, -1] = False  # one of the targets is absent
    expected = np.packbits(view.render(scene), axis=-1)
    np.testing.assert_array_equal(view.render_packed(scene), expected)


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


def as_text(raster: np.ndarray) -> str:
    """One letter per pixel: ego E, trail t, agents 0 (oldest) to 8 (now, on top), boundary #."""
    text = np.full(raster.shape[1:], ".", dtype="<U1")
    marks = {0: "#", **{3 + i: str(i) for i in range(9)}, 2: "t", 1: "E"}
    for index, mark in marks.items():
        text[raster[index] > 0] = mark
    return "\n" + "\n".join("".join(row) for row in text) + "\n"


def test_golden_raster() -> None:
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
    assert as_text(SMALL.render(scene)[0]) == GOLDEN
