"""Folders that are made on first use and kept in the user's cache folder."""

import os
import tempfile
from collections.abc import Callable
from pathlib import Path

from asp_env.data.cache import cache_folder
from asp_env.errors import AspEnvError


def made_once(shelf_name: str, name: str, make: Callable[[Path], None]) -> Path:
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
