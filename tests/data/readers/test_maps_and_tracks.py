"""How a recording's tracks decide what of a map is used; nodes without valid positions."""

import math
import re
from pathlib import Path

import numpy as np
import pytest
from pyproj import Transformer

from asp_env.cli import main
from asp_env.data.readers.placing import Box, used_region
from asp_env.data.recording import Recording
from asp_env.data.source import open_data
from asp_env.errors import DataError, RepairWarning
from asp_env.metrics.drivable import drivable_field
from tests.data import interaction_files, levelx_files
from tests.data.levelx_files import two_lane_road, write_folder, write_map


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with one recording, and an empty cache."""
    monkeypatch.setenv("ASP_ENV_CACHE", str(tmp_path / "cache"))
    return write_folder(tmp_path / "folder")


def open_with(folder: Path, text: str) -> Recording:
    """The recording, with a map of this content."""
    write_map(folder, text=text)
    return open_data(folder)[0]


def moved(text: str, degrees: float) -> str:
    """A map farther north."""
    return re.sub(r"lat='([0-9.]+)'", lambda found: f"lat='{float(found[1]) + degrees:.12f}'", text)


def with_lanelet(x: float, y: float, subtype: str = "road", length: float = 50.0) -> str:
    """The road of the recording, and another lanelet along +x, 3 m wide."""
    points = np.array([(x, y), (x + length, y), (x, y + 3.0), (x + length, y + 3.0)])
    nodes = levelx_files.attributes_in_degrees(points)
    extra = "".join(f"<node id='9{i}' {position} />" for i, position in enumerate(nodes))
    extra += "<way id='r9'><nd ref='90' /><nd ref='91' /></way>"
    extra += "<way id='l9'><nd ref='92' /><nd ref='93' /></way>"
    sides = "<member type='way' ref='l9' role='left' /><member type='way' ref='r9' role='right' />"
    tags = f"<tag k='type' v='lanelet' /><tag k='subtype' v='{subtype}' />"
    return two_lane_road().replace(
        "</osm>", f"{extra}<relation id='900'>{sides}{tags}</relation></osm>"
    )


def test_a_map_of_another_place_is_an_error(folder: Path) -> None:
    """0.02° north are 2.2 km: the message states the distance."""
    with pytest.raises(DataError, match=r"another place .*: 0\.0 % .* nearest lane is 2,2\d\d m"):
        open_with(folder, moved(two_lane_road(), 0.02))


def test_a_map_of_a_street_nearby_is_an_error(folder: Path) -> None:
    """0.001° are 111 m, within the map's margin."""
    with pytest.raises(DataError, match=r"another place .* nearest lane is 1\d\d m"):
        open_with(folder, moved(two_lane_road(), 0.001))


def test_recordings_without_moving_vehicles_are_not_checked(folder: Path) -> None:
    tracks = levelx_files.track_rows(0, np.arange(250), 25.0, "pedestrian")
    levelx_files.write_recording(folder, classes=("pedestrian",), tracks=tracks)
    assert len(open_with(folder, moved(two_lane_road(), 0.02))) == 1


def test_only_the_part_of_a_town_near_the_tracks_is_used(folder: Path) -> None:
    """A lanelet 3 km away: left out, and the distance field has the cells of the site's own map.

    The values of both fields are equal, since the grids are aligned.
    """
    alone = open_data(folder)[0].road_map
    far = open_with(folder, with_lanelet(3000.0, 3000.0)).road_map
    assert far.repairs == ("1 of 3 lanelets left out, since they are far from all tracks",)
    np.testing.assert_array_equal(far.lanes.points, alone.lanes.points)
    field, expected = drivable_field(far), drivable_field(alone)
    assert math.prod(field.shape) < 1.2 * math.prod(expected.shape)
    points = np.random.default_rng(0).uniform((-10, -40), (140, 0), (500, 2))
    np.testing.assert_allclose(field.distance_m(points), expected.distance_m(points), atol=0.15)


def test_a_long_lanelet_is_complete_but_its_field_is_not(folder: Path) -> None:
    """A road of 4 km begins 120 m north of the tracks."""
    road = open_with(folder, with_lanelet(60.0, 100.0, length=4000.0)).road_map
    assert len(road.lanes) == 3
    assert road.lanes.points[:, 0].max() > 4000
    assert road.region_m is not None
    assert road.extent_m[2] <= road.region_m[2] < 400
    assert drivable_field(road).shape[1] < 4000


def test_small_maps_are_used_as_a_whole(folder: Path) -> None:
    road = open_with(folder, with_lanelet(300.0, 300.0)).road_map
    assert (road.region_m, len(road.lanes), road.repairs) == (None, 3, ())


@pytest.mark.parametrize(
    ("tracks", "expected"),
    [
        ((0.0, 0.0, 10.0, 10.0), (-100.0, -100.0, 150.0, 150.0)),
        ((510.0, 620.0, 510.0, 620.0), (400.0, 500.0, 650.0, 750.0)),
        ((0.0, 0.0, 999.0, 999.0), None),
    ],
)
def test_regions(tracks: Box, expected: Box | None) -> None:
    """100 m around the tracks, at multiples of 50 m from the map's corner (0, 0)."""
    assert used_region(tracks, (0.0, 0.0, 1000.0, 1000.0)) == expected


