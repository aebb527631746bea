"""Tables and folders as spreadsheets, other systems and other releases write them."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from asp_env.data.readers.tables import has_columns, read_table
from asp_env.data.source import open_data
from asp_env.errors import DataError, RepairWarning
from tests.data import interaction_files, levelx_files
from tests.data.levelx_files import attributes_in_degrees, two_lane_road, write_folder, write_map

TEXT = "id,x,y\n1,2.5,3\n2,4.5,5\n"


@pytest.fixture(autouse=True)
def _own_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ASP_ENV_CACHE", str(tmp_path / "cache"))


@pytest.mark.parametrize(
    "text",
    [
        TEXT,
        "\n \n" + TEXT,
        TEXT.replace("\n", "\n\n") + "   \n",
        TEXT.replace("\n", "\r\n"),
        TEXT.replace("\n", ",\n"),
        "id,x,y\n1,2.5,3,\n2,4.5,5,,\n",
        "\ufeff" + TEXT.rstrip(),
        '"id","x","y"\n"1","2.5","3"\n"2","4.5","5"\n',
        "id, x, y\n1, 2.5, 3\n2, 4.5, 5\n",
    ],
    ids=["plain", "above", "between", "crlf", "commas", "longer", "bom", "quotes", "spaces"],
)
def test_tables_that_are_read(tmp_path: Path, text: str) -> None:
    path = tmp_path / "table.csv"
    path.write_bytes(text.encode())
    table = read_table(path, {"id": "id", "x": "number", "y": "number"})
    assert [table[name].tolist() for name in table] == [[1, 2], [2.5, 4.5], [3.0, 5.0]]


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (TEXT.replace(",", ";").encode(), r"line 1: columns are separated by ';', expected ','"),
        (TEXT.replace(",", ";").replace(".", ",").encode(), "separated by ';'"),
        (TEXT.replace(",", "\t").encode(), "separated by"),
        (TEXT.encode("utf-16"), "encoded in UTF-16 or UTF-32, expected UTF-8"),
        (TEXT.encode("utf-16-le"), "encoded in UTF-16"),
        (TEXT.encode("utf-16-be"), "encoded in UTF-16"),
        (TEXT.replace("\n", "\r").encode(), "carriage returns alone"),
        (b"# by hand\n" + TEXT.encode(), r"lacks the column .* rename or add the column"),
        (TEXT.encode() + bytes(99), "line 4: has 1 fields, expected 3"),
        (b"id,x,y\n1,2.5,3,4\n", "line 2: has 4 fields, expected 3"),
        (b"id,x,y\nv1,2.5,3\n", "line 2: id is 'v1', .* number the agents in all tables"),
    ],
)
def test_tables_that_are_refused(tmp_path: Path, content: bytes, message: str) -> None:
    path = tmp_path / "table.csv"
    path.write_bytes(content)
    with pytest.raises(DataError, match=message):
        read_table(path, {"id": "id", "x": "number", "y": "number"})


@pytest.mark.parametrize(
    "change",
    [
        lambda text: text.replace(",", ";").encode(),
        lambda text: text.encode("utf-16"),
        lambda text: ("\n" + text).encode(),
    ],
)
def test_a_reader_that_goes_by_columns_finds_tables_of_spreadsheets(
    tmp_path: Path, change: Callable[[str], bytes]
) -> None:
    """So that the error is about the table, not that there is no recording."""
    path = tmp_path / "table.csv"
    path.write_bytes(change(TEXT))
    assert has_columns(path, ["ID", "x"])
    assert not has_columns(path, ["id", "z"])


def test_sizes_may_be_empty(tmp_path: Path) -> None:
    """Empty in the rows: those of the metadata are used."""
    tracks = levelx_files.track_rows(0, np.arange(100), 25.0).assign(width="", length="")
    data = levelx_files.write_recording(tmp_path, classes=["car"], tracks=tracks)
    write_map(tmp_path)
    path = data / "00_tracksMeta.csv"
    path.write_text(path.read_text().replace(",,,car", ",1.75,4.25,car"))
    assert open_data(tmp_path)[0].sizes.tolist() == [[4.25, 1.75]]


@pytest.mark.parametrize("first", [1_000_000, 9_007_199_254])
def test_case_ids_of_many_digits_name_their_recordings(tmp_path: Path, first: int) -> None:
    cars = interaction_files.some_cars()
    tables = [cars.assign(case_id=float(first + number)) for number in range(2)]
    path = tmp_path / "train" / f"{interaction_files.PLACE}_train.csv"
    path.parent.mkdir()
    pd.concat(tables).to_csv(path, index=False)
    interaction_files.write_map(tmp_path)
    names = open_data(tmp_path).names
    assert names == tuple(f"{interaction_files.PLACE}_train/{first + n}" for n in range(2))


def test_case_ids_that_are_not_exact_are_refused(tmp_path: Path) -> None:
    """2**53 and 2**53 + 1 are one number in double precision."""
    cars = interaction_files.some_cars()
    path = tmp_path / "train" / f"{interaction_files.PLACE}_train.csv"
    path.parent.mkdir()
    pd.concat([cars.assign(case_id=2**53 + n) for n in range(2)]).to_csv(path, index=False)
    interaction_files.write_map(tmp_path)
    with pytest.raises(
        DataError, match=r"case_id is '9007199254740992', .* expected a number from"
    ):
        open_data(tmp_path)[0]


def test_a_choice_between_maps_is_reported(tmp_path: Path) -> None:
    folder = write_folder(tmp_path / "set")
    second = folder / "maps" / "old" / "location1.osm"
    second.parent.mkdir()
    second.write_text(two_lane_road())
    (line,) = open_data(folder)[0].repairs
    assert line == (
        "map maps/lanelets/01_place/location1.osm is used, the first one, not "
        "maps/old/location1.osm"
    )
    second.rename(folder / "maps" / "lanelets" / "01_place" / "location1 (1).osm")
    (line,) = open_data(folder)[0].repairs
    assert line.startswith("map maps/lanelets/01_place/location1.osm is used, the first one, not ")


def test_a_map_that_is_found_by_its_place_is_reported(tmp_path: Path) -> None:
    write_map(tmp_path).rename(tmp_path / "street.osm")
    levelx_files.write_recording(tmp_path)
    (line,) = open_data(tmp_path)[0].repairs
    assert line == "map street.osm is used, the nearest one, since no name has location 1"


@pytest.mark.parametrize("change", ["roles", "mirror"])
def test_vehicles_against_their_lanes_are_reported(tmp_path: Path, change: str) -> None:
    """Left and right are exchanged in the map, or y is mirrored at the road: traffic keeps left."""
    folder = write_folder(tmp_path / "set")
    tracks = levelx_files.track_rows(0, np.arange(250), 25.0)
    tracks["yCenter"], tracks["yVelocity"], tracks["heading"] = -21.75, 0.0, 0.0
    levelx_files.write_recording(folder, classes=["car"], tracks=tracks)
    assert open_data(folder)[0].repairs == ()
    if change == "mirror":
        tracks["yCenter"] = -40.0 - tracks["yCenter"]
        levelx_files.write_recording(folder, classes=["car"], tracks=tracks)
    else:
        text = two_lane_road().replace("role='left'", "role='l'")
        text = text.replace("role='right'", "role='left'").replace("role='l'", "role='right'")
        write_map(folder, text=text)
    (line,) = open_data(folder)[0].repairs
    assert line.startswith(
        "100 % of the positions of moving vehicles on one-way lanes of the map location1 are "
        "against their direction"
    )


def test_a_map_beside_the_tracks_is_reported(tmp_path: Path) -> None:
    """The car drives from x = 5 to 45 m at 4 m/s; the map begins at 35 m."""
    folder = write_folder(tmp_path / "set")
    tracks = levelx_files.track_rows(0, np.arange(250), 25.0)
    levelx_files.write_recording(folder, classes=["car"], tracks=tracks)

    def moved(points: np.ndarray) -> list[str]:
        return attributes_in_degrees(points + np.array([35, 0]))

    write_map(folder, text=two_lane_road(moved))
    (line,) = open_data(folder)[0].repairs
    assert line.startswith("only 25 % of the positions of moving vehicles lie on the map location1")


def test_regulatory_elements_that_the_file_lacks_are_reported(tmp_path: Path) -> None:
    member = "<member type='relation' ref='999' role='regulatory_element' />"
    text = two_lane_road().replace("<relation id='101'>", f"<relation id='101'>{member}")
    folder = write_folder(tmp_path / "set")
    write_map(folder, text=text)
    with pytest.warns(RepairWarning, match="1 regulatory elements that lanelets refer to .* 999"):
        open_data(folder)[0]


def test_a_file_in_place_of_a_folder_and_tables_of_no_reader(tmp_path: Path) -> None:
    """The folder that the message names can be opened."""
    data = levelx_files.write_recording(tmp_path / "set")
    write_map(tmp_path / "set")
    with pytest.raises(DataError, match=f"give the folder that it is in, {data}"):
        open_data(data / "00_tracks.csv")
    assert len(open_data(data)) == 1
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "rows.csv").write_text(TEXT)
    with pytest.raises(DataError, match=r"no recordings found; .*; rows\.csv are there"):
        open_data(tmp_path / "other")
