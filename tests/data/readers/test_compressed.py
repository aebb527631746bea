"""Compressed tables: gzip and xz are read alike, and damage is one line."""

import gzip
import io
import lzma
import struct
import zlib
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from asp_env.data.readers import compressed, read_table
from asp_env.data.readers.compressed import open_table
from asp_env.data.source import open_data
from asp_env.errors import AspEnvError, DataError
from scenarios.tables import DERIVED_COLUMNS, TRACKS_COLUMNS, Track, write_tracks
from tests.data.levelx_files import write_map, write_recording

PACK = {".gz": gzip.compress, ".xz": lzma.compress}
each_suffix = pytest.mark.parametrize("suffix", PACK)
ROWS = 500
TABLE = ("id,x\n" + "".join(f"{i},{i * i}\n" for i in range(ROWS))).encode()


def read(path: Path) -> list[float]:
    return read_table(path, {"id": "id", "x": "number"})["x"].tolist()


@each_suffix
def test_content_is_that_of_the_plain_file(tmp_path: Path, suffix: str) -> None:
    """In one stream, in several, with padding, and with the suffix in upper case."""
    pack = PACK[suffix]
    parts = [TABLE[:100], TABLE[100:], b""]
    contents = (pack(TABLE), b"".join(map(pack, parts)), pack(TABLE) + bytes(8))
    for number, content in enumerate(contents):
        path = tmp_path / f"{number}.csv{suffix.upper()}"
        path.write_bytes(content)
        with open_table(path) as file:
            assert file.read() == TABLE
        assert read(path) == [i * i for i in range(ROWS)]


@each_suffix
@settings(max_examples=50)
@given(cut=st.integers(0, 10_000), flip=st.integers(0, 10_000), data=st.data())
def test_damage_is_an_error_of_one_line(
    tmp_path_factory: pytest.TempPathFactory, suffix: str, cut: int, flip: int, data: st.DataObject
) -> None:
    """A file that ends early, or of which a bit differs, is refused or has the same content."""
    whole = bytearray(PACK[suffix](TABLE))
    if data.draw(st.booleans()):
        del whole[cut % len(whole) :]
    else:
        whole[flip % len(whole)] ^= 1 << flip % 8
    path = tmp_path_factory.mktemp("damaged") / f"a.csv{suffix}"
    path.write_bytes(whole)
    message = ""
    try:
        assert read(path) == [i * i for i in range(ROWS)]
    except DataError as error:
        message = str(error)
    assert message.startswith(str(path)) or not message
    assert "\n" not in message


@each_suffix
def test_bytes_after_the_end_are_refused(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"a.csv{suffix}"
    path.write_bytes(PACK[suffix](TABLE) + b"more")
    with pytest.raises(DataError, match=r"cannot be read: .*; copy it again"):
        read(path)


def test_a_file_that_requires_much_memory_is_refused(tmp_path: Path) -> None:
    """The dictionary of 4 GiB is stated in a byte of the block's header."""
    content = bytearray(lzma.compress(TABLE))
    header = slice(12, 12 + 4 * (content[12] + 1))
    assert content[header][2] == 0x21  # LZMA2
    content[header.start + 4] = 40
    checksum = zlib.crc32(content[header.start : header.stop - 4])
    content[header.stop - 4 : header.stop] = struct.pack("<I", checksum)
    path = tmp_path / "a.csv.xz"
    path.write_bytes(content)
    with pytest.raises(DataError, match="Memory usage limit exceeded"):
        read(path)


def test_a_python_without_lzma_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "a.csv.xz"
    path.write_bytes(lzma.compress(TABLE))
    monkeypatch.setattr(compressed, "find_spec", lambda _: None)
    with pytest.raises(DataError, match=r"a\.csv\.xz: this Python has no module lzma.*`xz -d`"):
        read(path)


@each_suffix
def test_a_cut_file_of_a_recording_is_one_line(tmp_path: Path, suffix: str) -> None:
    write_map(tmp_path)
    data = write_recording(tmp_path, suffix=suffix)
    path = data / f"00_tracks.csv{suffix}"
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    recordings = open_data(tmp_path)
    assert recordings.names == ("00",)
    with pytest.raises(DataError, match=rf"00_tracks\.csv{suffix}: cannot be read: .*copy it"):
        recordings[0]


def test_small_reads_of_a_large_expansion_take_little(tmp_path: Path) -> None:
    """A bomb is decompressed as far as it is read."""
    path = tmp_path / "a.csv.xz"
    packer = lzma.LZMACompressor(preset=0)
    path.write_bytes(packer.compress(b"id,x\n" + bytes(1 << 23)) + packer.flush())
    with open_table(path) as file:
        assert isinstance(file, io.BufferedIOBase)
        assert file.readline() == b"id,x\n"
    with pytest.raises(AspEnvError):
        read(path)


def test_written_tables_lack_only_what_no_reader_needs(tmp_path: Path) -> None:
    """Equal cells in the columns that are left, and equal bytes each time."""
    count = 5
    track = Track(
        kind="car", length_m=4.5, width_m=1.8, first_frame=3,
        xy=np.arange(2.0 * count).reshape(count, 2), heading_rad=np.zeros(count),
        velocity_mps=np.ones((count, 2)), acceleration_mps2=np.zeros((count, 2)),
    )  # fmt: skip
    paths = [tmp_path / name for name in ("a.csv", "a.csv.xz", "b.csv.xz")]
    for path in paths:
        write_tracks(path, 0, [track])
    assert paths[1].read_bytes() == paths[2].read_bytes()
    plain, packed = (pd.read_csv(path) for path in paths[:2])
    assert set(TRACKS_COLUMNS) - set(packed.columns) == set(DERIVED_COLUMNS)
    pd.testing.assert_frame_equal(packed, plain.drop(columns=list(DERIVED_COLUMNS)))
