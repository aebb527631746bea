"""Finding files: every layout searches folders in the same way."""

import os
import re
from pathlib import Path


def walk(root: Path) -> list[tuple[Path, list[str]]]:
    """Every folder below `root` with its files, hidden ones left out, linked ones followed."""
    seen: set[str] = set()
    found = []
    for folder, folders, names in os.walk(root, followlinks=True):
        real = os.path.realpath(folder)
        if real in seen:
            folders.clear()
            continue
        seen.add(real)
        folders[:] = sorted(name for name in folders if not name.startswith("."))
        found.append((Path(folder), sorted(names)))
    return found


def upwards(folder: Path, top: Path) -> list[Path]:
    """A folder and those above it, up to `top`."""
    found = [folder]
    while folder != top and folder.is_relative_to(top):
        folder = folder.parent
        found.append(folder)
    return found


def maps_in(folder: Path, maps_below: dict[Path, list[Path]]) -> list[Path]:
    """The maps in and below a folder, by path.

    Args:
        folder: where to search.
        maps_below: what is known of folders searched before; is added to.
    """
    if folder not in maps_below:
        paths = (place / name for place, names in walk(folder) for name in names)
        maps_below[folder] = sorted(path for path in paths if path.suffix in (".osm", ".osm_xy"))
    return maps_below[folder]


def natural(name: str) -> list[tuple[int, int, str]]:
    """Sorts names as people do: `9` before `10`."""
    parts = re.split(r"(\d+)", name)
    return [(1, int(part), "") if part.isdigit() else (0, 0, part) for part in parts]
