"""Lanelets that are written and read back."""

from pathlib import Path

import numpy as np

from asp_env.data.readers.lanelet2 import read_lanelet2
from asp_env.data.readers.origin import Origin
from asp_env.data.road_map import LineType, RoadMap
from scenarios.lanelet2 import Border, Lanelet, Marking, to_degrees, write_map

ORIGIN_UTM_M = (294_000.0, 5_628_000.0)


def border(marking: Marking, *points: tuple[float, float]) -> Border:
    """A line through points."""
    return Border(line=np.array(points, dtype=np.float64), marking=marking)


def read_back(folder: Path, *lanelets: Lanelet) -> RoadMap:
    """The map that these lanelets give."""
    path = folder / "place.osm"
    write_map(path, list(lanelets), np.zeros((0, 4, 2)), origin_utm_m=ORIGIN_UTM_M)
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
    """36 km/h are 10 m/s, 72 are 20; the third lane tells none."""
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
