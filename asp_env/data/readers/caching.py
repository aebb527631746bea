"""Results of readers in the cache: read once, mapped into memory later."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from asp_env.data import cache
from asp_env.errors import DataError

CacheEntry = tuple[dict[str, Any], dict[str, np.ndarray]]
"""Facts and arrays, the content of a cache file."""


def cached(
    path: Path, sources: Sequence[Path], make: Callable[[], CacheEntry], salt: object
) -> CacheEntry:
    """The result of `make`, from the cache if it is stored there and no source has changed since.

    If the cache cannot be written, one line is logged, and `make` is called every time.

    Args:
        path: the file that the result is named after.
        sources: all files that the result follows from.
        make: computes the result.
        salt: distinguishes several results of one file.
    """
    current = cache.stamp(sources)
    try:
        stored = cache.entry_path(cache.cache_folder(), path, salt)
    except DataError as error:
        cache.note_uncached(error)
        return _read_only(make())
    if (found := cache.load(stored, current)) is not None:
        return found
    made = make()
    try:
        cache.save(stored, current, *made)
    except OSError as error:
        cache.note_uncached(error, stored)
    return cache.load(stored, current) or _read_only(made)


def _read_only(made: CacheEntry) -> CacheEntry:
    for array in made[1].values():
        array.flags.writeable = False
    return made
