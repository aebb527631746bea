"""Atomic writing: a folder or file appears complete or not at all.

Content is written under the temporary name `.NAME.TOKEN.partial` and renamed at the end. Every call
has a token of its own, so that processes can write the same target at the same time: one of them
is the last, and readers see a complete version at any time.
"""

import errno
import glob
import os
import secrets
import shutil
from collections.abc import Collection, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from asp_env.errors import AspEnvError

STALE_S = 3_600.0
"""Age above which a temporary file belongs to a process that was killed. Chosen by hand: far longer
than any process goes without writing to its file."""

_TOKEN_BYTES = 4
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
    if out.exists() and not (out.is_dir() and not any(out.iterdir())):
        raise AspEnvError(
            f"{out} exists and is not an empty folder; choose another name or remove it"
        )
    target = out.absolute()
    partial = _partial_path(target)
    try:
        with _refused(out):
            partial.mkdir()
        with _refused(out, only=_DISK_FULL):  # other errors in the block keep their type
            yield partial
        with _refused(out):
            target.parent.mkdir(parents=True, exist_ok=True)
            if target.exists():
                target.rmdir()
            os.rename(partial, target)
    finally:
        shutil.rmtree(partial, ignore_errors=True)


@contextmanager
def atomic_file(path: Path) -> Iterator[Path]:
    """Writes a file that appears at `path` only if the block ends without an exception.

    An existing file is replaced. Missing parent folders are created at the end. After an exception
    the existing file is unchanged and the temporary file is removed.

    Args:
        path: path of the file.

    Yields:
        The path of a temporary file, which the block must write and close.

    Raises:
        OSError: the file cannot be written.
    """
    target = path.absolute()
    partial = _partial_path(target)
    try:
        yield partial
        target.parent.mkdir(parents=True, exist_ok=True)
        os.replace(partial, target)
    finally:
        with suppress(OSError):
            partial.unlink()


def write_text(path: Path, text: str) -> None:
    """Writes a text file atomically.

    Raises:
        OSError: the file cannot be written.
    """
    with atomic_file(path) as partial:
        partial.write_text(text)


def leftovers(path: Path) -> list[Path]:
    """Temporary files and folders beside `path`, of processes that write it or were killed."""
    token = "[0-9a-f]" * (2 * _TOKEN_BYTES)
    return sorted(path.parent.glob(f".{glob.escape(path.name)}.{token}.partial"))


def remove_stale(path: Path) -> None:
    """Removes the temporary files that killed processes left beside the existing file `path`.

    Only those that are older than `STALE_S` are removed: younger ones may be in use.
    """
    now_s = path.stat().st_mtime  # the clock of the file system
    for partial in leftovers(path):
        with suppress(OSError):
            if now_s - partial.stat().st_mtime > STALE_S:
                partial.unlink()


def remove_partials(folder: Path) -> None:
    """Removes all temporary files below a folder to which no other process writes."""
    token = "[0-9a-f]" * (2 * _TOKEN_BYTES)
    for partial in folder.rglob(f".*.{token}.partial"):
        with suppress(OSError):
            partial.unlink()


def _partial_path(target: Path) -> Path:
    """A new name in the nearest existing parent folder, thus on the same file system."""
    parent = next(folder for folder in target.parents if folder.exists())
    return parent / f".{target.name}.{secrets.token_hex(_TOKEN_BYTES)}.partial"


@contextmanager
def _refused(out: Path, *, only: Collection[int] = ()) -> Iterator[None]:
    """Turns an `OSError`, or only those with certain numbers, into one line for the user."""
    try:
        yield
    except OSError as error:
        if only and error.errno not in only:
            raise
        reason = error.strerror or error
        raise AspEnvError(f"{out} cannot be written ({reason}); choose another folder") from error