@pytest.mark.parametrize(("subtype", "along"), [("shoulder", True), ("shoulder", False)])
def test_unlisted_subtypes_are_roads_where_vehicles_drive(
    folder: Path, subtype: str, along: bool
) -> None:
    """The car in the lane south of the middle drives through it, or no vehicle does."""
    text = with_lanelet(10.0, -22.5 if along else -40.0, subtype)
    road = open_with(folder, text).road_map
    assert len(road.lanes) == 2 + along
    (repair,) = road.repairs
    assert repair.startswith("1 lanelets of unlisted subtypes (shoulder)")
    assert ("are roads, since vehicles drive along them" in repair) == along


def test_repairs_are_one_warning_and_lines_of_inspect(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    text = with_lanelet(3000.0, 3000.0).replace("<nd ref='1' />", "<nd ref='1' /><nd ref='77' />")
    with pytest.warns(RepairWarning, match=r"map location1\.osm: 1 ways refer .*; 1 of 3 lanelets"):
        open_with(folder, text)
    assert main(["inspect", str(folder)]) == 0
    printed = capsys.readouterr()
    assert "Repairs: 2\n" in printed.out
    assert printed.err == ""


@pytest.mark.parametrize(
    ("old", "new", "why"),
    [
        (r"lat='[0-9.]+' lon='[0-9.]+'", "lat='0.0' lon='0.0'", "without a valid position"),
        (r"lon='[0-9.]+'", "lon='0.0'", "without a valid position"),
        (r"lat='[0-9.]+'", "lat='inf'", "without a valid position"),
        (r"lat='[0-9.]+'", "lat='95.0'", "without a valid position"),
        (r"lat='[0-9.]+'", "lat='50,5'", "without a valid position"),
        (r"lat='50\.", "lat='40.", "farther than 200 m from all others"),
        (r"lat='(50\.\d)\d", r"lat='\g<1>9", "farther than 200 m from all others"),
    ],
)
def test_stray_nodes_are_left_out(folder: Path, old: str, new: str, why: str) -> None:
    """One node of nine at 0° 0°, at infinity, or kilometres away."""
    text = re.sub(old, new, two_lane_road(), count=1)
    assert text != two_lane_road()
    road = open_with(folder, text).road_map
    assert road.repairs[0] == f"1 nodes {why} left out: 1"
    assert max(abs(side) for side in road.extent_m) < 200


def test_a_map_without_positions_is_an_error(folder: Path) -> None:
    """Decimal commas: the message shows a node."""
    text = re.sub(r"(lat|lon)='(\d+)\.(\d+)'", r"\1='\2,\3'", two_lane_road())
    with pytest.raises(
        DataError, match=r"9 nodes have no positions .*lat='50,\d+'.* decimal point"
    ):
        open_with(folder, text)


def autoware(attributes: str) -> str:
    """The road with positions in the tags `local_x` and `local_y`."""
    text = two_lane_road(interaction_files.attributes_in_metres)
    return re.sub(
        r"x='([-0-9.]+)' y='([-0-9.]+)' />",
        rf"{attributes}><tag k='local_x' v='\1' /><tag k='local_y' v='\2' /></node>",
        text,
    )


@pytest.mark.parametrize("attributes", ["lat='' lon=''", "", "lat='0.0' lon='0.0'"])
def test_positions_in_tags(tmp_path: Path, attributes: str) -> None:
    """Autoware's maps without degrees: as the map in local metres, and reported."""
    interaction_files.write_recording(tmp_path)
    interaction_files.write_map(tmp_path, text=autoware(attributes))
    road = open_data(tmp_path / "recorded_trackfiles")[0].road_map
    np.testing.assert_allclose(road.lanes[0][0], (0.0, -21.75), atol=1e-6)
    assert road.repairs == ("9 nodes are at the tags local_x and local_y, not at lat and lon",)


def test_degrees_of_another_place_give_way_to_positions_in_tags(tmp_path: Path) -> None:
    """Real degrees beside tracks in a local frame."""
    back = Transformer.from_crs(32632, 4326, always_xy=True)
    lon, lat = back.transform(500_000.0, 5_400_000.0)
    numbers = iter(range(100))
    text = re.sub(
        "LAT", lambda _: f"{lat + 1e-5 * next(numbers):.8f}", autoware("lat='LAT' lon='LON'")
    )
    interaction_files.write_recording(tmp_path)
    interaction_files.write_map(tmp_path, text=text.replace("LON", f"{lon:.8f}"))
    assert open_data(tmp_path / "recorded_trackfiles")[0].road_map.repairs[0].startswith("9 nodes")


def test_metres_in_a_file_for_degrees(tmp_path: Path) -> None:
    interaction_files.write_recording(tmp_path)
    interaction_files.write_map(
        tmp_path, text=two_lane_road(interaction_files.attributes_in_metres)
    )
    road = open_data(tmp_path / "recorded_trackfiles")[0].road_map
    assert road.repairs == ("9 nodes are at x and y in metres, not at lat and lon",)
