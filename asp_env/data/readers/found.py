"""What a reader of one's own returns: recordings that it has found, and their tables and maps.

A reader is a function that is registered in the entry point group `asp_env.readers`. It takes a
folder and yields a `FoundRecording` for each recording in or below it; `docs/readers.md` shows one.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int8

from asp_env.data.readers.lanelet2 import Lanelet2File
from asp_env.data.readers.measurements import Measurements
from asp_env.data.readers.reader_checks import check_properties, checked_measurements
from asp_env.data.road_map import RoadMap
from asp_env.data.signals import SignalState
from asp_env.errors import DataError


@dataclass(frozen=True, slots=True, kw_only=True)
class SignalChanges:
    """The states of traffic signals over time, as a file has them: each holds until the next."""

    stop_lines: Float[np.ndarray, "signals 2 2"]
    """End points of each stop line, [x m, y m] in the frame of the positions; NaN where they are
    unknown."""
    time_ms: Float[np.ndarray, " changes"]
    """When the states begin, on the clock of the measurements; increasing."""
    states: Int8[np.ndarray, "signals changes"]
    """`SignalState` of each signal from that time on. It is `UNKNOWN` before the first time."""

    def __post_init__(self) -> None:
        """Checks that the arrays fit each other.

        Raises:
            ValueError: they have other shapes, or the times decrease.
        """
        shape, times = np.shape(self.states), np.asarray(self.time_ms)
        if len(shape) != 2 or np.shape(self.stop_lines) != (shape[0], 2, 2):
            raise ValueError(
                "stop_lines and states: expected (signals, 2, 2) and (signals, changes)"
            )
        if times.shape != shape[1:] or not (np.diff(times) >= 0).all():
            raise ValueError(f"time_ms: expected {shape[1]} increasing times, one for each change")

    def at(self, time_ms: Float[np.ndarray, " frames"]) -> Int8[np.ndarray, "signals frames"]:
        """The states at some times, ms."""
        before = np.full((len(self.states), 1), SignalState.UNKNOWN, dtype=np.int8)
        columns = np.searchsorted(self.time_ms, time_ms, side="right")
        return np.concatenate([before, self.states], axis=1)[:, columns]


@dataclass(frozen=True, slots=True, kw_only=True)
class RecordingTables:
    """The content of a recording's files."""

    measurements: Measurements
    """Positions over time; tracks are split at gaps and smoothed, speeds and headings derived."""
    location: str
    """Name of the site, which several recordings may share."""
    road_map: RoadMap | Lanelet2File | None = None
    """The map, in the frame of the positions. Of a file that `parse_lanelet2` reads, the part that
    agents reach is used, and it is checked that vehicles drive on it. Without a map the drivable
    area is that which vehicles cover, and there are no lanes."""
    signals: SignalChanges | None = None
    speed_limit_mps: float | None = None
    start_hour: float | None = None
    """Time of day of the first row, hours after midnight."""
    weekday: str | None = None
    repairs: tuple[str, ...] = ()
    """One line for each kind of what was left out, guessed or repaired, with counts."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FoundRecording:
    """A recording that a reader has found in a folder. It is read at its first use."""

    name: str
    """Unique within the folder, such as `LOCATION/NUMBER`."""
    tables: tuple[Path, ...]
    """All files that are read, the map among them; that with the tracks stands first. The recording
    is read again when one of them changes, and their content identifies it."""
    read: Callable[[tuple[Path, ...]], RecordingTables]
    """Reads `tables`: a function of a module, so that worker processes can import it."""

    def __post_init__(self) -> None:
        """Checks the fields, which another package has given.

        Raises:
            ValueError: there are no files, or a field has another type.
        """
        if not isinstance(self.name, str) or not self.name:
            raise ValueError(f"name: {self.name!r}, expected a text")
        if not self.tables or not all(isinstance(path, Path) for path in self.tables):
            raise ValueError(f"tables of {self.name}: {self.tables!r}, expected paths of files")
        if not callable(self.read):
            raise ValueError(f"read of {self.name}: {self.read!r}, expected a function")

    @property
    def tracks(self) -> Path:
        """The file with the tracks."""
        return self.tables[0]

    @property
    def background(self) -> None:
        """None: recordings of such readers have no background images."""
        return

    def read_tables(self) -> RecordingTables:
        """Reads the files.

        Raises:
            DataError: the files are damaged, or the reader fails.
        """
        try:
            tables = self.read(self.tables)
            if not isinstance(tables, RecordingTables):
                raise ValueError(f"{type(tables).__name__}, expected RecordingTables")
            check_properties(tables)
            repairs = tuple(" ".join(line.split()) for line in tables.repairs)
            measurements = checked_measurements(tables.measurements)
            return replace(tables, measurements=measurements, repairs=repairs)
        except DataError:
            raise
        except (Exception, SystemExit) as error:  # other packages may raise anything
            reason = " ".join(f"{type(error).__name__}: {error}".split())
            module = getattr(self.read, "__module__", type(self.read).__module__)
            raise DataError(
                f"{self.tracks}: the reader {module} failed ({reason}); mend the "
                "reader or remove the recording"
            ) from error
