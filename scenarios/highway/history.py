"""What highway-env's vehicles had in mind while a recording was made, kept beside its tracks."""

import zipfile
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Int, Shaped

from asp_env.data.recording import Recording
from asp_env.errors import DataError
from scenarios.highway.hidden import HIDDEN, Rows
from scenarios.highway.rounds import KEPT_EVERY
from scenarios.highway.sites import SITES, Site

FOLDER = "hidden"
"""Beside `data` and `maps`."""

WANTED = "made by `asp-env synthesize OUT --site highway:…`"

_DAMAGE = (OSError, ValueError, KeyError, EOFError, TypeError, zipfile.BadZipFile, zlib.error)
"""What NumPy raises of files that are not whole, or are something else."""


@dataclass(frozen=True, slots=True, kw_only=True)
class HiddenHistory:
    """The hidden states of all vehicles of a recording, every 0.2 s."""

    site: Site
    rows: Shaped[np.ndarray, " n"]
    """Of `HIDDEN`, time by time."""
    steps: Int[np.ndarray, " times"]
    """What the road had counted by then."""
    starts: Int[np.ndarray, " times+1"]
    """Time i has the rows `starts[i]:starts[i + 1]`."""

    def __deepcopy__(self, memo: dict[int, Any]) -> "HiddenHistory":
        """Itself, since nobody changes it."""
        del memo
        return self

    def at(self, frame: int) -> tuple[Rows, int]:
        """The vehicles at a frame, and what the road had counted."""
        time = frame // KEPT_EVERY
        return self.rows[self.starts[time] : self.starts[time + 1]], int(self.steps[time])

    def coming(self, frame: int) -> Rows:
        """Those who are there at a frame and were not there before; none behind the last frame."""
        time = frame // KEPT_EVERY
        if frame % KEPT_EVERY or not 0 < time < len(self.steps):
            return self.rows[:0]
        now, _ = self.at(frame)
        before, _ = self.at(frame - KEPT_EVERY)
        return now[~np.isin(now["track"], before["track"])]

    def fits(self, recording: Recording) -> bool:
        """Whether it tells of the same vehicles at the same times."""
        frames = np.repeat(np.arange(len(self.steps)), np.diff(self.starts)) * KEPT_EVERY
        tracks, last = self.rows["track"], recording.last_frames
        if len(self.steps) < -(
            -recording.num_frames // KEPT_EVERY
        ):  # more: all left before the end
            return False
        if len(tracks) and not 0 <= tracks.min() <= tracks.max() < len(recording):
            return False
        there = (recording.first_frames[tracks] <= frames) & (frames <= last[tracks])
        times = last // KEPT_EVERY - (recording.first_frames - 1) // KEPT_EVERY
        return bool(there.all() and len(tracks) == times.sum())

    def save(self, path: Path) -> None:
        """Writes a file that needs no pickle."""
        np.savez_compressed(
            path,
            site=np.array(self.site.name),
            rows=self.rows,
            starts=self.starts,
            steps=self.steps,
        )


def load_history(path: Path) -> HiddenHistory:
    """Reads what `save` wrote.

    Raises:
        DataError: the file is missing, damaged, or of another version.
    """
    try:
        with path.open("rb") as file, np.load(file, allow_pickle=False) as found:
            site, rows = str(found["site"]), found["rows"]
            starts, steps = found["starts"], found["steps"]
    except FileNotFoundError:
        raise DataError(f"{path} is missing: expected a folder {WANTED}") from None
    except _DAMAGE as error:
        raise DataError(f"{path} is damaged ({error}): expected what was {WANTED}") from error
    if site not in SITES or rows.dtype != HIDDEN or not _whole(rows, starts, steps):
        raise DataError(f"{path}: of another version; expected what was {WANTED} by this one")
    return HiddenHistory(site=SITES[site], rows=rows, starts=starts, steps=steps)


def _whole(rows: np.ndarray, starts: np.ndarray, steps: np.ndarray) -> bool:
    if not (rows.ndim == starts.ndim == steps.ndim == 1 and starts.dtype.kind == "i"):
        return False
    if len(starts) != len(steps) + 1 or steps.dtype.kind != "i":
        return False
    return bool(starts[0] == 0 and starts[-1] == len(rows) and (np.diff(starts) >= 0).all())


def hidden_path(tracks_path: Path) -> Path:
    """Where the hidden history of a recording lies, from where its tracks lie."""
    name = tracks_path.name.partition("_")[0]
    return tracks_path.parent.parent / FOLDER / f"{name}_hidden.npz"
