"""Damaged files of the INTERACTION layout: one line that names file and line; others open."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from asp_env.cli import main
from asp_env.data.readers.interaction import (
    InteractionFiles,
    find_recordings,
    read_interaction,
    read_meta,
)
from asp_env.data.readers.layout import TrackTable
from asp_env.data.source import open_data
from asp_env.errors import DataError
from tests.data.interaction_files import (
    PLACE,
    walk,
    write_folder,
    write_map,
    write_recording,
    write_taf_bw,
)

VEHICLES, PEDESTRIANS, META = "vehicle_tracks_000.csv", "pedestrian_tracks_000.csv", "meta_data.csv"


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A valid recording with pedestrians and another one without, and an empty cache."""
    monkeypatch.setenv("ASP_ENV_CACHE", str(tmp_path / "cache"))
    folder = write_folder(tmp_path / "folder", recordings=2)
    write_recording(folder, pedestrians=walk("P1", (0, 0), (0, 1), 20))
    return folder


def set_cell(name: str, line: int, column: int, value: str) -> Callable[[Path], None]:
    """A fault: one cell of a line (from 1) reads `value`."""

    def apply(folder: Path) -> None:
        (path,) = folder.rglob(name)
        lines = path.read_text().splitlines()
        cells = lines[line - 1].split(",")
        lines[line - 1] = ",".join([*cells[:column], value, *cells[column + 1 :]])
        path.write_text("\n".join(lines) + "\n")

    return apply


def change_content(name: str, change: Callable[[str], str]) -> Callable[[Path], None]:
    """A fault: the whole content of a file is changed."""

    def apply(folder: Path) -> None:
        path = next(folder.rglob(name))
        path.write_text(change(path.read_text()))

    return apply


def repeat_line(name: str, line: int) -> Callable[[Path], None]:
    """A fault: a line is repeated at the end."""
    return change_content(name, lambda text: text + text.splitlines()[line - 1] + "\n")


def remove(pattern: str) -> Callable[[Path], None]:
    """A fault: a file is missing."""
    return lambda folder: next(folder.rglob(pattern)).unlink()


def scaled_times(by: float) -> Callable[[Path], None]:
    """A fault: times are in another unit."""

    def change(text: str) -> str:
        head, *lines = text.splitlines()
        cells = [line.split(",") for line in lines]
        scaled = [",".join([*c[:2], f"{float(c[2]) * by:g}", *c[3:]]) for c in cells]
        return "\n".join([head, *scaled]) + "\n"

    return change_content(VEHICLES, change)


def few_rows(count: int) -> Callable[[Path], None]:
    """A fault: there are only the first rows of one vehicle."""

    def apply(folder: Path) -> None:
        remove(PEDESTRIANS)(folder)
        change_content(VEHICLES, lambda text: "\n".join(text.splitlines()[: count + 1]))(
            folder / "recorded_trackfiles"
        )

    return apply


def set_metadata(row: str, header: str = "id,originLat,originLon") -> Callable[[Path], None]:
    """A fault: metadata with this row."""

    def apply(folder: Path) -> None:
        (folder / "recorded_trackfiles" / PLACE / META).write_text(f"{header}\n{row}\n")

    return apply


