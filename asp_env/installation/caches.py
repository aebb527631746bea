"""The caches: their folders, sizes, and whether they can be written; clocks, and compiled code."""

import os
import secrets
import shutil
import time
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

CLOCK_TOLERANCE_S = 5.0
"""Largest difference of the clocks of this machine and of the cache's file system that is not
reported. Chosen by hand: file systems round times to up to 2 s."""

SMALLEST_FREE_BYTES = 200_000_000
"""Free space below which a cache is reported. Chosen by hand: several long recordings."""


@dataclass(frozen=True, slots=True, kw_only=True)
class CacheState:
    """A folder of derived data."""

    folder: Path
    named_by: str
    """The environment variable or rule that the folder follows from."""
    num_files: int
    num_bytes: int
    free_bytes: int | None
    clock_ahead_s: float | None
    """Time of a file that is written now, less that of this machine."""
    problem: str | None
    """Why nothing can be stored in it, or None."""


@dataclass(frozen=True, slots=True, kw_only=True)
class CompiledState:
    """The functions that numba has compiled for this installation."""

    folder: Path | None
    """Where they are stored; None if no folder can be written."""
    num_functions: int
    """Number of functions that are stored; those of an earlier version count as well."""
    num_bytes: int

    @property
    def problem(self) -> str | None:
        """Why compiled functions cannot be stored, or None."""
        if self.folder is not None:
            return None
        return (
            "compiled functions are not stored, no folder can be written: they are compiled at "
            "every start, up to half a minute; set NUMBA_CACHE_DIR to a folder that can be "
            "written to"
        )


def cache_state() -> CacheState:
    """The cache of recordings, `asp_env.data.cache.cache_folder`, which is created if missing."""
    from asp_env.data.cache import cache_folder, cache_location
    from asp_env.errors import DataError

    folder, named_by = cache_location()
    problem, ahead_s, free = None, None, None
    try:
        cache_folder()
        ahead_s = _clock_ahead_s(folder)
        free = shutil.disk_usage(folder).free
    except DataError as error:
        problem = str(error)
    except OSError as error:
        problem = f"cache folder {folder}: {error.strerror or error}; free space on that disk, or "
        problem += "set ASP_ENV_CACHE to a folder that can be written to"
    if problem is None and ahead_s is not None and abs(ahead_s) > CLOCK_TOLERANCE_S:
        problem = (
            f"cache folder {folder}: its clock differs by {ahead_s:+.0f} s from that of this "
            "machine, so that changes of files may be missed; set the clocks, or ASP_ENV_CACHE"
        )
    if problem is None and free is not None and free < SMALLEST_FREE_BYTES:
        problem = f"cache folder {folder}: only {free / 1e6:.0f} MB are free on its disk"
    num_files, num_bytes = _content(folder)
    return CacheState(
        folder=folder,
        named_by=named_by,
        num_files=num_files,
        num_bytes=num_bytes,
        free_bytes=free,
        clock_ahead_s=None if ahead_s is None else round(ahead_s, 3),
        problem=problem,
    )


def compiled_state() -> CompiledState:
    """Where numba stores compiled functions of this package, and what is there."""
    from asp_env.geometry import wrap_scalar

    place = getattr(getattr(wrap_scalar, "_cache", None), "cache_path", None)
    if place is None or not os.access(place, os.W_OK):
        return CompiledState(folder=None, num_functions=0, num_bytes=0)
    package = Path(__file__).resolve().parents[1]
    folder = Path(place)
    if folder.resolve().is_relative_to(package):  # beside the modules
        folder = package
        files = list(package.rglob("__pycache__/*.nb[ic]"))
    else:  # one folder for each folder of modules, side by side
        folder = folder.parent
        files = list(folder.rglob("*.nb[ic]"))
    return CompiledState(
        folder=folder,
        num_functions=sum(path.suffix == ".nbi" for path in files),
        num_bytes=sum(_sizes(files)),
    )


def _content(folder: Path) -> tuple[int, int]:
    """Number of files, and bytes."""
    try:
        files = [path for path in folder.rglob("*") if path.is_file()]
    except OSError:  # a folder that must not be read
        return 0, 0
    return len(files), sum(_sizes(files))


def _sizes(paths: Iterable[Path]) -> Iterable[int]:
    for path in paths:
        try:
            yield path.stat().st_size
        except OSError:  # another process has removed it
            continue


def _clock_ahead_s(folder: Path) -> float:
    """Modification time of a new file, less the time of this machine."""
    probe = folder / f".doctor.{secrets.token_hex(4)}.partial"
    try:
        now_s = time.time()
        probe.write_bytes(b"0")
        return probe.stat().st_mtime - now_s
    finally:
        probe.unlink(missing_ok=True)
