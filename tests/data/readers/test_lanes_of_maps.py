"""Properties of lanes besides their centre lines: areas, directions and speed limits."""

from pathlib import Path

import numpy as np
import pytest

from asp_env.data.readers.lanelet2 import read_lanelet2
from asp_env.data.readers.positions import Origin
from asp_env.data.readers.tags import speed_mps
from asp_env.data.road_map import Ragged, RoadMap
from asp_env.data.source import open_data
from asp_env.errors import DataError
from tests.data.levelx_files import ORIGIN_M, osm

ORIGIN = Origin(x_m=ORIGIN_M[0], y_m=ORIGIN_M[1], longitude_deg=6.1, latitude_deg=50.5)


def road_with(folder: Path, **tags: str) -> RoadMap:
    """A map of one lanelet, 10 by 4 m along +x, with the given tags, and a crosswalk."""
    ways = {
        "l": ([(0.0, 2.0), (10.0, 2.0)], {}),
        "r": ([(0.0, -2.0), (10.0, -2.0)], {}),
        "a": ([(20.0, 2.0), (20.0, -2.0)], {}),
        "b": ([(23.0, 2.0), (23.0, -2.0)], {}),
    }
    lanelets = {
        "1": ({"left": "a", "right": "b"}, {"type": "lanelet", "subtype": "crosswalk"}),
        "2": ({"left": "l", "right": "r"}, {"type": "lanelet", "subtype": "road"} | tags),
    }
    path = folder / "place.osm"
    path.write_text(osm(ways, lanelets))
    return read_lanelet2(path, ORIGIN)


def test_areas(tmp_path: Path) -> None:
    """One ring for each lane, the left bound first; crosswalks are drivable, but not lanes."""
    road = road_with(tmp_path)
    assert (len(road.lanes), len(road.areas), len(road.drivable)) == (1, 1, 2)
    np.testing.assert_allclose(road.areas[0], [(0, 2), (10, 2), (10, -2), (0, -2)], atol=1e-4)
    assert not road.two_way.any()
    assert not road.limited.any()


@pytest.mark.parametrize(
    ("tags", "two_way"),
    [
        ({}, False),
        ({"one_way": "yes"}, False),
        ({"one_way": "no"}, True),
        ({"oneway": "no"}, True),
    ],
)
def test_two_way(tmp_path: Path, tags: dict[str, str], two_way: bool) -> None:
    """Lanes are one-way unless a tag of Lanelet2 or OSM differs."""
    assert road_with(tmp_path, **tags).two_way.tolist() == [two_way]


@pytest.mark.parametrize(
    ("text", "limit"),
    [
        ("50", 50 / 3.6),
        ("50 km/h", 50 / 3.6),
        ("50km/h", 50 / 3.6),
        (" 7.5 KM/H ", 7.5 / 3.6),
        ("10 m/s", 10.0),
        ("30 mph", 13.4112),
        ("none", None),
        ("walk", None),
        ("", None),
        ("50 knots", None),
        ("-50", None),
    ],
)
def test_speed_tags(text: str, limit: float | None) -> None:
    """Numbers with units; anything else is unknown."""
    assert speed_mps(text) == pytest.approx(limit)


def test_speed_limits(tmp_path: Path) -> None:
    """Lanelet2's tag has priority over OSM's."""
    for tags, limit in (
        ({"maxspeed": "36"}, 10.0),
        ({"speed_limit": "72 km/h", "maxspeed": "36"}, 20.0),
    ):
        road = road_with(tmp_path, **tags)
        assert road.limited.tolist() == [True]
        assert road.limits_mps.tolist() == pytest.approx([limit])


def test_the_cache_returns_the_same_lanes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ASP_ENV_CACHE", str(tmp_path))
    first, second = (open_data("sample:intersection")[0].road_map for _ in range(2))
    assert first is not second
    assert len(first.areas) == len(first.lanes) > 0
    assert first.limited.all()
    assert first.limits_mps == pytest.approx(50 / 3.6)
    for name in ("two_way", "limits_mps", "limited"):
        np.testing.assert_array_equal(getattr(first, name), getattr(second, name))
    np.testing.assert_array_equal(first.areas.points, second.areas.points)


def test_areas_of_some_lanes_only_are_refused() -> None:
    def map_with(areas: int) -> RoadMap:
        square = np.array([(0, 0), (1, 0), (1, 1)])
        return RoadMap(
            name="by hand",
            lines=Ragged.pack([]),
            line_types=np.zeros(0, dtype=np.int64),
            drivable=Ragged.pack([square]),
            lanes=Ragged.pack([square[:2]] * 2),
            successors=np.zeros((0, 2), dtype=np.int64),
            areas=Ragged.pack([square] * areas),
            two_way=np.zeros(areas, dtype=bool),
            limits_mps=np.zeros(areas),
            limited=np.zeros(areas, dtype=bool),
        )

    assert len(map_with(0).areas) == 0
    assert len(map_with(2).areas) == 2
    with pytest.raises(DataError, match=r"map by hand: \[1\] areas, .* all 2 lanes, or none"):
        map_with(1)
