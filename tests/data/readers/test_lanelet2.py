"""Lanelet2 maps: frame, direction, topology, and repairs."""

import math
from collections.abc import Mapping, Sequence
from itertools import pairwise
from pathlib import Path

import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import given

from asp_env.data.readers.lanelet2 import read_lanelet2
from asp_env.data.readers.positions import Origin, to_local
from asp_env.data.road_map import LineType, RoadMap
from asp_env.data.source import open_data
from tests.data.levelx_files import ORIGIN_M, osm, two_lane_road
from tests.real_data import real_data

ORIGIN = Origin(x_m=ORIGIN_M[0], y_m=ORIGIN_M[1], longitude_deg=6.1, latitude_deg=50.5)
ROAD = {"type": "lanelet", "subtype": "road"}

Ways = dict[str, tuple[Sequence[tuple[float, float]], Mapping[str, str]]]
Lanelets = dict[str, tuple[Mapping[str, str], Mapping[str, str]]]


def read(folder: Path, text: str) -> RoadMap:
    """The map in a file with this content."""
    path = folder / "place.osm"
    path.write_text(text)
    return read_lanelet2(path, ORIGIN)


def street(count: int, *, gap_m: float = 0.0, swapped: int = -1) -> str:
    """Lanelets 0, 1, … of 10 m in a row along +x, 4 m wide about y = 0."""
    ways: Ways = {}
    lanelets: Lanelets = {}
    for number in range(count):
        begin = number * (10.0 + gap_m)
        for side, y in (("l", 2.0), ("r", -2.0)):
            ways[f"{side}{number}"] = ([(begin, y), (begin + 10.0, y)], {"type": "virtual"})
        left, right = ("r", "l") if number == swapped else ("l", "r")
        lanelets[str(number)] = ({"left": f"{left}{number}", "right": f"{right}{number}"}, ROAD)
    return osm(ways, lanelets)


def test_projection() -> None:
    """On the equator the centre of zone 32, 9° east, is at (500 km, 0 km)."""
    origin = Origin(x_m=499_990.0, y_m=-5.0, longitude_deg=9.0, latitude_deg=0.0)
    np.testing.assert_allclose(to_local(np.zeros(1), np.full(1, 9.0), origin), [[10.0, 5.0]])


@pytest.mark.parametrize(
    ("longitude", "latitude", "epsg"),
    [(6.1, 50.8, 32632), (5.99, 50.8, 32631), (8.4, 49.0, 32632), (18.4, -33.9, 32734)],
)
def test_utm_zone(longitude: float, latitude: float, epsg: int) -> None:
    """Zones are 6° wide from -180°, and counted from 32701 in the south."""
    origin = Origin(x_m=0.0, y_m=0.0, longitude_deg=longitude, latitude_deg=latitude)
    assert origin.epsg == epsg


def test_two_lane_road(tmp_path: Path) -> None:
    """The southern lane runs east at y = -21.75, the northern one west."""
    road = read(tmp_path, two_lane_road())
    np.testing.assert_allclose(road.lanes[0], [(0, -21.75), (60, -21.75), (120, -21.75)], atol=1e-4)
    np.testing.assert_allclose(road.lanes[1], [(120, -18.25), (60, -18.25), (0, -18.25)], atol=1e-4)
    kinds = {round(float(line[0, 1]), 1): LineType(kind) for line, kind in _lines(road)}
    assert kinds == {-23.5: LineType.CURB, -20.0: LineType.DASHED, -16.5: LineType.CURB}
    assert sum(_area(road.drivable[i]) for i in range(2)) == pytest.approx(2 * 120 * 3.5, rel=1e-5)
    assert len(road.successors) == 0
    assert road.repairs == ()


def _lines(road: RoadMap) -> list[tuple[np.ndarray, int]]:
    return [(road.lines[i], int(kind)) for i, kind in enumerate(road.line_types)]


def _area(ring: np.ndarray) -> float:
    x, y = ring.T
    return abs(0.5 * float((x * np.roll(y, -1) - y * np.roll(x, -1)).sum()))