FAULTS = {
    "column missing": (set_cell(VEHICLES, 1, 4, "x_m"), [VEHICLES, "lacks the column 'x'", "x_m"]),
    "no times": (set_cell(VEHICLES, 1, 2, "t"), [VEHICLES, "lacks the column 'timestamp_ms'"]),
    "column of pedestrians missing": (set_cell(PEDESTRIANS, 1, 5, "lat"), [PEDESTRIANS, "'y'"]),
    "NaN position": (set_cell(VEHICLES, 11, 4, "nan"), [f"{VEHICLES}, line 11", "x is 'nan'"]),
    "infinite heading": (
        set_cell(VEHICLES, 11, 8, "inf"),
        [f"{VEHICLES}, line 11", "psi_rad", "finite"],
    ),
    "empty cell": (set_cell(VEHICLES, 30, 5, ""), [f"{VEHICLES}, line 30", "y is ''", "a number"]),
    "word": (set_cell(PEDESTRIANS, 9, 4, "here"), [f"{PEDESTRIANS}, line 9", "x is 'here'"]),
    "half an id": (set_cell(VEHICLES, 9, 0, "1.5"), [f"{VEHICLES}, line 9", "whole number"]),
    "cut line": (
        change_content(VEHICLES, lambda text: text[:-30]),
        [f"{VEHICLES}, line 274", "fields, expected 11", "copy the file again"],
    ),
    "long line": (set_cell(VEHICLES, 9, 3, "car,car"), [f"{VEHICLES}, line 9", "has 12 fields"]),
    "empty file": (change_content(VEHICLES, lambda _: ""), [VEHICLES, "is empty"]),
    "empty pedestrians": (change_content(PEDESTRIANS, lambda _: ""), [PEDESTRIANS, "is empty"]),
    "headers alone": (
        lambda folder: (
            [
                change_content(name, lambda text: text.splitlines()[0] + "\n")(folder)
                for name in (VEHICLES, PEDESTRIANS)
            ]
            and None
        ),
        [VEHICLES, "has a header but no rows"],
    ),
    "row twice": (
        repeat_line(VEHICLES, 20),
        [f"{VEHICLES}, line 275", "second row of track 1 at 1800 ms", "remove one"],
    ),
    "row of a pedestrian twice": (
        repeat_line(PEDESTRIANS, 4),
        [f"{PEDESTRIANS}, line 22", "second row of track P1 at 200 ms"],
    ),
    "seconds": (scaled_times(0.001), [f"{VEHICLES}, line 2", "0.1 apart", "10000 Hz"]),
    "microseconds": (scaled_times(1000), [f"{VEHICLES}, line 2", "0.01 Hz", "milliseconds"]),
    "one time for all": (scaled_times(0), [f"{VEHICLES}, line 3", "second row of track 1 at 0"]),
    "between frames": (
        set_cell(VEHICLES, 15, 2, "1350"),
        [f"{VEHICLES}, line 15", "timestamp_ms is 1350", "multiples of 100 ms"],
    ),
    "another clock of pedestrians": (
        set_cell(PEDESTRIANS, 15, 2, "1340"),
        [f"{PEDESTRIANS}, line 15", "timestamp_ms is 1340", "multiples of 100 ms"],
    ),
    "one row in each track": (
        few_rows(1),
        [f"{VEHICLES}, line 2", "no track has a second row", "so there is no frame rate"],
    ),
    "tracks too short": (
        few_rows(3),
        [VEHICLES, "no track lasts 0.5 s without a gap or jump"],
    ),
    "pedestrians alone": (remove(VEHICLES), [VEHICLES, "no such file", f"{PEDESTRIANS} exists"]),
    "no map": (remove("*.osm"), [f"no map for location {PLACE}", f"maps/{PLACE}.osm"]),
    "map without lanelets": (
        lambda folder: write_map(folder, text="<osm></osm>") and None,
        [f"{PLACE}.osm", "has no lanelets"],
    ),
    "map of another place": (
        set_metadata("0,49.0,8.4"),
        [
            f"{PLACE}.osm",
            "expected it at its recordings' origin, which is at 49.0000, 8.4000",
            META,
        ],
    ),
    "metadata of another recording": (set_metadata("7,0,0"), [META, "no row whose id is 000"]),
    "metadata twice": (set_metadata("0,0,0\n0,0,0"), [META, "2 rows whose id is 000"]),
    "metadata without origin": (
        set_metadata("0,0", "id,originLat"),
        [META, "lacks", "'originLon'"],
    ),
    "origin that is not a number": (
        set_metadata("0,0,east"),
        [f"{META}, line 2", "originLon is 'east'"],
    ),
    "origin off the globe": (set_metadata("0,95,0"), [META, "originLat is 95", "-90 to 90"]),
}


@pytest.mark.parametrize("name", FAULTS)
def test_each_fault_is_one_line(folder: Path, name: str) -> None:
    """It names what is needed to find the fault; other recordings open."""
    spoil, expected = FAULTS[name]
    spoil(folder)
    recordings = open_data(folder)
    assert recordings.names == (f"{PLACE}/000", f"{PLACE}/001")
    with pytest.raises(DataError) as caught:
        recordings[0]
    message = str(caught.value)
    assert "\n" not in message
    assert all(part in message for part in expected), message
    if "map" not in name and "metadata" not in name and "origin" not in name:
        assert len(recordings[1]) == 3


def outcome(files: InteractionFiles) -> tuple[TrackTable, float] | str:
    """The tracks and frame rate of a recording, or the error message."""
    try:
        read_meta(files)
        return read_interaction(files)
    except DataError as error:
        return str(error)


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    name=st.sampled_from([VEHICLES, PEDESTRIANS, META]),
    position=st.floats(0, 1, exclude_max=True),
    removed=st.integers(0, 40),
    inserted=st.one_of(
        st.binary(max_size=6),
        st.sampled_from([b"\n", b",", b'"', b"-", b"e9", b"1e400", b"nan", b"\xff\xfe", b"\r"]),
    ),
)
def test_damaged_bytes_give_valid_states_or_one_line(
    tmp_path: Path, name: str, position: float, removed: int, inserted: bytes
) -> None:
    folder = tmp_path / "fuzzed"
    write_recording(folder, pedestrians=walk("P1", (0, 0), (0, 1), 20))
    set_metadata("0,0.0,0.0")(folder)
    (path,) = folder.rglob(name)
    content = path.read_bytes()
    begin = int(position * len(content))
    path.write_bytes(content[:begin] + inserted + content[begin + removed :])
    (files,) = find_recordings(folder)
    found = outcome(files)
    if isinstance(found, str):
        assert "\n" not in found
        assert name in found or VEHICLES in found
        return
    table, rate_hz = found
    assert np.isfinite(table.states).all()
    assert (table.sizes > 0).all()
    assert 1 <= rate_hz <= 250
    assert len(np.unique(table.track_ids)) == len(table.track_ids)
    assert (table.first_frames >= 0).all()


def test_inspect_shows_the_others_and_names_the_fault(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    FAULTS["NaN position"][0](folder)
    assert main(["inspect", str(folder)]) == 2
    captured = capsys.readouterr()
    assert f"{PLACE}/001" in captured.out
    assert "Faults: 1" in captured.out
    assert captured.err.startswith("asp-env: ")
    assert captured.err.count("\n") == 1


def test_a_map_far_from_the_origin_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A map in Germany, and tracks without metadata, whose origin is (0, 0)."""
    monkeypatch.setenv("ASP_ENV_CACHE", str(tmp_path / "cache"))
    (write_taf_bw(tmp_path / "data") / META).unlink()
    with pytest.raises(
        DataError, match=r"lies at about 49\.0051, 8\.4\d+, expected .*0\.0000, 0\.0"
    ):
        open_data(tmp_path / "data")[0]
