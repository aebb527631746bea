"""Lanelets that are written and read back."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from asp_env.data.readers.lanelet2 import read_lanelet2
from asp_env.data.readers.positions import Origin
from asp_env.data.road_map import LineType, RoadMap
from scenarios.lanelet2 import Area, Border, Lanelet, Marking, to_degrees, write_map

ORIGIN_UTM_M = (294_000.0, 5_628_000.0)


def border(marking: Marking, *points: tuple[float, float]) -> Border:
    """A line through points."""
    return Border(line=np.array(points, dtype=np.float64), marking=marking)


def read_back(folder: Path, *lanelets: Lanelet, areas: Sequence[Area] = ()) -> RoadMap:
    """The map after writing and reading these lanelets."""
    path = folder / "place.osm"
    write_map(path, list(lanelets), list(areas), origin_utm_m=ORIGIN_UTM_M, join_m=0.05)
    lat, lon = to_degrees(np.array([ORIGIN_UTM_M]))[0]
    origin = Origin(
        x_m=ORIGIN_UTM_M[0],
        y_m=ORIGIN_UTM_M[1],
        latitude_deg=float(lat),
        longitude_deg=float(lon),
    )
    return read_lanelet2(path, origin)


def test_a_side_in_parts_is_one_side(tmp_path: Path) -> None:
    """A strip along +x whose right side is a kerb for 4 m and then solid: one ring, three lines."""
    lanelet = Lanelet(
        subtype="road",
        left=(border("virtual", (0, 3), (10, 3)),),
        right=(border("curb", (0, 0), (4, 0)), border("solid", (4, 0), (10, 0))),
        speed_limit_mps=10.0,
    )
    np.testing.assert_array_equal(lanelet.right_line, [[0, 0], [4, 0], [10, 0]])
    road_map = read_back(tmp_path, lanelet)
    assert road_map.line_types.tolist() == [LineType.VIRTUAL, LineType.CURB, LineType.SOLID]
    ring = [[0, 3], [10, 3], [10, 0], [4, 0], [0, 0]]
    np.testing.assert_allclose(road_map.areas[0], ring, atol=1e-4)


def test_a_line_is_marked_if_either_direction_marks_it(tmp_path: Path) -> None:
    """Two lanes share y = 0; the first one to be written has no marking there."""
    east = Lanelet(
        subtype="road",
        left=(border("virtual", (0, 0), (10, 0)),),
        right=(border("curb", (0, -3), (10, -3)),),
    )
    west = Lanelet(
        subtype="road",
        left=(border("dashed", (10, 0), (0, 0)),),
        right=(border("curb", (10, 3), (0, 3)),),
    )
    road_map = read_back(tmp_path, east, west)
    assert road_map.line_types.tolist() == [LineType.DASHED, LineType.CURB, LineType.CURB]


def test_each_lane_has_its_own_limit(tmp_path: Path) -> None:
    """36 km/h are 10 m/s, 72 are 20; the third lane has none."""
    lanelets = [
        Lanelet(
            subtype="road",
            left=(border("curb", (0, y + 3), (10, y + 3)),),
            right=(border("curb", (0, y), (10, y)),),
            speed_limit_mps=limit,
        )
        for y, limit in ((0, 10.0), (10, 20.0), (20, None))
    ]
    road_map = read_back(tmp_path, *lanelets)
    np.testing.assert_allclose(road_map.limits_mps, [10.0, 20.0, 0.0])
    assert road_map.limited.tolist() == [True, True, False]


def test_ground_beside_a_lane(tmp_path: Path) -> None:
    """A triangle with a kerb on one side is drivable and no lane; its other sides are no lines."""
    lane = Lanelet(
        subtype="road",
        left=(border("virtual", (0, 3), (10, 3)),),
        right=(border("virtual", (0, 0), (10, 0)),),
    )
    ground = Area(
        subtype="freespace",
        outer=(
            border("virtual", (0, 0), (10, 0)),
            border("curb", (4, -3), (0, 0)),
            border("virtual", (4, -3), (10, 0)),
        ),
    )
    road_map = read_back(tmp_path, lane, areas=[ground])
    assert len(road_map.lanes) == 1
    assert len(road_map.drivable) == 2
    corners = {(round(x, 3), round(y, 3)) for x, y in road_map.drivable[1].tolist()}
    assert corners == {(0, 0), (10, 0), (4, -3)}
    assert road_map.line_types.tolist() == [LineType.VIRTUAL, LineType.VIRTUAL, LineType.CURB]


def test_a_given_centre_line_is_used(tmp_path: Path) -> None:
    """The left side of a strip makes a detour; its lane is straight nevertheless."""
    lane = Lanelet(
        subtype="road",
        left=(border("curb", (0, 3), (5, 8), (10, 3)),),
        right=(border("curb", (0, 0), (10, 0)),),
        centre=np.array([(0.0, 1.5), (10.0, 1.5)]),
    )
    road_map = read_back(tmp_path, lane)
    np.testing.assert_allclose(road_map.lanes[0], [[0, 1.5], [10, 1.5]], atol=1e-4)
    assert road_map.line_types.tolist() == [LineType.CURB, LineType.CURB]