@given(
    flips=st.lists(st.booleans(), min_size=3, max_size=3),
    turn=st.floats(-math.pi, math.pi),
    bend=st.floats(-0.2, 0.2),
)
def test_the_order_of_a_ways_nodes_does_not_matter(
    tmp_path_factory: pytest.TempPathFactory, flips: list[bool], turn: float, bend: float
) -> None:
    """Two opposite lanes of a bend, with ways drawn in any direction: only the roles count."""
    angles = turn + bend * np.arange(6)
    middle = np.cumsum(10.0 * np.stack([np.cos(angles), np.sin(angles)], axis=-1), axis=0)
    across = 3.5 * np.stack([-np.sin(angles), np.cos(angles)], axis=-1)
    ways: Ways = {}
    for (name, offset), flip in zip((("l", 1), ("m", 0), ("r", -1)), flips, strict=True):
        line = middle + offset * across
        points = [(float(x), float(y)) for x, y in (line[::-1] if flip else line)]
        ways[name] = (points, {})
    members = {"1": {"left": "m", "right": "r"}, "2": {"left": "m", "right": "l"}}
    lanelets: Lanelets = {name: (sides, ROAD) for name, sides in members.items()}
    road = read(tmp_path_factory.mktemp("bend"), osm(ways, lanelets))
    for lane, expected in ((0, middle - across / 2), (1, (middle + across / 2)[::-1])):
        np.testing.assert_allclose(road.lanes[lane][[0, -1]], expected[[0, -1]], atol=1e-3)


@pytest.mark.parametrize(("gap_m", "edges"), [(0.0, [[0, 1], [1, 2]]), (0.4, [[0, 1], [1, 2]])])
def test_successors(tmp_path: Path, gap_m: float, edges: list[list[int]]) -> None:
    """Ends that share nodes, or lie within 0.5 m, are connected."""
    assert read(tmp_path, street(3, gap_m=gap_m)).successors.tolist() == edges


def test_ends_0_6_m_apart_are_not_connected(tmp_path: Path) -> None:
    assert len(read(tmp_path, street(3, gap_m=0.6)).successors) == 0


@pytest.mark.parametrize("swapped", [0, 1, 2, 3])
def test_a_lanelet_with_swapped_bounds_is_reversed(tmp_path: Path, swapped: int) -> None:
    """One of four lanelets in a row: afterwards all run east, and a repair is reported."""
    road = read(tmp_path, street(4, swapped=swapped))
    assert all(road.lanes[i][-1, 0] > road.lanes[i][0, 0] for i in range(4))
    assert road.successors.tolist() == [[0, 1], [1, 2], [2, 3]]
    assert road.repairs == (f"1 lanelets with swapped left and right bounds reversed: {swapped}",)


def test_two_contradicting_lanelets_are_unchanged(tmp_path: Path) -> None:
    """Of two lanelets that meet head-on either may be wrong."""
    road = read(tmp_path, street(2, swapped=1))
    assert road.lanes[0][-1, 0] > road.lanes[0][0, 0]
    assert road.lanes[1][-1, 0] < road.lanes[1][0, 0]
    assert road.repairs == ()


def test_opposite_lanes_are_no_contradiction(tmp_path: Path) -> None:
    """They share a bound and its end nodes, and none is reversed."""
    ways: Ways = {}
    lanelets: Lanelets = {}
    for number, (begin, end) in enumerate(pairwise((0.0, 10.0, 20.0, 30.0))):
        for name, y in (("a", -4.0), ("b", 0.0), ("c", 4.0)):
            ways[f"{name}{number}"] = ([(begin, y), (end, y)], {})
        lanelets[f"e{number}"] = ({"left": f"b{number}", "right": f"a{number}"}, ROAD)
        lanelets[f"w{number}"] = ({"left": f"b{number}", "right": f"c{number}"}, ROAD)
    road = read(tmp_path, osm(ways, lanelets))
    assert road.repairs == ()
    assert sorted(road.successors.tolist()) == [[0, 2], [2, 4], [3, 1], [5, 3]]


