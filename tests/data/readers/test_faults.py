"""Damaged files of the inD layout: one line that names the file, the line, and what is expected."""

import gzip
from collections.abc import Callable
from pathlib import Path

import pytest

from asp_env.cli import main
from asp_env.data.source import open_data
from asp_env.errors import AspEnvError, DataError
from tests.data.levelx_files import two_lane_road, write_folder, write_map

META, TRACKS, RECORDING = "00_tracksMeta.csv", "00_tracks.csv", "00_recordingMeta.csv"


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A valid folder with three tracks, and an empty cache."""
    monkeypatch.setenv("ASP_ENV_CACHE", str(tmp_path / "cache"))
    return write_folder(tmp_path / "folder")


def edit_line(
    name: str, line: int, change: Callable[[list[str]], list[str]]
) -> Callable[[Path], None]:
    """A fault: the cells of one line (from 1) of a file are changed."""

    def apply(folder: Path) -> None:
        path = folder / "data" / name
        lines = path.read_text().splitlines()
        lines[line - 1] = ",".join(change(lines[line - 1].split(",")))
        path.write_text("\n".join(lines) + "\n")

    return apply


def set_cell(name: str, line: int, column: int, value: str) -> Callable[[Path], None]:
    """A fault: one cell reads `value`."""
    return edit_line(name, line, lambda cells: [*cells[:column], value, *cells[column + 1 :]])


def truncate(name: str, share: float) -> Callable[[Path], None]:
    """A fault: only the first part of a file's bytes exists."""

    def apply(folder: Path) -> None:
        content = (folder / "data" / name).read_bytes()
        (folder / "data" / name).write_bytes(content[: int(len(content) * share)])

    return apply


def scale_column(name: str, column: int, factor: float) -> Callable[[Path], None]:
    """A function that multiplies a column by a factor, as a wrong unit does."""

    def apply(folder: Path) -> None:
        path = next(folder.rglob(name))
        head, *lines = [line.split(",") for line in path.read_text().splitlines()]
        for cells in lines:
            cells[column] = str(float(cells[column]) * factor)
        path.write_text("".join(",".join(cells) + "\n" for cells in (head, *lines)))

    return apply


def first_lines(name: str, count: int) -> Callable[[Path], None]:
    """A fault: only the first lines of a file exist."""

    def apply(folder: Path) -> None:
        path = folder / "data" / name
        path.write_text("".join(path.read_text().splitlines(keepends=True)[:count]))

    return apply


def repeat_line(name: str, line: int) -> Callable[[Path], None]:
    """A fault: a line is repeated at the end."""

    def apply(folder: Path) -> None:
        path = folder / "data" / name
        path.write_text(path.read_text() + path.read_text().splitlines()[line - 1] + "\n")

    return apply


def remove(name: str) -> Callable[[Path], None]:
    """A fault: a file is missing."""
    return lambda folder: (folder / "data" / name).unlink()


def set_map(text: str) -> Callable[[Path], None]:
    """A fault: the map file holds `text`."""
    return lambda folder: write_map(folder, text=text) and None


