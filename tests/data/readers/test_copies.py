"""Copies: a table beside its compressed copy."""

import gzip
import lzma
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from asp_env.data.readers.compressed import one_of_each
from asp_env.data.source import open_data
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