@pytest.mark.parametrize(
    ("subtype", "is_lane", "is_drivable"),
    [
        ("road", True, True),
        ("bus_lane", True, True),
        (None, True, True),
        ("crosswalk", False, True),
        ("bicycle_lane", False, False),
        ("bikelane", False, False),
        ("walkway", False, False),
    ],
)
def test_subtypes(tmp_path: Path, subtype: str | None, is_lane: bool, is_drivable: bool) -> None:
    """Vehicles drive along roads, bus lanes and lanelets without subtype, and over crosswalks."""
    ways: Ways = {
        "far": ([(0, 50), (9, 50)], {}),
        "farther": ([(0, 54), (9, 54)], {}),
        "l": ([(0, 2), (9, 2)], {}),
        "r": ([(0, -2), (9, -2)], {}),
    }
    tags = {"type": "lanelet"} | ({"subtype": subtype} if subtype else {})
    lanelets: Lanelets = {
        "0": ({"left": "farther", "right": "far"}, ROAD),
        "1": ({"left": "l", "right": "r"}, tags),
    }
    road = read(tmp_path, osm(ways, lanelets))
    assert (len(road.lanes), len(road.drivable)) == (1 + is_lane, 1 + is_drivable)
    assert len(road.lines) == (4 if is_drivable else 2)


@pytest.mark.parametrize(
    ("tags", "expected"),
    [
        ({"type": "curbstone", "subtype": "low"}, LineType.CURB),
        ({"type": "road_border"}, LineType.CURB),
        ({"type": "guard_rail"}, LineType.CURB),
        ({"type": "fence"}, LineType.CURB),
        ({"type": "line_thin", "subtype": "solid"}, LineType.SOLID),
        ({"type": "line_thick", "subtype": "solid_solid"}, LineType.SOLID),
        ({"type": "line_thin", "subtype": "solid_dashed"}, LineType.SOLID),
        ({"type": "line_thin", "subtype": "dashed"}, LineType.DASHED),
        ({"type": "line_thin"}, LineType.SOLID),
        ({"type": "virtual"}, LineType.VIRTUAL),
        ({}, LineType.DASHED),
    ],
)
def test_line_types(tmp_path: Path, tags: dict[str, str], expected: LineType) -> None:
    """The tags of a way determine its type; a way without a type that two lanes share is dashed."""
    text = two_lane_road()
    old = "<tag k='type' v='line_thin' /><tag k='subtype' v='dashed' />"
    new = "".join(f"<tag k='{key}' v='{value}' />" for key, value in tags.items())
    assert old in text
    road = read(tmp_path, text.replace(old, new))
    kinds = {round(float(line[0, 1]), 1): kind for line, kind in _lines(road)}
    assert kinds[-20.0] == expected


def test_curbs_that_bound_no_lanelet_are_lines(tmp_path: Path) -> None:
    """Other ways that bound no lanelet are not."""
    ways: Ways = {
        "l": ([(0, 2), (9, 2)], {"type": "virtual"}),
        "r": ([(0, -2), (9, -2)], {}),
        "curb": ([(0, 9), (9, 9)], {"type": "curbstone"}),
        "paint": ([(0, 8), (9, 8)], {"type": "line_thin"}),
    }
    road = read(tmp_path, osm(ways, {"0": ({"left": "l", "right": "r"}, ROAD)}))
    assert road.line_types.tolist() == [LineType.VIRTUAL, LineType.VIRTUAL, LineType.CURB]


def test_areas(tmp_path: Path) -> None:
    """A parking lot of 10 by 20 m, whose ring has two ways, is drivable; vegetation is not."""
    ways: Ways = {
        "l": ([(0, 2), (9, 2)], {}),
        "r": ([(0, -2), (9, -2)], {}),
        "u": ([(0, 10), (10, 10), (10, 30)], {}),
        "n": ([(0, 10), (0, 30), (10, 30)], {}),
    }
    text = osm(ways, {"0": ({"left": "l", "right": "r"}, ROAD)})
    members = "".join(f"<member type='way' ref='{way}' role='outer' />" for way in "un")
    for subtype, areas in (("parking", [36.0, 200.0]), ("vegetation", [36.0])):
        tags = f"<tag k='type' v='multipolygon' /><tag k='subtype' v='{subtype}' />"
        area = f"<relation id='9'>{members}{tags}</relation></osm>"
        road = read(tmp_path, text.replace("</osm>", area))
        found = [_area(road.drivable[i]) for i in range(len(road.drivable))]
        assert found == pytest.approx(areas, rel=1e-4)


