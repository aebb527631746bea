"""Whatever is wrong with the files: one line that names file, line, what is there and what not."""

import gzip
from collections.abc import Callable
from pathlib import Path

import pytest

from asp_env.cli import main
from asp_env.data.source import open_data
from asp_env.errors import AspEnvError, DataError
from tests.data.levelx_files import write_folder, write_map

META, TRACKS, RECORDING = "00_tracksMeta.csv", "00_tracks.csv", "00_recordingMeta.csv"


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A good folder of three tracks, and a cache of its own."""
    monkeypatch.setenv("ASP_ENV_CACHE", str(tmp_path / "cache"))
    return write_folder(tmp_path / "folder")


def edit(name: str, line: int, change: Callable[[list[str]], list[str]]) -> Callable[[Path], None]:
    """A fault: the cells of one line (from 1) of a file are changed."""

    def apply(folder: Path) -> None:
        path = folder / "data" / name
        lines = path.read_text().splitlines()
        lines[line - 1] = ",".join(change(lines[line - 1].split(",")))
        path.write_text("\n".join(lines) + "\n")

    return apply


def cell(name: str, line: int, column: int, value: str) -> Callable[[Path], None]:
    """A fault: one cell reads `value`."""
    return edit(name, line, lambda cells: [*cells[:column], value, *cells[column + 1 :]])


def keep(name: str, share: float) -> Callable[[Path], None]:
    """A fault: only the first part of a file's bytes is there."""

    def apply(folder: Path) -> None:
        content = (folder / "data" / name).read_bytes()
        (folder / "data" / name).write_bytes(content[: int(len(content) * share)])

    return apply


def lines(name: str, count: int) -> Callable[[Path], None]:
    """A fault: only the first lines of a file are there."""

    def apply(folder: Path) -> None:
        path = folder / "data" / name
        path.write_text("".join(path.read_text().splitlines(keepends=True)[:count]))

    return apply


def double(name: str, line: int) -> Callable[[Path], None]:
    """A fault: a line is there twice, the second time at the end."""

    def apply(folder: Path) -> None:
        path = folder / "data" / name
        path.write_text(path.read_text() + path.read_text().splitlines()[line - 1] + "\n")

    return apply


def remove(name: str) -> Callable[[Path], None]:
    """A fault: a file is missing."""
    return lambda folder: (folder / "data" / name).unlink()


def osm_is(text: str) -> Callable[[Path], None]:
    """A fault: the map's file holds `text`."""
    return lambda folder: write_map(folder, text=text) and None


