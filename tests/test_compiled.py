"""Compiled functions: damaged caches and folders that cannot be written do no harm."""

import importlib.util
import logging
from pathlib import Path
from types import ModuleType

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
