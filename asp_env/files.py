"""Atomic writing: a folder or file appears complete or not at all.

Content is written under the temporary name `.NAME.TOKEN.partial` and renamed at the end. Every call
has a token of its own, so that processes can write the same target at the same time: one of them
is the last, and readers see a complete version at any time.

A process holds a lock (`flock`) on everything temporary that it writes, and the kernel releases the
locks of a process that is killed. Whoever writes into a folder first removes what is not locked
there. On file systems without such locks, nothing is removed.
"""

import errno
import fcntl
import os
import re
import secrets
import shutil
import stat
from collections.abc import Collection, Iterator
from contextlib import contextmanager, suppress
from functools import lru_cache
from pathlib import Path

from asp_env.errors import AspEnvError

_TOKEN_BYTES = 6
_TEMPORARY = re.compile(rf"\..+\.[0-9a-f]{{{2 * _TOKEN_BYTES}}}\.partial", re.DOTALL)
_DISK_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


@contextmanager
def atomic_folder(out: Path) -> Iterator[Path]:
    """Creates a folder that appears at `out` only if the block ends without an exception.

    Missing parent folders are created at the end. After an exception nothing remains.

    Args:
        out: path of the folder. It must not exist, or be an empty folder.

    Yields:
        An empty folder to write into.

    Raises:
        AspEnvError: `out` exists and is not an empty folder, or cannot be written.
    """
    if not is_vacant(out):
        raise AspEnvError(
            f"{out} exists and is not an empty folder; choose another name or remove it"
        )
    target = out.absolute()
    with _refused(out):
        partial, lock = _claim(target, is_folder=True)
    try:
        with _refused(out, partial, only=_DISK_FULL):  # other errors in the block keep their type
            yield partial
        with _refused(out, partial):
            target.parent.mkdir(parents=True, exist_ok=True)
            if target.exists():
                remove_abandoned(target)
                target.rmdir()
            os.rename(partial, target)
    finally:
        shutil.rmtree(partial, ignore_errors=True)
        os.close(lock)


@contextmanager
def atomic_file(path: Path) -> Iterator[Path]:
    """Writes a file that appears at `path` only if the block ends without an exception.

    An existing file is replaced. Missing parent folders are created at the end. After an exception
    the existing file is unchanged and the temporary file is removed.

    Args:
        path: path of the file.

    Yields:
        The path of a temporary file, which is empty; the block must write and close it.

    Raises:
        OSError: the file cannot be written. An error in the block that names no file, such as that
            of a full disk, or the temporary one, names `path`.
    """
    target = path.absolute()
    partial, lock = _claim(target, is_folder=False)
    try:
        yield partial
        target.parent.mkdir(parents=True, exist_ok=True)
        os.replace(partial, target)
    except OSError as error:
        if error.filename is None or os.fsdecode(error.filename) == str(partial):
            with suppress(AttributeError):  # in errors of av, names cannot be changed
                error.filename, error.filename2 = str(path), None
        raise
    finally:
        with suppress(OSError):
            partial.unlink()
        os.close(lock)


def write_text(path: Path, text: str) -> None:
    """Writes a text file atomically.

    Raises:
        OSError: the file cannot be written.
    """
    with atomic_file(path) as partial:
        partial.write_text(text)


def check_new(path: Path) -> None:
    """Checks before long work that a file or folder can be made where nothing exists yet.

    Args:
        path: the file or folder; missing parent folders are no fault.

    Raises:
        AspEnvError: something exists there, or nothing can be made there.
    """
    try:
        if path.exists():
            raise AspEnvError(f"{path} exists; choose another name or remove it")
        parent = next(folder for folder in path.absolute().parents if folder.exists())
    except OSError as error:
        raise _not_writable(path, error.strerror or str(error)) from error
    if not parent.is_dir():
        raise _not_writable(path, f"{parent} is a file")
    if not os.access(parent, os.W_OK | os.X_OK):
        raise _not_writable(path, f"no permission to write in {parent}")


def _not_writable(path: Path, reason: str) -> AspEnvError:
    return AspEnvError(f"{path} cannot be written ({reason}); choose another path")


def is_vacant(folder: Path) -> bool:
    """Whether nothing exists at a path, or a folder that is empty.

    Temporary files and folders, of processes that write or were killed, do not count as content.
    """
    if not folder.exists():
        return True
    return folder.is_dir() and all(is_temporary(each) for each in folder.iterdir())


def is_temporary(path: Path) -> bool:
    """Whether a path has the name of a temporary file or folder of this module."""
    return _TEMPORARY.fullmatch(path.name) is not None


def remove_abandoned(folder: Path) -> None:
    """Removes the temporary files and folders that killed processes left in a folder."""
    with suppress(OSError):
        for path in filter(is_temporary, list(folder.iterdir())):
            with suppress(OSError):
                _remove_unless_locked(path)


_remove_abandoned_once = lru_cache(maxsize=4096)(remove_abandoned)
"""Once in each process, as folders of caches have thousands of files."""


def _remove_unless_locked(path: Path) -> None:
    """Removes a temporary file or folder.

    Raises:
        OSError: a process writes it, it is no longer there, or it must not be removed.
    """
    lock = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK)
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        # Its writer may have renamed it after it was opened here.
        if not os.path.samestat(os.fstat(lock), path.lstat()):
            return
        if stat.S_ISDIR(os.fstat(lock).st_mode):
            shutil.rmtree(path)
        else:
            path.unlink()
    finally:
        os.close(lock)


def _claim(target: Path, *, is_folder: bool) -> tuple[Path, int]:
    """Creates something temporary in the nearest existing parent folder of `target`, and locks it.

    That folder is on the same file system.

    Returns:
        Its path, and an open descriptor, which holds the lock until it is closed.

    Raises:
        OSError: nothing can be created there.
    """
    parent = next(folder for folder in target.parents if folder.exists())
    _remove_abandoned_once(parent)
    while True:
        partial = parent / f".{target.name}.{secrets.token_hex(_TOKEN_BYTES)}.partial"
        if is_folder:
            partial.mkdir()
        else:
            os.close(os.open(partial, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o666))
        with suppress(FileNotFoundError):  # removed by another process before it is locked
            lock = os.open(partial, os.O_RDONLY)
            with suppress(OSError):  # a file system without locks
                fcntl.flock(lock, fcntl.LOCK_EX)
            if partial.exists():
                return partial, lock
            os.close(lock)


@contextmanager
def _refused(
    out: Path, partial: Path | None = None, *, only: Collection[int] = ()
) -> Iterator[None]:
    """Turns an `OSError`, or only those with certain numbers, into one line for the user."""
    try:
        yield
    except OSError as error:
        if only and error.errno not in only:
            raise
        reason = error.strerror or error
        raise AspEnvError(
            f"{_place(error, out, partial)} cannot be written ({reason}); "
            f"{'free some space, or ' if error.errno in _DISK_FULL else ''}choose another folder"
        ) from error


def _place(error: OSError, out: Path, partial: Path | None) -> Path:
    """The file that an error names, under the name that it would have had; else the folder."""
    if partial is None or error.filename is None or isinstance(error.filename, int):
        return out
    path = Path(os.fsdecode(error.filename))
    if path in (partial, out.absolute()):
        return out
    return out / path.relative_to(partial) if path.is_relative_to(partial) else path
