"""Folders that are there whole or not at all."""

import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from asp_env.errors import AspEnvError


@contextmanager
def written_aside(out: Path) -> Iterator[Path]:
    """A folder beside `out` that takes its place when all went well, and else disappears.

    Raises:
        AspEnvError: `out` is neither new nor an empty folder, or cannot be written.
    """
    out = out.absolute()
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise AspEnvError(f"{out} is not an empty folder: give one that is, or a new name")
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        aside = Path(tempfile.mkdtemp(prefix=f".{out.name}-", dir=out.parent))
    except OSError as error:
        raise AspEnvError(
            f"cannot write to {out.parent} ({error.strerror}): give a folder that can be written"
        ) from error
    try:
        yield aside
        aside.chmod(0o755)
        if out.exists():
            out.rmdir()
        os.rename(aside, out)
    except OSError as error:
        raise AspEnvError(f"cannot write {out} ({error.strerror or error})") from error
    finally:
        shutil.rmtree(aside, ignore_errors=True)
