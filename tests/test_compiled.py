"""Compiled functions: damaged caches and folders that cannot be written do no harm."""

import hashlib
import importlib.util
import logging
import os
import pickle
from pathlib import Path
from types import ModuleType

import numba
import pytest
from numba.core.caching import FunctionCache

from asp_env import compiled

SOURCE = """
from asp_env.compiled import njit

@njit(cache=True)
def double(x):
    return 2 * x
"""


def load(path: Path) -> ModuleType:
    """Imports a module from a file anew."""
    spec = importlib.util.spec_from_file_location("doubling", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def source(tmp_path: Path) -> Path:
    """A module with a compiled function, in a folder of its own."""
    path = tmp_path / "doubling.py"
    path.write_text(SOURCE)
    return path


def hits(module: ModuleType) -> int:
    """How often the function came from the cache."""
    return sum(module.double.stats.cache_hits.values())


def test_damaged_files_are_compiled_anew(source: Path) -> None:
    """Empty, cut, and with one bit flipped; the file is then whole again."""
    assert load(source).double(3) == 6
    again = load(source)
    assert again.double(3) == 6
    assert hits(again) == 1
    files = sorted(source.parent.rglob("*.nb[ic]"))
    assert len(files) == 2
    for path in files:
        content = path.read_bytes()
        flipped = bytearray(content)
        flipped[len(content) // 2] ^= 4
        for damaged in (b"", content[: len(content) // 2], bytes(flipped)):
            path.write_bytes(damaged)
            module = load(source)
            assert module.double(3) == 6
            assert hits(module) == 0
            mended = load(source)
            assert mended.double(3) == 6
            assert hits(mended) == 1


def test_without_a_folder_functions_are_compiled_with_one_line(
    source: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def refuse(_self: object, _function: object) -> None:
        raise RuntimeError("cannot cache function 'double': no locator available")

    monkeypatch.setattr(FunctionCache, "__init__", refuse)
    monkeypatch.setattr(compiled, "_noted", set())
    with caplog.at_level(logging.WARNING, "asp_env"):
        assert load(source).double(3) == 6
        assert load(source).double(4) == 8
    (record,) = caplog.records
    assert "NUMBA_CACHE_DIR" in record.getMessage()


def test_a_full_disk_is_one_line(
    source: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def refuse(_self: object, _sig: object, _data: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(FunctionCache, "save_overload", refuse)
    monkeypatch.setattr(compiled, "_noted", set())
    with caplog.at_level(logging.WARNING, "asp_env"):
        assert load(source).double(3) == 6
    assert "No space left on device" in caplog.text


class Payload:
    """An object whose pickle creates a file when it is read."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple[object, ...]:
        return Path.touch, (self.path,)


def plant(source: Path, marker: Path) -> Path:
    """Replaces the index of the cache by one that is valid and runs code; returns its path."""
    (index,) = source.parent.rglob("*.nbi")
    content = pickle.dumps(Payload(marker))
    head = pickle.dumps(numba.__version__, protocol=-1)
    index.write_bytes(head + hashlib.sha256(content).digest() + content)
    return index


@pytest.mark.parametrize("mode", [0o666, 0o664, 0o602])
def test_files_that_others_may_write_are_not_unpickled(source: Path, mode: int) -> None:
    """They are replaced by files that only their owner may write, whatever the umask."""
    load(source).double(3)
    marker = source.with_name("marker")
    index = plant(source, marker)
    index.chmod(mode)
    before = os.umask(0)
    try:
        assert load(source).double(3) == 6
    finally:
        os.umask(before)
    assert not marker.exists()
    assert [path.stat().st_mode & 0o777 for path in source.parent.rglob("*.nb[ic]")] == [0o644] * 3
    again = load(source)
    assert again.double(3) == 6
    assert hits(again) == 1

    plant(source, marker).chmod(0o644)
    load(source).double(3)
    assert marker.exists()  # the test's pickle does run where it is trusted


def test_files_of_others_are_not_unpickled(source: Path) -> None:
    """Those of root and of the owner of the source are."""
    if os.geteuid() != 0:
        pytest.skip("only root may give files away")
    load(source).double(3)
    marker = source.with_name("marker")
    index = plant(source, marker)
    os.chown(index, 65534, -1)
    assert load(source).double(3) == 6
    assert not marker.exists()
    os.chown(plant(source, marker), 65534, -1)
    os.chown(source, 65534, -1)
    load(source).double(3)
    assert marker.exists()


def test_signatures_compiled_at_the_same_time_keep_their_own_code(source: Path) -> None:
    """Two processes that read the same index store their signatures in different files."""
    first, second = load(source), load(source)
    states = [module.double._cache._cache_file for module in (first, second)]
    empty: dict[object, str] = {}
    for state in states:
        state._load_index = lambda: dict(empty)
    assert first.double(3) == 6
    assert second.double(1.5) == 3.0
    assert len(list(source.parent.rglob("*.nbc"))) == 2
    third = load(source)
    assert (third.double(3), third.double(1.5)) == (6, 3.0)
    assert hits(third) == 1