def test_bounds_of_several_ways_are_joined(tmp_path: Path) -> None:
    """One of them is drawn backwards."""
    ways: Ways = {
        "l1": ([(5, 2), (0, 2)], {}),
        "l2": ([(5, 2), (9, 2)], {}),
        "r": ([(0, -2), (9, -2)], {}),
    }
    text = osm(ways, {"0": ({"left": "l1", "right": "r"}, ROAD)})
    second = "<member type='way' ref='l2' role='left' /><member type='way' ref='r'"
    road = read(tmp_path, text.replace("<member type='way' ref='r'", second))
    np.testing.assert_allclose(road.lanes[0], [(0, 0), (5, 0), (9, 0)], atol=1e-4)


def test_a_centre_line_in_the_file_is_used(tmp_path: Path) -> None:
    """In the direction of travel."""
    ways: Ways = {
        "l": ([(0, 2), (9, 2)], {}),
        "r": ([(0, -2), (9, -2)], {}),
        "c": ([(9, 1), (0, 1)], {}),
    }
    sides = {"left": "l", "right": "r", "centerline": "c"}
    road = read(tmp_path, osm(ways, {"0": (sides, ROAD)}))
    np.testing.assert_allclose(road.lanes[0], [(0, 1), (9, 1)], atol=1e-4)


def test_centre_line_of_uneven_bounds(tmp_path: Path) -> None:
    """Bounds with different points are paired by their share of the length."""
    ways: Ways = {
        "l": ([(0, 2), (2, 2), (8, 2)], {}),
        "r": ([(0, -2), (4, -2), (8, -2)], {}),
    }
    road = read(tmp_path, osm(ways, {"0": ({"left": "l", "right": "r"}, ROAD)}))
    np.testing.assert_allclose(road.lanes[0], [(0, 0), (2, 0), (4, 0), (8, 0)], atol=1e-4)


@pytest.mark.parametrize(
    ("old", "new", "lanes", "repair"),
    [
        (
            "<way id='l1'>",
            "<way id='gone'>",
            2,
            "1 lanelets without a left or right bound left out: 1",
        ),
        ("<nd ref='1' />", "<nd ref='1' /><nd ref='999' />", 3, "1 ways refer to missing nodes"),
        ("<way id='l1'>", "<way id='l0'><nd ref='3' /></way><way id='l1'>", 3, "1 ids occur twice"),
        ("<way id='l1'>", "<way id='l1' action='delete'>", 2, "1 lanelets without"),
        ("<way id='l1'>", "<way id='x'><nd ref='1' /></way><way id='l1'>", 3, "1 ways with fewer"),
    ],
)
def test_repairs_are_reported(tmp_path: Path, old: str, new: str, lanes: int, repair: str) -> None:
    """Missing references, duplicate ids and deleted elements."""
    text = street(3)
    assert old in text
    road = read(tmp_path, text.replace(old, new))
    assert len(road.lanes) == lanes
    assert len(road.repairs) == 1
    assert road.repairs[0].startswith(repair)


@pytest.mark.data
@pytest.mark.parametrize("location", ["1", "2"])
def test_real_cars_drive_along_their_lanes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, location: str
) -> None:
    """Of cars above 2 m/s within 2 m of a lane, 98 % have one in their direction (±30°)."""
    monkeypatch.setenv("ASP_ENV_CACHE", str(tmp_path))
    recordings = [each for each in open_data(real_data("karlsruhe")) if each.location == location]
    lanes = recordings[0].road_map.lanes
    points, courses = [], []
    for lane in (lanes[i] for i in range(len(lanes))):
        for begin, end in pairwise(lane):
            shares = np.arange(0.0, 1.0, 0.5 / max(0.5, float(np.hypot(*(end - begin)))))
            points.append(begin + shares[:, None] * (end - begin))
            courses.append(np.full(len(shares), math.atan2(*(end - begin)[::-1])))
    positions, course = np.concatenate(points), np.concatenate(courses)
    states = np.concatenate(
        [each.track(int(i))[::5] for each in recordings for i in np.flatnonzero(each.predicted)]
    )
    states = states[states[:, 3] > 2.0]
    near = np.linalg.norm(states[:, None, :2] - positions, axis=-1) < 2.0
    along = np.cos(states[:, None, 2] - course) > math.cos(math.radians(30))
    assert near.any(axis=1).mean() > 0.9
    assert (near & along).any(axis=1)[near.any(axis=1)].mean() > 0.98
