"""What all file layouts share: the search for files, agent classes, and the table of tracks."""

import os
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd
from jaxtyping import Bool, Float, Int

from asp_env.data.classes import AgentClass, parse_class
from asp_env.data.readers.compressed import one_of_each
from asp_env.errors import DataError
from asp_env.geometry import wrap_angle

MAP_SUFFIXES = (".osm", ".osm_xy")
"""Suffixes of map files, in order of preference: in degrees, in local metres."""

COURSE_ABOVE_MPS = 0.3
"""Speed above which the direction of motion is the heading of a vulnerable road user. Chosen by
hand: slower motion is mostly jitter of the tracker."""


@dataclass(frozen=True, slots=True, kw_only=True)
class TrackTable:
    """The columns of a `Recording` that come from its tracks, and a list of repairs."""

    track_ids: Int[np.ndarray, " tracks"]
    classes: Int[np.ndarray, " tracks"]
    """`AgentClass` of each track."""
    sizes: Float[np.ndarray, "tracks 2"]
    """Length and width, metres."""
    first_frames: Int[np.ndarray, " tracks"]
    starts: Int[np.ndarray, " tracks+1"]
    """Track i has the rows `starts[i]:starts[i + 1]`."""
    states: Float[np.ndarray, "rows 4"]
    """[x m, y m, heading rad, speed m/s signed along the heading]."""
    repairs: tuple[str, ...]
    """One line for each kind of repair."""
    accelerations: Float[np.ndarray, " rows"] | None = None
    """Accelerations along the direction of motion, m/s²; None if the files have none."""
    frames_per_row: int = 1
    """Frames of the files from one row of a track to the next."""
    resampled_from_hz: float | None = None
    """Frames per second of the files where the rows are interpolated; None where they are not."""


ARCHIVE = re.compile(
    r"(\.(zip|7z|rar|tar|tgz|tbz2|txz|zst|bz2|lz4|tar\.(gz|xz)|osm\.(gz|xz))|meta\.csv\.(gz|xz))$",
    re.IGNORECASE,
)
"""The end of the name of an archive, which has to be unpacked before it can be read."""


_OF_SYSTEMS = frozenset(
    {"__macosx", "$recycle.bin", "system volume information", "lost+found"}
    | {"#recycle", "#snapshot", "@eadir"}
)
"""Names of folders of operating systems and network storages, which keep deleted files there."""


def is_hidden(name: str) -> bool:
    """Whether a file or folder is hidden or temporary, such as `._NAME`, `__MACOSX`, `~$NAME`."""
    return name.startswith((".", "~")) or name.lower() in _OF_SYSTEMS


def walk(root: Path) -> list[tuple[Path, list[str]]]:
    """Every folder in and below `root` with the names of its files.

    Hidden and temporary files and folders are left out, and so are pipes and devices, at which a
    reader might wait forever, and all files of a table but one (`one_of_each`). Links are followed,
    but no folder is visited twice.
    """
    visited: set[str] = set()
    found = []
    for folder, folders, names in os.walk(root, followlinks=True):
        real = os.path.realpath(folder)
        if real in visited:
            folders.clear()
            continue
        visited.add(real)
        folders[:] = sorted(name for name in folders if not is_hidden(name))
        shown = (name for name in names if not is_hidden(name))
        files = sorted(n for n in shown if may_be_read(Path(folder) / n))
        found.append((Path(folder), one_of_each(files)))
    return found


def may_be_read(path: Path) -> bool:
    """Whether reading a file ends: not of pipes and devices; missing files are errors elsewhere."""
    try:
        return not path.exists() or path.is_file()
    except OSError:
        return True


def check_content(path: Path, start: bytes) -> None:
    """Refuses what downloads leave in the place of a file.

    Args:
        path: the file.
        start: its first bytes.

    Raises:
        DataError: it is a pointer of Git LFS or a web page.
    """
    text = start.lstrip(b"\xef\xbb\xbf \t\r\n").lower()
    if text.startswith(b"version https://git-lfs"):
        raise DataError(
            f"{path}: is a pointer of Git LFS instead of the file: fetch it by `git lfs pull`"
        )
    if text.startswith((b"<!doctype html", b"<html")):
        raise DataError(
            f"{path}: is a web page instead of the file, such as a login: download it again"
        )


