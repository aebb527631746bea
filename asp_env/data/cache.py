"""Cache of derived data: arrays in one file per source, mapped into memory, and whole folders.

A cache file is a magic word, the CRC-32 of all that follows, the length of a JSON header, the
header, and the arrays one after the other at multiples of 64 bytes. The header holds the stamp of
the files that the arrays were made from. Files are written atomically, so that several processes
may fill the cache at the same time; a file that is damaged or has another stamp counts as absent.
"""

import hashlib
import json
import logging
import os
import zlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from asp_env.errors import AspEnvError, DataError
from asp_env.files import atomic_file, atomic_folder

FORMAT = 12
"""Version of the readers. Raise it whenever a reader gives other results for the same files."""

_logger = logging.getLogger("asp_env")
_noted: set[str] = set()
"""Reasons that have been logged."""

_MAGIC = b"asp-env1"
_CHECKED = len(_MAGIC) + 4
"""Where the checked content begins: behind the magic word and the checksum."""
_HEAD = _CHECKED + 4
_ALIGNMENT = 64
_BLOCK = 1 << 20
_SHOWN = 40
"""Characters of the source's name in that of its file: names of files have at most 255 bytes."""


def cache_folder() -> Path:
    """The folder of derived data, created if missing.

    It is `$ASP_ENV_CACHE`, else `$XDG_CACHE_HOME/asp-env`, else `~/.cache/asp-env`.

    Raises:
        DataError: the folder cannot be created or written to.
    """
    folder, _ = cache_location()
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


def note_uncached(error: DataError | OSError, path: Path | None = None) -> None:
    """Logs in one line, once per process and reason, that results are not cached.

    Args:
        error: why not.
        path: the file that cannot be written, if the error does not name it.
    """
    reason = str(error) if isinstance(error, DataError) else error.strerror or str(error)
    if reason not in _noted:
        _noted.add(reason)
        where = "" if path is None else f"{path}: "
        _logger.warning("asp-env: results are not cached: %s%s", where, reason)


def cache_location() -> tuple[Path, str]:
    """The folder of derived data, which may not exist, and what its place follows from."""
    for variable, below in (("ASP_ENV_CACHE", ""), ("XDG_CACHE_HOME", "asp-env")):
        if base := os.environ.get(variable):
            return Path(base) / below, f"${variable}"
    return Path(os.path.expanduser("~/.cache")) / "asp-env", "the default"


def get_or_create(group: str, name: str, make: Callable[[Path], None]) -> Path:
    """Returns a folder of the cache and creates it if it is missing.

    Several processes may call this at the same time: the first to finish creates the folder, the
    others discard their content and use it.

    Args:
        group: name of the folder that holds folders of this kind.
        name: name of the folder. Different content needs a different name.
        make: writes the content into an empty folder.

    Raises:
        AspEnvError: the cache folder cannot be written.
    """
    folder = cache_folder() / group / name
    if folder.is_dir():
        return folder
    try:
        with atomic_folder(folder) as partial:
            make(partial)
    except AspEnvError:
        if not folder.is_dir():  # no other process was faster
            raise
    return folder


def array_of(kind: str, version: int, content: str, make: Callable[[], np.ndarray]) -> np.ndarray:
    """An array that follows from some content, from the cache if it is there and not damaged.

    If the cache cannot be written, one line is logged, and `make` is called every time.

    Args:
        kind: what the array is; the file's name begins with it.
        version: version of `make`. Raise it whenever the result is another one.
        content: a hash of the content that the array follows from.
        make: computes the array.
    """
    made_from = [[kind, version, content]]
    try:
        path = cache_folder() / f"{kind}-{content[:20]}.bin"
    except DataError as error:
        note_uncached(error)
        return make()
    found = load(path, made_from)
    if found is None:
        array = make()
        try:
            save(path, made_from, {}, {"array": array})
        except OSError as error:
            note_uncached(error, path)
        found = load(path, made_from) or ({}, {"array": array})
    (array,) = found[1].values()
    return array


