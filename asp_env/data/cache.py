"""What was read once, kept as arrays in one file per source, and mapped into memory from then on.

A cache file is a magic word, the length of a JSON header, the header, and the arrays one after the
other at multiples of 64 bytes. The header holds the stamp of the files that it was made from.
A file is written aside and renamed, so that nobody reads half of one, however many processes fill
the cache at once; one that is damaged or of another stamp counts as absent.
"""

import contextlib
import hashlib
import json
import os
import tempfile
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from asp_env.errors import AspEnvError, DataError

FORMAT = 5
"""Raise whenever a reader makes something else of the same files."""

STALE_S = 3_600.0
"""What a process that was killed left half written is removed when it is as old as this."""

_MAGIC = b"asp-env\0"
_ALIGNMENT = 64


def cache_folder() -> Path:
    """Where derived data are kept: `ASP_ENV_CACHE`, else asp-env in the user's cache folder.

    Raises:
        DataError: the folder cannot be made or written to.
    """
    named = os.environ.get("ASP_ENV_CACHE")
    base = os.environ.get("XDG_CACHE_HOME")
    folder = Path(named) if named else (Path(base) if base else Path.home() / ".cache") / "asp-env"
    reason = "no permission to write"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        if os.access(folder, os.W_OK | os.X_OK):
            return folder
    except OSError as error:
        reason = error.strerror or type(error).__name__
    raise DataError(
        f"cache folder {folder}: {reason}; set ASP_ENV_CACHE to a folder that can be written to"
    )


def stamp(files: Iterable[Path]) -> list[list[Any]]:
    """Name, size and time of change of some files, and the version of the readers.

    Raises:
        DataError: one of them is gone.
    """
    found: list[list[Any]] = [["format", FORMAT, 0]]
    for path in files:
        try:
            status = path.stat()
        except OSError as error:
            raise DataError(f"{path}: {error.strerror}; expected a file to read") from error
        found.append([path.name, status.st_size, status.st_mtime_ns])
    return found


def entry(folder: Path, path: Path, *salt: object) -> Path:
    """The cache file for what is read from `path`, told apart by `salt`."""
    key = hashlib.sha256(repr((str(path.resolve()), salt)).encode()).hexdigest()[:20]
    return folder / f"{path.name.split('.')[0]}-{key}.bin"


def load(
    path: Path, current: Sequence[Sequence[Any]]
) -> tuple[dict[str, Any], dict[str, np.ndarray]] | None:
    """The header and the read-only, memory-mapped arrays of a cache file.

    None if it is absent, damaged, or was made from files of another stamp than `current`.
    """
    try:
        with path.open("rb") as file:
            if file.read(len(_MAGIC)) != _MAGIC:
                return None
            length = int.from_bytes(file.read(8), "little")
            if length > path.stat().st_size:
                return None
            header = json.loads(file.read(length))
        if header["stamp"] != current or path.stat().st_size != header["size"]:
            return None
        mapped = np.memmap(path, dtype=np.uint8, mode="r").view(np.ndarray)
        arrays = {
            name: mapped[at : at + count].view(dtype).reshape(shape)
            for name, (dtype, shape, at, count) in header["arrays"].items()
        }
    except (OSError, ValueError, KeyError, TypeError):
        return None
    return header["facts"], arrays


def save(
    path: Path,
    made_from: Sequence[Sequence[Any]],
    facts: Mapping[str, Any],
    arrays: Mapping[str, np.ndarray],
) -> None:
    """Writes a cache file, replacing one of the same name.

    Raises:
        OSError: it cannot be written; nothing is left behind.
    """
    plain = {name: np.ascontiguousarray(array) for name, array in arrays.items()}
    at = 0
    layout = {}
    for name, array in plain.items():
        layout[name] = [array.dtype.str, list(array.shape), at, array.nbytes]
        at += _aligned(array.nbytes)
    header, start = _header(made_from, facts, layout, at)
    handle, aside = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}-")
    try:
        with os.fdopen(handle, "wb") as file:
            file.write(_MAGIC + len(header).to_bytes(8, "little") + header)
            for name, array in plain.items():
                file.seek(start + layout[name][2])
                file.write(array.data if array.size else b"")
            file.truncate(start + at)
        os.replace(aside, path)
        _sweep(path)
    except BaseException:
        with contextlib.suppress(OSError):
            os.unlink(aside)
        raise


def _sweep(path: Path) -> None:
    """Removes what killed writers of a cache file left beside it, but of none that may live."""
    now = path.stat().st_mtime
    for left in path.parent.glob(f".{path.name}-*"):
        with contextlib.suppress(OSError):
            if now - left.stat().st_mtime > STALE_S:
                left.unlink()


def digest(path: Path) -> str:
    """A hash of a file's content.

    Raises:
        DataError: it cannot be read.
    """
    try:
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError as error:
        raise DataError(f"{path}: cannot be read: {error.strerror}") from error


def _aligned(count: int) -> int:
    return -(-count // _ALIGNMENT) * _ALIGNMENT


def _header(
    made_from: Sequence[Sequence[Any]], facts: Mapping[str, Any], layout: dict, room: int
) -> tuple[bytes, int]:
    """The header, padded to where the arrays start, and that place."""
    start = _ALIGNMENT
    while True:
        shifted = {
            name: [dtype, shape, start + at, count]
            for name, (dtype, shape, at, count) in layout.items()
        }
        content = {
            "stamp": made_from,
            "size": start + room,
            "facts": dict(facts),
            "arrays": shifted,
        }
        header = json.dumps(content).encode()
        needed = len(_MAGIC) + 8 + len(header)
        if needed <= start:
            return header.ljust(start - len(_MAGIC) - 8), start
        start = _aligned(needed)


def get_or_create(shelf_name: str, name: str, make: Callable[[Path], None]) -> Path:
    """A folder of the cache, made if it is not there yet.

    Several processes may ask at once: the first to finish wins, the others take what it made.

    Args:
        shelf_name: what kind of folder it is.
        name: of the folder; another one for other content.
        make: makes the content in a new folder.

    Raises:
        AspEnvError: the cache folder cannot be written.
    """
    shelf = cache_folder() / shelf_name
    folder = shelf / name
    if folder.is_dir():
        return folder
    try:
        shelf.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=shelf, prefix=f".{name}-") as aside:
            made = Path(aside) / "made"
            make(made)
            if not folder.is_dir():
                os.rename(made, folder)
    except OSError as error:
        if not folder.is_dir():  # else another process was faster
            raise AspEnvError(f"cannot write to {shelf}: {error.strerror or error}") from error
    return folder
