"""Arrays kept on disk: exact, read-only, safe against damage and against one another."""

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
def test_round_trip(
    tmp_path_factory: pytest.TempPathFactory, arrays: dict[str, np.ndarray]
) -> None:
    """What is loaded is bit for bit what was saved, of any shape, and nobody can write to it."""
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
def test_truncated_counts_as_absent(tmp_path: Path, cut: int) -> None:
    """A file that ends early, wherever, is as good as none."""
    path = tmp_path / "a.bin"
    cache.save(path, STAMP, {}, {"states": np.arange(100.0)})
    path.write_bytes(path.read_bytes()[:cut])
    assert cache.load(path, STAMP) is None


@pytest.mark.parametrize(
    "content", [b"", b"asp-env\0", b"asp-env\0" + b"\xff" * 64, b"PK\3\4" * 99]
)
def test_garbage_counts_as_absent(tmp_path: Path, content: bytes) -> None:
    """So is a file of something else."""
    path = tmp_path / "a.bin"
    path.write_bytes(content)
    assert cache.load(path, STAMP) is None


def test_another_stamp_counts_as_absent(tmp_path: Path) -> None:
    """Made from files of another size, time or reader version: as good as none."""
    path = tmp_path / "a.bin"
    cache.save(path, STAMP, {}, {})
    assert cache.load(path, STAMP) is not None
    for other in ([["format", 2, 0], STAMP[1]], [STAMP[0], ["a.csv", 11, 20]], [STAMP[0]]):
        assert cache.load(path, other) is None


def test_stamp_changes_with_the_file(tmp_path: Path) -> None:
    """Size and time of change both count; a file that is gone is an error of one line."""
    path = tmp_path / "a.csv"
    path.write_text("1")
    before = cache.stamp([path])
    path.write_text("12")
    assert cache.stamp([path]) != before
    path.unlink()
    with pytest.raises(DataError, match=r"a\.csv: No such file"):
        cache.stamp([path])


def test_failed_save_leaves_nothing(tmp_path: Path) -> None:
    """A save that fails midway keeps the old file and no half of the new one."""
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


def test_writers_at_once(tmp_path: Path) -> None:
    """While two save again and again, whoever loads gets one or the other, never a mixture."""
    path = tmp_path / "a.bin"
    arrays = [np.full(10_000, value) for value in (1.0, 2.0)]
    cache.save(path, STAMP, {}, {"states": arrays[0]})

    def write(number: int) -> None:
        for _ in range(50):
            cache.save(path, STAMP, {}, {"states": arrays[number]})

    threads = [threading.Thread(target=write, args=(number,)) for number in (0, 1)]
    for thread in threads:
        thread.start()
    seen = set()
    while any(thread.is_alive() for thread in threads):
        found = cache.load(path, STAMP)
        assert found is not None
        assert len(np.unique(found[1]["states"])) == 1
        seen.add(float(found[1]["states"][0]))
    for thread in threads:
        thread.join()
    assert seen <= {1.0, 2.0}
    assert len(list(tmp_path.iterdir())) == 1


def test_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
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


def test_unwritable_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A folder that cannot be made is one line that names it and the way out."""
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("ASP_ENV_CACHE", str(tmp_path / "file" / "below"))
    with pytest.raises(DataError, match=r"file/below: .*set ASP_ENV_CACHE") as caught:
        cache.cache_folder()
    assert "\n" not in str(caught.value)


def test_entries_differ(tmp_path: Path) -> None:
    """The same name in two folders, or made with another salt, is another file."""
    paths = [tmp_path / "a" / "00_tracks.csv", tmp_path / "b" / "00_tracks.csv"]
    names = {cache.entry_path(tmp_path, path, salt) for path in paths for salt in ("x", "y")}
    assert len(names) == 4