def cut_gzip(folder: Path) -> None:
    """A fault: a compressed file that ends early."""
    content = gzip.compress((folder / "data" / TRACKS).read_bytes())
    (folder / "data" / f"{TRACKS}.gz").write_bytes(content[: len(content) // 2])
    (folder / "data" / TRACKS).unlink()


def binary_tracks(folder: Path) -> None:
    """A fault: a binary file."""
    (folder / "data" / TRACKS).write_bytes(bytes(range(256)) * 50)


def remove_map(folder: Path) -> None:
    """A fault: no map."""
    next(folder.rglob("*.osm")).unlink()


FAULTS = {
    "column missing": (
        set_cell(TRACKS, 1, 4, "x"),
        [TRACKS, "lacks the column 'xCenter'", "yCenter"],
    ),
    "two columns missing": (
        edit_line(META, 1, lambda cells: [*cells[:-3], "a", "b", "class"]),
        [META, "'width', 'length'"],
    ),
    "rate missing": (set_cell(RECORDING, 1, 2, "Hz"), [RECORDING, "'frameRate'"]),
    "NaN position": (set_cell(TRACKS, 11, 4, "nan"), [f"{TRACKS}, line 11", "xCenter", "finite"]),
    "infinite position": (
        set_cell(TRACKS, 300, 5, "-inf"),
        [f"{TRACKS}, line 300", "yCenter is '-inf'"],
    ),
    "empty cell": (set_cell(TRACKS, 5, 6, ""), [f"{TRACKS}, line 5", "heading is ''", "number"]),
    "word": (set_cell(TRACKS, 9, 9, "fast"), [f"{TRACKS}, line 9", "xVelocity is 'fast'"]),
    "line break in a cell": (
        set_cell(TRACKS, 9, 4, "3\r"),
        [f"{TRACKS}, line 9", "xCenter is '3?'"],
    ),
    "line break in the header": (set_cell(TRACKS, 1, 1, "trackId\r"), [TRACKS, "'trackId'"]),
    "quote that stays open": (set_cell(TRACKS, 1, 0, '"recordingId'), [TRACKS, "lacks the column"]),
    "half a frame": (set_cell(TRACKS, 9, 2, "3.5"), [f"{TRACKS}, line 9", "whole number"]),
    "negative frame": (set_cell(TRACKS, 2, 2, "-1"), [f"{TRACKS}, line 2", "frame is -1"]),
    "short line": (
        edit_line(TRACKS, 100, lambda cells: cells[:9]),
        [f"{TRACKS}, line 100", "has 9 fields, expected 17"],
    ),
    "long line": (
        edit_line(TRACKS, 100, lambda cells: cells + cells[:3]),
        [f"{TRACKS}, line 100", "has 20 fields, expected 17"],
    ),
    "short line of the metadata": (
        edit_line(META, 3, lambda cells: cells[:2]),
        [f"{META}, line 3", "has 2 fields, expected 8"],
    ),
    "half a file": (truncate(TRACKS, 0.5), [TRACKS, "fields, expected 17", "copy the file again"]),
    "whole lines lost": (first_lines(TRACKS, 251), [TRACKS, "no row for 2 tracks", "line 3"]),
    "empty tracks": (truncate(TRACKS, 0.0), [TRACKS, "is empty"]),
    "empty metadata": (truncate(META, 0.0), [META, "is empty"]),
    "empty recording": (truncate(RECORDING, 0.0), [RECORDING, "is empty"]),
    "header of tracks": (first_lines(TRACKS, 1), [TRACKS, "has a header but no rows"]),
    "header of metadata": (first_lines(META, 1), [META, "has a header but no rows"]),
    "header of recording": (first_lines(RECORDING, 1), [RECORDING, "has a header but no rows"]),
    "no recording metadata": (remove(RECORDING), [RECORDING, "no such file"]),
    "no track metadata": (remove(META), [META, "no such file"]),
    "no tracks": (remove(TRACKS), [TRACKS, "no such file"]),
    "two columns of one name": (
        set_cell(TRACKS, 1, 3, " xCenter"),
        [f"{TRACKS}, line 1", "columns 4 and 5 are called 'xCenter'", "rename or remove"],
    ),
    "two recordings in the metadata": (
        repeat_line(RECORDING, 2),
        [f"{RECORDING}, line 3", "a second row", "expected one row"],
    ),
    "row twice": (repeat_line(TRACKS, 20), [f"{TRACKS}, line 749", "track 0 at frame 18"]),
    "track listed twice": (repeat_line(META, 3), [f"{META}, line 5", "track 1 is listed twice"]),
    "track not listed": (first_lines(META, 3), [f"{TRACKS}, line 501", "track 2", META]),
    "rate zero": (set_cell(RECORDING, 2, 2, "0"), [RECORDING, "frameRate is 0", "1 to 250 Hz"]),
    "rate NaN": (set_cell(RECORDING, 2, 2, "NaN"), [f"{RECORDING}, line 2", "frameRate", "finite"]),
    "rate of 1000 Hz": (set_cell(RECORDING, 2, 2, "1000"), ["frameRate is 1000", "1 to 250 Hz"]),
    "position beyond single precision": (
        set_cell(TRACKS, 11, 4, "1e39"),
        [f"{TRACKS}, line 11: xCenter is '1e39', expected metres from -10,000,000 to 10,000,000"],
    ),
    "one position far away": (
        set_cell(TRACKS, 11, 5, "-30000"),
        [f"{TRACKS}, line 11: yCenter is -30000", "m from the median of the file; expected metres"],
    ),
    "positions in micrometres": (
        scale_column(TRACKS, 5, 1e6),
        [f"{TRACKS}, line 2: yCenter is '-2", "and 746 of 746 other rows", "expected metres"],
    ),
    "positions in millimetres": (
        scale_column(TRACKS, 4, 1e3),
        [TRACKS, "xCenter is", "rows are; expected metres, all within 10,000 m", "convert"],
    ),
    "heading that is NaN in single precision": (
        set_cell(TRACKS, 11, 6, "1e308"),
        [f"{TRACKS}, line 11: heading is '1e308', expected degrees from -36,000 to 36,000"],
    ),
    "velocity": (
        set_cell(TRACKS, 11, 10, "-101"),
        [f"{TRACKS}, line 11: yVelocity is '-101', expected m/s from -100 to 100"],
    ),
    "acceleration": (set_cell(TRACKS, 11, 11, "1e39"), ["line 11: xAcceleration is '1e39'"]),
    "size": (set_cell(TRACKS, 11, 8, "1e308"), ["line 11: length is '1e308', expected metres"]),
    "size in the metadata": (set_cell(META, 3, 5, "450"), [f"{META}, line 3: width is '450'"]),
    "speed limit": (
        set_cell(RECORDING, 2, 3, "1e23"),
        [f"{RECORDING}, line 2: speedLimit is 1e+23, expected at most 45 m/s"],
    ),
    "origin": (set_cell(RECORDING, 2, 12, "1e308"), [f"{RECORDING}, line 2: xUtmOrigin"]),
    "longitude": (set_cell(RECORDING, 2, 11, "200"), ["lonLocation is '200', expected degrees"]),
    "id that wraps in 32 bits": (
        set_cell(TRACKS, 11, 1, "4294967296"),
        [f"{TRACKS}, line 11: track 4294967296 is not in {META}"],
    ),
    "id that wraps in 64 bits": (
        set_cell(TRACKS, 11, 1, "18446744073709551616"),
        [f"{TRACKS}, line 11: track 18446744073709551616 is not in {META}"],
    ),
    "id that is no whole number": (
        set_cell(TRACKS, 11, 1, "1.5"),
        [f"{TRACKS}, line 11: trackId is '1.5', expected a whole number"],
    ),
    "frame of 20 digits": (
        set_cell(TRACKS, 11, 2, "18446744073709551616"),
        [f"{TRACKS}, line 11: frame is '18446744073709551616'", "below 9,007,199,254,740,992"],
    ),
    "frame far away": (
        set_cell(TRACKS, 250, 2, "3000000000"),
        [f"{TRACKS}, line 250: is 2,999,999,", "less than 10,000,000 frames"],
    ),
    "cut gzip": (cut_gzip, [f"{TRACKS}.gz", "copy it again"]),
    "another kind of file": (binary_tracks, [TRACKS]),
    "no map": (remove_map, ["no map for location 1", "location1.osm"]),
    "map without lanelets": (set_map("<osm></osm>"), ["location1.osm", "has no lanelets"]),
    "map is a pointer": (set_map("version https://git-lfs.github.com/spec/v1\n"), ["git lfs pull"]),
    "map is a web page": (set_map("\n<!DOCTYPE html>\n<html></html>"), ["is a web page"]),
    "map without bounds": (
        set_map(two_lane_road().replace("role='left'", "role='Left'")),
        ["location1.osm", "none of its 2 lanelets has both bounds", "roles 'left' and 'right'"],
    ),
    "map that is no XML": (set_map("lat,lon\n1,2\n"), ["location1.osm", "is not XML"]),
    "map that is cut": (set_map("<osm><node id='1'"), ["location1.osm", "is not XML"]),
    "map that is empty": (set_map(""), ["location1.osm", "is not XML"]),
    "map in an encoding of no text": (
        set_map("<?xml version='1.0' encoding='base64'?><osm/>"),
        ["location1.osm", "is not XML", "base64"],
    ),
    "map in an encoding of several bytes": (
        set_map("<?xml version='1.0' encoding='gbk'?><osm/>"),
        ["location1.osm", "is not XML"],
    ),
    "map in an unknown encoding": (
        set_map("<?xml version='1.0' encoding='none'?><osm/>"),
        ["location1.osm", "is not XML"],
    ),
    "map in an encoding of a long name": (
        set_map(f"<?xml version='1.0' encoding='U{10**3000}'?><osm/>"),
        ["location1.osm: is not XML", "..."],
    ),
    "map with entities": (
        set_map("<!DOCTYPE osm [<!ENTITY a 'x'><!ENTITY b '&a;&a;'>]><osm>&b;</osm>"),
        ["location1.osm", "declares the XML entity 'a'", "put the right file"],
    ),
    "map that names another file": (
        set_map("<!DOCTYPE osm [<!ENTITY a SYSTEM 'file:///etc/hostname'>]><osm>&a;</osm>"),
        ["location1.osm", "declares the XML entity 'a'"],
    ),
    "map that begins with an unknown entity": (
        set_map("<!DOCTYPE osm SYSTEM 'other.dtd'><osm>&a;</osm>"),
        ["location1.osm"],
    ),
}


@pytest.mark.parametrize("name", FAULTS)
def test_each_fault_is_one_line(folder: Path, name: str) -> None:
    """Listing finds no fault; opening names what is needed to find it."""
    spoil, expected = FAULTS[name]
    spoil(folder)
    recordings = open_data(folder)
    assert recordings.names == ("00",)
    with pytest.raises(DataError) as caught:
        recordings[0]
    message = str(caught.value)
    assert "\n" not in message
    assert all(part in message for part in expected), message


@pytest.mark.parametrize("name", ["NaN position", "map without lanelets"])
def test_a_fault_is_found_despite_a_cached_recording(folder: Path, name: str) -> None:
    assert len(open_data(folder)[0]) == 3
    FAULTS[name][0](folder)
    with pytest.raises(DataError):
        open_data(folder)[0]


def test_a_failed_read_caches_nothing(folder: Path, tmp_path: Path) -> None:
    FAULTS["half a file"][0](folder)
    with pytest.raises(DataError):
        open_data(folder)[0]
    assert not list((tmp_path / "cache").iterdir())


@pytest.mark.parametrize("name", ["NaN position", "no recording metadata"])
def test_a_command_ends_with_status_2_and_one_line(
    folder: Path, capsys: pytest.CaptureFixture[str], name: str
) -> None:
    FAULTS[name][0](folder)
    assert main(["inspect", str(folder)]) == 2
    captured = capsys.readouterr().err
    assert captured.startswith("asp-env: ")
    assert captured.count("\n") == 1


def test_an_impossible_time_step_lists_possible_ones(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """0.07 s at 25 Hz: status 2, one line."""
    assert main(["inspect", str(folder), "--dt", "0.07"]) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert "0.04, 0.05, 0.06, 0.075, 0.1 s" in captured.err
    assert captured.err.count("\n") == 1


def test_data_errors_are_errors_of_the_project() -> None:
    assert issubclass(DataError, AspEnvError)
