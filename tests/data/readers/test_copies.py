"""Copies: a table beside its compressed copy, and recordings that are in DATA twice."""

import gzip
import lzma
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from asp_env.cli import main
from asp_env.data.readers.compressed import one_of_each
from asp_env.data.source import open_data
from asp_env.errors import RepairWarning
from tests.data import interaction_files, levelx_files
from tests.data.readers.test_own_readers import write_geo_trax, write_sind

LAYOUTS: dict[str, tuple[Callable[[Path], object], str]] = {
    "levelx": (levelx_files.write_folder, "00_tracks.csv"),
    "interaction": (interaction_files.write_folder, "vehicle_tracks_000.csv"),
    "sind": (lambda folder: write_sind(folder, stop_lines=False), "Veh_smoothed_tracks.csv"),
    "geo-trax": (write_geo_trax, "2022-10-07_A_PM1.csv"),
}
each_layout = pytest.mark.parametrize("layout", LAYOUTS)


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """An empty cache."""
    monkeypatch.setenv("ASP_ENV_CACHE", str(tmp_path / "cache"))


@each_layout
def test_a_table_beside_its_compressed_copies(tmp_path: Path, layout: str) -> None:
    """The uncompressed file is read, whatever the others contain, and they are reported."""
    write, name = LAYOUTS[layout]
    write(tmp_path / "folder")
    before = open_data(tmp_path / "folder")[0]
    (path,) = (tmp_path / "folder").rglob(name)
    path.with_name(f"{name}.gz").write_bytes(gzip.compress(path.read_bytes()[:5000]))
    path.with_name(f"{name}.xz").write_bytes(b"damaged")
    recordings = open_data(tmp_path / "folder")
    assert recordings.names == (before.name,)
    assert recordings.tracks_path(0) == path
    np.testing.assert_array_equal(recordings[0].states, before.states)
    line = f"{name}.gz, {name}.xz are not read, since {name} is"
    assert recordings[0].repairs == (*before.repairs, line)


def test_compressed_copies_of_a_table(tmp_path: Path) -> None:
    """Without the uncompressed file, that in gzip is read."""
    data = levelx_files.write_folder(tmp_path / "folder") / "data"
    content = (data / "00_tracks.csv").read_bytes()
    (data / "00_tracks.csv").unlink()
    (data / "00_tracks.csv.gz").write_bytes(gzip.compress(content))
    (data / "00_tracks.csv.xz").write_bytes(lzma.compress(content))
    (recording,) = open_data(tmp_path / "folder")
    assert recording.repairs == ("00_tracks.csv.xz is not read, since 00_tracks.csv.gz is",)


def test_one_file_of_each_table() -> None:
    """Names in any case are those of one table; other files stay, in their order."""
    names = ["B.csv.GZ", "a.csv", "a.csv.gz", "a.csv.zip", "b.CSV", "c.csv.xz", "c.osm", "c.osm.gz"]
    expected = ["a.csv", "a.csv.zip", "b.CSV", "c.csv.xz", "c.osm", "c.osm.gz"]
    assert one_of_each(names) == expected


@pytest.mark.filterwarnings("ignore:.*no recording lasts")
@each_layout
@pytest.mark.parametrize("copy", ["folder (1)", "b"])
def test_a_recording_that_is_there_twice(
    tmp_path: Path, layout: str, copy: str, capsys: pytest.CaptureFixture[str]
) -> None:
    """The first one is used; one warning and `inspect` name both."""
    folder = tmp_path / "data" / "a"
    LAYOUTS[layout][0](folder)
    shutil.copytree(folder, folder.with_name(copy))
    with pytest.warns(RepairWarning, match=r"1 of 2 recordings are in it twice: ") as warned:
        recordings = open_data(tmp_path / "data")
    assert len(warned) == 1
    (line,) = recordings.repairs
    assert recordings.tracks_path(0).is_relative_to(folder)
    places = line.removeprefix("recording ").split(": left out, since its tables are those of ")
    assert f"{copy}/" in places[0]
    assert "a/" in places[1]
    assert recordings.names[0] in places[1]
    main(["inspect", str(tmp_path / "data")])
    assert f"  {line}\n" in capsys.readouterr().out


def test_copies_of_several_recordings_and_names(tmp_path: Path) -> None:
    """Under another number and in another folder; recordings that differ in a byte stay."""
    data = levelx_files.write_folder(tmp_path / "folder", recordings=2) / "data"
    for path in list(data.glob("00_*")):
        shutil.copy(path, data / path.name.replace("00", "07"))
    shutil.copytree(data, tmp_path / "folder" / "again")
    (tmp_path / "folder" / "again" / "07_tracksMeta.csv").unlink()
    path = tmp_path / "folder" / "again" / "01_tracks.csv"
    path.write_bytes(path.read_bytes().replace(b"0,0,0,0,5.0", b"0,0,0,0,5.1", 1))
    with pytest.warns(RepairWarning, match=r"2 of 6 recordings are in it twice: "):
        recordings = open_data(tmp_path / "folder")
    assert recordings.names == ("00", "01", "again/01", "again/07")
    assert [line.split()[1] for line in recordings.repairs] == ["07:", "again/00:"]


def test_cases_of_a_table_that_is_there_twice(tmp_path: Path) -> None:
    """Each case of the later table is left out; cases of equal content within a table stay."""
    folder = interaction_files.write_folder(tmp_path / "folder")
    (path,) = folder.rglob("vehicle_tracks_000.csv")
    rows = path.read_text().splitlines()
    cases = [f"{case},{row}" for case in (1, 2) for row in rows[1:]]
    for name in ("train", "val"):
        (folder / name).mkdir()
        table = folder / name / f"{interaction_files.PLACE}_{name}.csv"
        table.write_text("\n".join([f"case_id,{rows[0]}", *cases]) + "\n")
    path.unlink()
    with pytest.warns(RepairWarning, match=r"2 of 4 recordings are in it twice: "):
        recordings = open_data(folder)
    assert recordings.names == tuple(f"{interaction_files.PLACE}_train/{case}" for case in (1, 2))
