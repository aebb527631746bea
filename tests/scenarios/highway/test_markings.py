"""Markings of lanes as lines of the map."""

from pathlib import Path
from typing import Any

import numpy as np
from highway_env.road.lane import LineType, StraightLane
from highway_env.road.road import RoadNetwork

from asp_env.data.road_map import LineType as Kind
from asp_env.data.road_map import RoadMap
from tests.scenarios.highway.maps import Place, read_back

# highway-env's annotations take these numbers for members of an enumeration.
NONE: Any = LineType.NONE
DASHED: Any = LineType.STRIPED
FIRM: Any = LineType.CONTINUOUS


def kinds_at(road_map: RoadMap, x: float) -> dict[float, Kind]:
    """The kinds, by y, of the lines along x at a position x."""
    found = {}
    for number, kind in enumerate(road_map.line_types):
        line = road_map.lines[number]
        if line[:, 0].min() < x < line[:, 0].max() and np.ptp(line[:, 1]) < 0.01:
            found[round(float(line[0, 1]), 2)] = Kind(int(kind))
    return found


def test_lines_of_two_lanes_side_by_side(tmp_path: Path) -> None:
    """Continuous lines are kerbs outside and solid between lanes; other lines are unchanged."""
    network = RoadNetwork()
    for y, types in ((0.0, (FIRM, FIRM)), (4.0, (FIRM, NONE)), (8.0, (DASHED, FIRM))):
        network.add_lane("a", "b", StraightLane([0.0, y], [30.0, y], line_types=types))
    kinds = kinds_at(read_back(tmp_path, network), 15.0)
    assert kinds == {2.0: Kind.CURB, -2.0: Kind.SOLID, -6.0: Kind.DASHED, -10.0: Kind.CURB}


def test_a_line_ends_where_lanes_cross_it(tmp_path: Path) -> None:
    """A road to the east with kerbs is crossed by a road to the north between x = 18 and 22."""
    network = RoadNetwork()
    types = (FIRM, FIRM)
    network.add_lane("w", "e", StraightLane([0.0, 0.0], [40.0, 0.0], line_types=types))
    network.add_lane("s", "n", StraightLane([20.0, 20.0], [20.0, -20.0], line_types=types))
    road_map = read_back(tmp_path, network)
    for x, kind in ((17.8, Kind.CURB), (18.2, Kind.VIRTUAL), (21.8, Kind.VIRTUAL)):
        assert kinds_at(road_map, x) == {2.0: kind, -2.0: kind}
    assert kinds_at(road_map, 22.2) == {2.0: Kind.CURB, -2.0: Kind.CURB}


def test_no_lane_leads_over_a_boundary(place: Place) -> None:
    """No centre line crosses a kerb or a solid line."""
    road_map = place.road_map
    firm = np.flatnonzero(np.isin(road_map.line_types, [Kind.CURB, Kind.SOLID]))
    boundaries = segments([road_map.lines[int(i)] for i in firm])
    ways = segments([road_map.lanes[i] for i in range(len(road_map.lanes))])
    assert len(boundaries) > 10
    assert not crossings(ways, boundaries).any()
    # The dashed middle is crossed, by turns or by lane changes; the test can detect it:
    dashed = np.flatnonzero(road_map.line_types == Kind.DASHED)
    middle = segments([road_map.lines[int(i)] for i in dashed])
    assert crossings(np.array([[[3.0, -60.0], [-3.0, -60.5]]]), middle).any()


def segments(lines: list[np.ndarray]) -> np.ndarray:
    """Straight pieces (n, 2, 2) of polylines."""
    return np.concatenate([np.stack([line[:-1], line[1:]], axis=1) for line in lines])


def crossings(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Which pieces (n, m) cross each other: the ends of each lie on both sides of the other."""
    a, b = first[:, None], second[None]
    return (side(b, a) < 0) & (side(a, b) < 0)


def side(of: np.ndarray, ends: np.ndarray) -> np.ndarray:
    """Negative where the two ends of pieces lie on different sides of other pieces."""
    along = of[..., 1, :] - of[..., 0, :]
    offset = ends - of[..., :1, :]
    cross = along[..., None, 0] * offset[..., 1] - along[..., None, 1] * offset[..., 0]
    return cross[..., 0] * cross[..., 1]
