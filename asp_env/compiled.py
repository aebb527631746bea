"""Functions that numba compiles, cached in files that are checked before they are used.

Numba's own cache raises errors at every start if a file of it is damaged, and at import where no
folder can be written. Here such a file counts as absent, and without a folder functions are
compiled anew in each process; one line says so.

The files are pickles, and whoever writes a pickle decides what a program does that reads it. A file
counts as absent, too, unless it belongs to this user, to root or to the owner of the function's
source, and no other user may write it.
"""

import hashlib
import logging
import os
import pickle
import secrets
import stat
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any

import numba
from numba.core.caching import FunctionCache, IndexDataCacheFile

from asp_env.files import atomic_file

_logger = logging.getLogger("asp_env")
_noted: set[str] = set()

_WRITABLE_BY_OTHERS = stat.S_IWGRP | stat.S_IWOTH


class _CheckedFiles(IndexDataCacheFile):
    """An index and data files, each of which begins with the SHA-256 hash of its content."""

    def __init__(self, *, owners: frozenset[int], **options: Any) -> None:
        super().__init__(**options)
        self._owners = owners

    def save(self, key: Any, data: Any) -> None:
        """Stores compiled code in a file with a name of its own.

        Numba's names are numbers that count up. Two processes that compile different signatures
        at the same time take the same one, and each signature may then get the other's code.
        """
        overloads = self._load_index()
        name = overloads.setdefault(key, self._data_name(secrets.randbits(32)))
        self._save_index(overloads)
        self._save_data(name, data)

    def _dump(self, obj: Any) -> bytes:
        content = super()._dump(obj)
        return hashlib.sha256(content).digest() + content

    def _load_index(self) -> dict[Any, str]:
        try:
            with open(self._index_path, "rb") as file:
                self._check(file)
                if pickle.load(file) != self._version:
                    return {}
                stamp, overloads = _checked(file.read())
        except Exception:  # unpickling damaged content may raise anything
            return {}
        return overloads if stamp == self._source_stamp else {}

    def _load_data(self, name: str) -> Any:
        with open(self._data_path(name), "rb") as file:
            self._check(file)
            return _checked(file.read())

    def _check(self, file: IO[bytes]) -> None:
        """Refuses a file that another user could have written.

        Raises:
            PermissionError: another user could.
        """
        status = os.fstat(file.fileno())
        if status.st_uid not in self._owners or status.st_mode & _WRITABLE_BY_OTHERS:
            raise PermissionError(f"{file.name} may be written by others")

    @contextmanager
    def _open_for_write(self, filepath: str) -> Iterator[Any]:
        with atomic_file(Path(filepath)) as partial, partial.open("wb") as file:
            mode = os.fstat(file.fileno()).st_mode
            os.fchmod(file.fileno(), stat.S_IMODE(mode) & ~_WRITABLE_BY_OTHERS)
            yield file


class _CheckedCache(FunctionCache):
    """A cache in which damaged files count as absent; files that cannot be written are left out."""

    def __init__(self, function: Callable[..., Any]) -> None:
        super().__init__(function)
        self._cache_file = _CheckedFiles(
            cache_path=self._cache_path,
            filename_base=self._impl.filename_base,
            source_stamp=self._impl.locator.get_source_stamp(),
            owners=frozenset({0, os.geteuid(), os.stat(function.__code__.co_filename).st_uid}),
        )

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        try:
            return super().load_overload(sig, target_context)
        except Exception:  # as above
            return None

    def save_overload(self, sig: Any, data: Any) -> None:
        try:
            super().save_overload(sig, data)
        except OSError as error:
            _note(f"{self._cache_path}: {error.strerror or error}")


def njit(*, cache: bool, **options: Any) -> Callable[[Callable[..., Any]], Any]:
    """`numba.njit` with a cache that survives damaged files and folders that cannot be written.

    Args:
        cache: whether compiled code is stored for later processes.
        options: those of `numba.njit`.
    """

    def decorate(function: Callable[..., Any]) -> Any:
        dispatcher: Any = numba.njit(**options)(function)
        if cache and hasattr(dispatcher, "_cache"):  # not with NUMBA_DISABLE_JIT
            try:
                dispatcher._cache = _CheckedCache(function)
            except (RuntimeError, OSError):  # no folder can be written
                _note("no folder can be written")
        return dispatcher

    return decorate


def _checked(content: bytes) -> Any:
    digest, rest = content[:32], content[32:]
    if hashlib.sha256(rest).digest() != digest:
        raise ValueError("damaged")
    return pickle.loads(rest)


def _note(reason: str) -> None:
    if not _noted:
        _noted.add(reason)
        _logger.warning(
            "asp-env: compiled functions are not cached (%s) and are compiled again at every "
            "start, up to half a minute; set NUMBA_CACHE_DIR to a folder that can be written to",
            reason,
        )
