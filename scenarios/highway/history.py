"""What highway-env's vehicles had in mind while a recording was made, kept beside its tracks."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Int, Shaped

from asp_env.errors import DataError
from scenarios.highway.hidden import HIDDEN, Rows
from scenarios.highway.rounds import KEPT_EVERY
from scenarios.highway.sites import SITES, Site

FOLDER = "hidden"
"""Beside `data` and `maps`."""


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
    wanted = "made by `asp-env synthesize OUT --site highway:…`"
    try:
        with np.load(path, allow_pickle=False) as found:
            site, rows = str(found["site"]), found["rows"]
            starts, steps = found["starts"], found["steps"]
    except FileNotFoundError:
        raise DataError(f"{path} is missing: expected a folder {wanted}") from None
    except (OSError, ValueError, KeyError, EOFError) as error:
        raise DataError(f"{path} is damaged ({error}): expected what was {wanted}") from error
    fits = rows.dtype == HIDDEN and len(starts) == len(steps) + 1 and starts[-1] == len(rows)
    if site not in SITES or not fits:
        raise DataError(f"{path}: of another version; expected what was {wanted} by this one")
    return HiddenHistory(site=SITES[site], rows=rows, starts=starts, steps=steps)


def hidden_path(tracks_path: Path) -> Path:
    """Where the hidden history of a recording lies, from where its tracks lie."""
    name = tracks_path.name.partition("_")[0]
    return tracks_path.parent.parent / FOLDER / f"{name}_hidden.npz"
