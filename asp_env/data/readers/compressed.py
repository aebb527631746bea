"""Tables that are plain or compressed, by the end of their name: `.csv`, `.csv.gz`, `.csv.xz`."""

import gzip
import io
import os
import re
from collections.abc import Iterable
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from asp_env.errors import DataError

CSV = r"\.csv(?:\.(?:gz|xz))?"
"""The end of the name of a table that may be compressed, as a regular expression."""

MEMORY_BYTES = 1 << 28
"""Memory that an `.xz` file may require. `xz -9` requires 65 MiB; a damaged or forged file may
require 4 GiB."""

_TABLE = re.compile(r"^(.+\.csv)(|\.gz|\.xz)$")
_BLOCK_BYTES = 1 << 16


def plain_name(name: str) -> str:
    """A table's name in lower case, without the suffix of its compression."""
    match = _TABLE.match(name.lower())
    return match[1] if match else name.lower()


def one_of_each(names: Iterable[str]) -> list[str]:
    """Names of a folder's files with one for each table: that which is not compressed, if any.

    The names of a table's files differ in their compression or in case. If all are compressed, the
    first of `.csv.gz` and `.csv.xz` is used.
    """
    others = {name for files in _tables(names).values() for name in files[1:]}
    return [name for name in names if name not in others]


def unread_copies(folder: Path) -> dict[str, list[str]]:
    """The files of a folder that are not read, by the name of that which `one_of_each` prefers."""
    try:
        with os.scandir(folder) as entries:
            names = [entry.name for entry in entries if entry.is_file()]
    except OSError:
        return {}
    return {first: others for first, *others in _tables(names).values() if others}


def _tables(names: Iterable[str]) -> dict[str, list[str]]:
    """The names of each table's files, that which is read first."""
    ranked: dict[str, list[tuple[str, str]]] = {}
    for name in names:
        if match := _TABLE.match(name.lower()):
            ranked.setdefault(match[1], []).append((match[2], name))
    return {table: [name for _, name in sorted(files)] for table, files in ranked.items()}


def open_table(path: Path) -> io.BufferedIOBase:
    """Opens a table that is plain, `.gz` or `.xz`, by its name in upper or lower case.

    Reading raises `OSError`, `EOFError` or `zlib.error` where a compressed file is damaged.

    Raises:
        DataError: the file is `.xz`, and this Python has no module `lzma`.
    """
    suffix = path.suffix.lower()
    if suffix == ".gz":
        return gzip.GzipFile(path)
    if suffix != ".xz":
        return path.open("rb")
    if find_spec("_lzma") is None:  # Python may be built without it
        raise DataError(
            f"{path}: this Python has no module lzma, which reads .xz: unpack the file by "
            "`xz -d`, or use a Python that has it"
        )
    return io.BufferedReader(_Xz(path.open("rb")), 1 << 20)


class _Xz(io.RawIOBase):
    """The content of an `.xz` file. `lzma.LZMAFile` bounds no memory and ignores trailing bytes."""

    def __init__(self, file: io.BufferedIOBase) -> None:
        import lzma

        self._lzma = lzma
        self._file = file
        self._start(b"")

    def _start(self, data: bytes) -> None:
        """Begins a stream, of which a file has one or several."""
        self._stream = self._lzma.LZMADecompressor(self._lzma.FORMAT_XZ, memlimit=MEMORY_BYTES)
        self._data = data

    def readable(self) -> bool:
        return True

    def readinto(self, buffer: Any, /) -> int:
        while True:
            if self._stream.eof:
                data = self._stream.unused_data or self._file.read(_BLOCK_BYTES)
                while data and not data.strip(b"\0"):  # padding
                    data = self._file.read(_BLOCK_BYTES)
                if not data:
                    return 0
                self._start(data.lstrip(b"\0"))
            elif self._stream.needs_input and not self._data:
                self._data = self._file.read(_BLOCK_BYTES)
                if not self._data:
                    raise EOFError("the compressed file ends too early")
            try:
                content = self._stream.decompress(self._data, len(buffer))
            except self._lzma.LZMAError as error:
                raise OSError(f"the compressed file is damaged: {error}") from error
            self._data = b""
            if content:
                buffer[: len(content)] = content
                return len(content)

    def close(self) -> None:
        if not self.closed:
            self._file.close()
        super().close()