def cut_gzip(folder: Path) -> None:
    """A fault: a compressed file that ends early."""
    content = gzip.compress((folder / "data" / TRACKS).read_bytes())
    (folder / "data" / f"{TRACKS}.gz").write_bytes(content[: len(content) // 2])
    (folder / "data" / TRACKS).unlink()


def binary(folder: Path) -> None:
    """A fault: a file of another kind."""
    (folder / "data" / TRACKS).write_bytes(bytes(range(256)) * 50)


def remove_map(folder: Path) -> None:
    """A fault: no map."""
    next(folder.rglob("*.osm")).unlink()


FAULTS = {
    "column missing": (cell(TRACKS, 1, 4, "x"), [TRACKS, "lacks the column 'xCenter'", "yCenter"]),
    "two columns missing": (
        edit(META, 1, lambda cells: [*cells[:-3], "a", "b", "class"]),
        [META, "'width', 'length'"],
    ),
    "rate missing": (cell(RECORDING, 1, 2, "Hz"), [RECORDING, "'frameRate'"]),
    "NaN position": (cell(TRACKS, 11, 4, "nan"), [f"{TRACKS}, line 11", "xCenter", "finite"]),
    "infinite position": (
        cell(TRACKS, 300, 5, "-inf"),
        [f"{TRACKS}, line 300", "yCenter is '-inf'"],
    ),
    "empty cell": (cell(TRACKS, 5, 6, ""), [f"{TRACKS}, line 5", "heading is ''", "number"]),
    "word": (cell(TRACKS, 9, 9, "fast"), [f"{TRACKS}, line 9", "xVelocity is 'fast'"]),
    "line break in a cell": (cell(TRACKS, 9, 4, "3\r"), [f"{TRACKS}, line 9", "xCenter is '3?'"]),
    "line break in the header": (cell(TRACKS, 1, 1, "trackId\r"), [TRACKS, "'trackId'"]),
    "quote that stays open": (cell(TRACKS, 1, 0, '"recordingId'), [TRACKS, "lacks the column"]),
    "half a frame": (cell(TRACKS, 9, 2, "3.5"), [f"{TRACKS}, line 9", "whole number"]),
    "negative frame": (cell(TRACKS, 2, 2, "-1"), [f"{TRACKS}, line 2", "frame is -1"]),
    "short line": (
        edit(TRACKS, 100, lambda cells: cells[:9]),
        [f"{TRACKS}, line 100", "has 9 fields, expected 17"],
    ),
    "long line": (
        edit(TRACKS, 100, lambda cells: cells + cells[:3]),
        [f"{TRACKS}, line 100", "has 20 fields, expected 17"],
    ),
    "short line of the metadata": (
        edit(META, 3, lambda cells: cells[:2]),
        [f"{META}, line 3", "has 2 fields, expected 8"],
    ),
    "half a file": (keep(TRACKS, 0.5), [TRACKS, "fields, expected 17", "copy the file again"]),
    "whole lines lost": (lines(TRACKS, 251), [TRACKS, "no row for 2 tracks", "line 3"]),
    "empty tracks": (keep(TRACKS, 0.0), [TRACKS, "is empty"]),
    "empty metadata": (keep(META, 0.0), [META, "is empty"]),
    "empty recording": (keep(RECORDING, 0.0), [RECORDING, "is empty"]),
    "header of tracks": (lines(TRACKS, 1), [TRACKS, "has a header but no rows"]),
    "header of metadata": (lines(META, 1), [META, "has a header but no rows"]),
    "header of recording": (lines(RECORDING, 1), [RECORDING, "has a header but no rows"]),
    "no recording metadata": (remove(RECORDING), [RECORDING, "no such file"]),
    "no track metadata": (remove(META), [META, "no such file"]),
    "no tracks": (remove(TRACKS), [TRACKS, "no such file"]),
    "unknown class": (cell(META, 4, 7, "ufo"), [f"{META}, line 4", "unknown class 'ufo'", "car"]),
    "row twice": (double(TRACKS, 20), [f"{TRACKS}, line 749", "track 0 at frame 18"]),
    "track listed twice": (double(META, 3), [f"{META}, line 5", "track 1 is listed twice"]),
    "track not listed": (lines(META, 3), [f"{TRACKS}, line 501", "track 2", META]),
    "rate zero": (cell(RECORDING, 2, 2, "0"), [RECORDING, "frameRate is 0", "positive"]),
    "rate NaN": (cell(RECORDING, 2, 2, "NaN"), [f"{RECORDING}, line 2", "frameRate", "finite"]),
    "cut gzip": (cut_gzip, [f"{TRACKS}.gz", "copy it again"]),
    "another kind of file": (binary, [TRACKS]),
    "no map": (remove_map, ["no map for location 1", "location1.osm"]),
    "map without lanelets": (osm_is("<osm></osm>"), ["location1.osm", "has no lanelets"]),
    "map that is no XML": (osm_is("lat,lon\n1,2\n"), ["location1.osm", "is not XML"]),
    "map that is cut": (osm_is("<osm><node id='1'"), ["location1.osm", "is not XML"]),
    "map that is empty": (osm_is(""), ["location1.osm", "is not XML"]),
}


@pytest.mark.parametrize("name", FAULTS)
def test_fault(folder: Path, name: str) -> None:
    """Each fault is one line with what it takes to find it, and none is met before opening."""
    spoil, expected = FAULTS[name]
    spoil(folder)
    recordings = open_data(folder)
    assert recordings.names == ("00",)
    with pytest.raises(DataError) as caught:
        recordings[0]
    message = str(caught.value)
    assert "\n" not in message
    assert all(part in message for part in expected), message


@pytest.mark.parametrize("name", ["NaN position", "map without lanelets", "unknown class"])
def test_fault_after_a_good_read(folder: Path, name: str) -> None:
    """What the cache holds of a good file does not hide that it has been damaged since."""
    assert len(open_data(folder)[0]) == 3
    FAULTS[name][0](folder)
    with pytest.raises(DataError):
        open_data(folder)[0]


def test_nothing_is_kept_of_a_bad_read(folder: Path, tmp_path: Path) -> None:
    """A recording that cannot be read leaves no table in the cache, its map at most."""
    FAULTS["half a file"][0](folder)
    with pytest.raises(DataError):
        open_data(folder)[0]
    assert [path.name[:9] for path in (tmp_path / "cache").iterdir()] == ["location1"]


@pytest.mark.parametrize("name", ["NaN position", "no recording metadata", "unknown class"])
def test_exit_status(folder: Path, capsys: pytest.CaptureFixture[str], name: str) -> None:
    """The command ends with status 2 and one line on the error stream."""
    FAULTS[name][0](folder)
    assert main(["inspect", str(folder)]) == 2
    told = capsys.readouterr().err
    assert told.startswith("asp-env: ")
    assert told.count("\n") == 1


def test_impossible_time_step(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """0.07 s at 25 Hz is refused with the steps that divide: status 2, one line."""
    assert main(["inspect", str(folder), "--dt", "0.07"]) == 2
    told = capsys.readouterr()
    assert told.out == ""
    assert "0.04, 0.08" in told.err
    assert told.err.count("\n") == 1


def test_faults_are_data_errors() -> None:
    """Whoever catches bad input catches these."""
    assert issubclass(DataError, AspEnvError)