def entry_path(folder: Path, source: Path, *salt: object) -> Path:
    """The cache file for data read from `source`; `salt` distinguishes several of one source."""
    key = hashlib.sha256(repr((str(source.resolve()), salt)).encode()).hexdigest()[:20]
    return folder / f"{source.name.split('.')[0][:_SHOWN]}-{key}.bin"


def stamp(files: Iterable[Path]) -> list[list[Any]]:
    """Name, size and modification time of files, preceded by the version of the readers.

    Raises:
        DataError: a file is missing.
    """
    rows: list[list[Any]] = [["format", FORMAT, 0]]
    for path in files:
        try:
            status = path.stat()
        except OSError as error:
            if path.is_symlink():
                raise DataError(
                    f"{path}: is a link to a file that does not exist; fetch that file, such as by "
                    "`git annex get`"
                ) from error
            raise DataError(f"{path}: {error.strerror}; expected a file to read") from error
        rows.append([path.name, status.st_size, status.st_mtime_ns])
    return rows


def load(
    path: Path, current: Sequence[Sequence[Any]]
) -> tuple[dict[str, Any], dict[str, np.ndarray]] | None:
    """Loads a cache file.

    Args:
        path: the cache file.
        current: the stamp that its sources have now.

    Returns:
        The facts, and read-only, memory-mapped arrays by name. None if the file is absent, damaged,
        or has another stamp.
    """
    try:
        mapped = np.memmap(path, dtype=np.uint8, mode="r").view(np.ndarray)
        head = mapped[:_HEAD].tobytes()
        if not head.startswith(_MAGIC) or zlib.crc32(mapped[_CHECKED:].data) != _number(head[8:12]):
            return None
        header = json.loads(mapped[_HEAD : _HEAD + _number(head[12:])].tobytes())
        if header["stamp"] != current:
            return None
        arrays = {
            name: mapped[offset : offset + count].view(dtype).reshape(shape)
            for name, (dtype, shape, offset, count) in header["arrays"].items()
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
    """Writes a cache file atomically; an existing one is replaced.

    Args:
        path: the cache file.
        made_from: the stamp of the sources.
        facts: values that JSON can hold.
        arrays: arrays of any shape, by name.

    Raises:
        OSError: the file cannot be written.
    """
    plain = {name: np.ascontiguousarray(array) for name, array in arrays.items()}
    total = 0
    layout = {}
    for name, array in plain.items():
        layout[name] = [array.dtype.str, list(array.shape), total, array.nbytes]
        total += _aligned(array.nbytes)
    header, start = _header(made_from, facts, layout)
    with atomic_file(path) as partial, partial.open("w+b") as file:
        file.write(_MAGIC + bytes(4) + len(header).to_bytes(4, "little") + header)
        for name, array in plain.items():
            file.seek(start + layout[name][2])
            file.write(array.data if array.size else b"")
        file.truncate(start + total)
        file.seek(_CHECKED)
        checksum = 0
        while block := file.read(_BLOCK):
            checksum = zlib.crc32(block, checksum)
        file.seek(len(_MAGIC))
        file.write(checksum.to_bytes(4, "little"))


def digest(path: Path) -> str:
    """The SHA-256 hash of a file's content.

    Raises:
        DataError: the file cannot be read.
    """
    try:
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError as error:
        raise DataError(f"{path}: cannot be read: {error.strerror}") from error


def _number(content: bytes) -> int:
    return int.from_bytes(content, "little")


def _aligned(count: int) -> int:
    return -(-count // _ALIGNMENT) * _ALIGNMENT


def _header(
    made_from: Sequence[Sequence[Any]], facts: Mapping[str, Any], layout: dict
) -> tuple[bytes, int]:
    """The header, padded to the offset at which the arrays start, and that offset."""
    start = _ALIGNMENT
    while True:
        shifted = {
            name: [dtype, shape, start + offset, count]
            for name, (dtype, shape, offset, count) in layout.items()
        }
        content = {
            "stamp": made_from,
            "facts": dict(facts),
            "arrays": shifted,
        }
        header = json.dumps(content).encode()
        needed = _HEAD + len(header)
        if needed <= start:
            return header.ljust(start - _HEAD), start
        start = _aligned(needed)
