"""The cache: exact, read-only arrays, safe against damage and simultaneous writers."""

import threading
from pathlib import Path

import hypothesis.extra.numpy as npst
import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import given

from asp_env.data import cache
from asp_env.errors import DataError

STAMP = [["format", 1, 0], ["a.csv", 10, 20]]


@given(
    arrays=st.dictionaries(
        st.sampled_from(["states", "starts", "ids"]),
        npst.arrays(
            st.sampled_from([np.float32, np.int64, np.int8]), npst.array_shapes(min_side=0)
        ),
    )
)
def test_arrays_and_facts_are_loaded_as_saved(
    tmp_path_factory: pytest.TempPathFactory, arrays: dict[str, np.ndarray]
) -> None:
    """Bit for bit, of any shape, and read-only."""
    path = tmp_path_factory.mktemp("cache") / "a.bin"
    facts = {"repairs": ["gemä\u00dfigt"], "scale": 0.12, "none": None}
    cache.save(path, STAMP, facts, arrays)
    found = cache.load(path, STAMP)
    assert found is not None
    assert found[0] == facts
    assert found[1].keys() == arrays.keys()
    for name, array in arrays.items():
        assert (found[1][name].dtype, found[1][name].shape) == (array.dtype, array.shape)
        assert found[1][name].tobytes() == array.tobytes()
        assert not found[1][name].flags.writeable


@pytest.mark.parametrize("cut", [0, 5, 12, 100, 300, -1])
def test_a_truncated_file_counts_as_absent(tmp_path: Path, cut: int) -> None:
    path = tmp_path / "a.bin"
    cache.save(path, STAMP, {}, {"states": np.arange(100.0)})
    path.write_bytes(path.read_bytes()[:cut])
    assert cache.load(path, STAMP) is None


@pytest.mark.parametrize("content", [b"", b"asp-env1", b"asp-env1" + b"\xff" * 64, b"PK\3\4" * 99])
def test_another_kind_of_file_counts_as_absent(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "a.bin"
    path.write_bytes(content)
    assert cache.load(path, STAMP) is None


@given(byte=st.integers(0, 10**6), bit=st.integers(0, 7))
def test_a_flipped_bit_anywhere_counts_as_absent(
    tmp_path_factory: pytest.TempPathFactory, byte: int, bit: int
) -> None:
    """In the magic word, the checksum, the header, or the arrays."""
    path = tmp_path_factory.mktemp("cache") / "a.bin"
    cache.save(path, STAMP, {"rate": 25.0}, {"states": np.arange(30.0), "ids": np.arange(7)})
    content = bytearray(path.read_bytes())
    content[byte % len(content)] ^= 1 << bit
    path.write_bytes(bytes(content))
    assert cache.load(path, STAMP) is None


def test_another_stamp_counts_as_absent(tmp_path: Path) -> None:
    """Made from files of another size or time, or by another version of the readers."""
    path = tmp_path / "a.bin"
    cache.save(path, STAMP, {}, {})
    assert cache.load(path, STAMP) is not None
    for other in ([["format", 2, 0], STAMP[1]], [STAMP[0], ["a.csv", 11, 20]], [STAMP[0]]):
        assert cache.load(path, other) is None


def test_the_stamp_changes_with_the_file(tmp_path: Path) -> None:
    """With its size and its modification time; a missing file is an error of one line."""
    path = tmp_path / "a.csv"
    path.write_text("1")
    before = cache.stamp([path])
    path.write_text("12")
    assert cache.stamp([path]) != before
    path.unlink()
    with pytest.raises(DataError, match=r"a\.csv: No such file"):
        cache.stamp([path])


def test_a_failed_save_leaves_the_old_file(tmp_path: Path) -> None:
    path = tmp_path / "a.bin"
    cache.save(path, STAMP, {"old": True}, {})
    with pytest.raises(TypeError):
        cache.save(path, STAMP, {"new": object()}, {})
    (tmp_path / "b.bin").mkdir()
    with pytest.raises(IsADirectoryError):
        cache.save(tmp_path / "b.bin", STAMP, {}, {"states": np.zeros(9)})
    assert sorted(each.name for each in tmp_path.iterdir()) == ["a.bin", "b.bin"]
    found = cache.load(path, STAMP)
    assert found is not None
    assert found[0] == {"old": True}


def test_readers_see_one_of_two_simultaneous_writers(tmp_path: Path) -> None:
    path = tmp_path / "a.bin"
    arrays = [np.full(10_000, value) for value in (1.0, 2.0)]
    cache.save(path, STAMP, {}, {"states": arrays[0]})

    def write(number: int) -> None:
        for _ in range(50):
            cache.save(path, STAMP, {}, {"states": arrays[number]})

    threads = [threading.Thread(target=write, args=(number,)) for number in (0, 1)]
    for thread in threads:
        thread.start()
    values = set()
    while any(thread.is_alive() for thread in threads):
        found = cache.load(path, STAMP)
        assert found is not None
        assert len(np.unique(found[1]["states"])) == 1
        values.add(float(found[1]["states"][0]))
    for thread in threads:
        thread.join()
    assert values <= {1.0, 2.0}
    assert len(list(tmp_path.iterdir())) == 1


def test_the_cache_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """ASP_ENV_CACHE, else asp-env in XDG_CACHE_HOME, else in the home's .cache."""
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    monkeypatch.delenv("ASP_ENV_CACHE", raising=False)
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    assert cache.cache_folder() == tmp_path / "home" / ".cache" / "asp-env"
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "xdg"))
    assert cache.cache_folder() == tmp_path / "xdg" / "asp-env"
    monkeypatch.setenv("ASP_ENV_CACHE", str(tmp_path / "named"))
    assert cache.cache_folder() == tmp_path / "named"
    assert (tmp_path / "named").is_dir()


def test_an_unwritable_cache_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """One line that names the folder and the variable to set."""
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("ASP_ENV_CACHE", str(tmp_path / "file" / "below"))
    with pytest.raises(DataError, match=r"file/below: .*set ASP_ENV_CACHE") as caught:
        cache.cache_folder()
    assert "\n" not in str(caught.value)


def test_sources_and_salts_have_different_files(tmp_path: Path) -> None:
    paths = [tmp_path / "a" / "00_tracks.csv", tmp_path / "b" / "00_tracks.csv"]
    names = {cache.entry_path(tmp_path, path, salt) for path in paths for salt in ("x", "y")}
    assert len(names) == 4