def archive_hint(folder: Path) -> str:
    """The end of an error message that names the archives in and below a folder; may be empty."""
    if not folder.is_dir():
        return ""
    names = [name for _, names in walk(folder) for name in names if ARCHIVE.search(name)]
    return f"; unpack {shorten(names)} first" if names else ""


def with_parents(folder: Path, top: Path) -> list[Path]:
    """A folder and its parents up to and including `top`, nearest first."""
    found = [folder]
    while folder != top and folder.is_relative_to(top):
        folder = folder.parent
        found.append(folder)
    return found


def find_maps(folder: Path, maps_by_folder: dict[Path, list[Path]]) -> list[Path]:
    """The map files in and below a folder, sorted by path.

    Args:
        folder: where to search.
        maps_by_folder: results of earlier searches. The result is added.
    """
    if folder not in maps_by_folder:
        paths = (place / name for place, names in walk(folder) for name in names)
        maps_by_folder[folder] = sorted(path for path in paths if map_suffix(path) in MAP_SUFFIXES)
    return maps_by_folder[folder]


def map_suffix(path: Path) -> str:
    """The suffix of a file in lower case, such as those in `MAP_SUFFIXES`."""
    return path.suffix.lower()


def natural_key(name: str) -> list[tuple[int, int, str]]:
    """A sort key that orders numbers in names by value: `9` before `10`."""
    parts = re.split(r"([0-9]+)", name)
    return [(1, int(part), "") if index % 2 else (0, 0, part) for index, part in enumerate(parts)]


def shorten(names: list[str], limit: int = 5) -> str:
    """The first few items of a list, and how many more there are."""
    more = f" and {len(names) - limit} more" if len(names) > limit else ""
    return ", ".join(names[:limit]) + more


class ClassNames:
    """Reads class names; those that are not in the table become `other` and are counted."""

    def __init__(self) -> None:
        self._unknown: dict[str, set[object]] = {}
        """Tracks of each unknown name."""

    def classes(self, names: np.ndarray, tracks: np.ndarray) -> Int[np.ndarray, " rows"]:
        """`AgentClass` of each row.

        Args:
            names: (rows,) class names as the file has them.
            tracks: (rows,) id of the track of each row, a number or a text.
        """
        codes, known = pd.factorize(names)
        numbers = []
        for code, name in enumerate(known):
            try:
                numbers.append(int(parse_class(str(name))))
            except DataError:
                found = np.unique(tracks[codes == code]).tolist()
                self._unknown.setdefault(" ".join(str(name).split())[:40], set()).update(found)
                numbers.append(int(AgentClass.OTHER))
        return np.array(numbers, dtype=np.int8)[codes]

    def repairs(self) -> list[str]:
        """One line for each unknown name, with the number of its tracks."""
        return [
            f"{len(tracks)} tracks of the unknown class {name!r} are read as 'other'"
            for name, tracks in sorted(self._unknown.items())
        ]


def states_of(
    measured: Float[np.ndarray, "rows 5"],
    first_row: Int[np.ndarray, " rows"],
    vulnerable: Bool[np.ndarray, " rows"],
) -> Float[np.ndarray, "rows 4"]:
    """Converts measured rows to states.

    The heading of a vulnerable road user is its latest direction of motion, of the past alone. The
    speed of a vehicle has the sign of its motion along the heading.

    Args:
        measured: x m, y m, heading in degrees, velocity along x and y in m/s.
        first_row: index of the first row of each row's track.
        vulnerable: mask of the rows of vulnerable road users.

    Returns:
        States [x m, y m, heading rad, speed m/s].
    """
    heading = np.radians(measured[:, 2])
    velocity_x, velocity_y = measured[:, 3], measured[:, 4]
    total = np.hypot(velocity_x, velocity_y)
    moves = vulnerable & (total > COURSE_ABOVE_MPS)
    row = np.arange(len(measured))
    last_moving = np.maximum.accumulate(np.where(moves, row, -1))
    has_course = vulnerable & (last_moving >= first_row)
    course = np.arctan2(velocity_y, velocity_x)
    heading = np.where(has_course, course[last_moving], heading)
    along = velocity_x * np.cos(heading) + velocity_y * np.sin(heading)
    # The bicycle model's speed is that of the box's centre, which moves sideways in bends.
    speed = np.where(vulnerable, total, np.copysign(total, along))
    states = np.stack([measured[:, 0], measured[:, 1], wrap_angle(heading), speed], axis=-1)
    return states.astype(np.float32)
