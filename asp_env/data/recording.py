"""Recordings: the tracks measured at one location, and ticks as a whole number of their frames."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from asp_env.arguments import positive_number
from asp_env.data.classes import is_predicted
from asp_env.data.road_map import RoadMap
from asp_env.data.signals import Signals
from asp_env.errors import AspEnvError, DataError

DEFAULT_DT_S = 0.2
"""Default seconds per tick."""

LEAST_FRAMES_PER_TICK = 0.75
"""Recordings with fewer frames per tick are refused: most of their ticks would be interpolated.
Chosen by hand."""

MAX_DURATION_S = 3600.0
"""Longest history, horizon and tick. Chosen by hand: beyond all recordings."""

SUGGESTIONS = 5
"""Number of time steps that an error message lists."""

_TIME_STEPS_S = tuple(
    0.6 / count for count in (*(1, 2, 3, 4, 5, 6, 8, 10, 12, 15, 20, 24, 30), *(40, 60, 75, 120))
)
"""Time steps of which history, horizons and the interval of snippets (multiples of 0.6 s) are whole
numbers, and which are short decimal fractions."""

PARKED_WITHIN_M = 1.0
"""A track of the whole recording that stays within this distance of its start is parked. Chosen by
hand: above the noise of measured positions."""


def fits_ticks(frame_rate_hz: float, dt_s: float) -> bool:
    """Whether a tick is a whole number of frames.

    Raises:
        AspEnvError: a value is not a positive number.
    """
    positive_number("frame rate", frame_rate_hz, "Hz")
    positive_number("time step", dt_s, "s")
    frames = dt_s * frame_rate_hz
    return frames > 0.5 and abs(frames - round(frames)) <= 1e-4 * frames


def frames_per_tick(frame_rate_hz: float, dt_s: float = DEFAULT_DT_S) -> int:
    """Number of frames per tick.

    Raises:
        AspEnvError: `dt_s` is not a whole number of frames; the message lists near ones that are,
            and of which 3 s are a whole number.
    """
    if fits_ticks(frame_rate_hz, dt_s):
        return round(dt_s * frame_rate_hz)
    possible = _near([step for step in _TIME_STEPS_S if fits_ticks(frame_rate_hz, step)], dt_s)
    remedies = [f"choose one of {possible} s"] if possible else []
    if frame_rate_hz * dt_s >= LEAST_FRAMES_PER_TICK:
        remedies.append(f"open the data by open_data(…, dt_s={dt_s:g}), which resamples them")
    raise AspEnvError(
        f"time step {dt_s:g} s does not divide recordings of {frame_rate_hz:g} Hz: "
        + ", or ".join(remedies)
    )


def rate_for_ticks(frame_rate_hz: float, dt_s: float) -> float:
    """The frame rate at which a recording is read.

    Args:
        frame_rate_hz: frames per second of the files.
        dt_s: seconds per tick.

    Returns:
        `frame_rate_hz` if a tick is a whole number of its frames, else the nearest rate for which
        it is; of two equally near ones the higher.

    Raises:
        AspEnvError: the frames are too far apart for the tick, or a value is not a positive number.
    """
    if fits_ticks(frame_rate_hz, dt_s):
        return frame_rate_hz
    frames = frame_rate_hz * dt_s
    if frames < LEAST_FRAMES_PER_TICK:
        least_s = LEAST_FRAMES_PER_TICK / frame_rate_hz
        possible = _near([step for step in _TIME_STEPS_S if step >= least_s], dt_s)
        raise AspEnvError(
            f"time step {dt_s:g} s is too short for recordings of {frame_rate_hz:g} Hz: choose "
            + (f"one of {possible} s" if possible else f"at least {least_s:g} s")
        )
    return round(max(1, math.floor(frames + 0.5)) / dt_s, 9)


def _near(steps_s: Sequence[float], dt_s: float) -> str:
    """The time steps that are nearest to one, in increasing order."""
    nearest = sorted(steps_s, key=lambda step: abs(step - dt_s))[:SUGGESTIONS]
    return ", ".join(f"{step:g}" for step in sorted(nearest))


def check_duration(what: str, value_s: Any) -> None:
    """Checks a time step, a history or a horizon.

    Raises:
        AspEnvError: the duration is no positive number of seconds, or longer than an hour.
    """
    if positive_number(what, value_s, "s") > MAX_DURATION_S:
        raise AspEnvError(f"{what} {value_s:g} s: expected at most {MAX_DURATION_S:g} s")


def ticks(duration_s: float, dt_s: float) -> int:
    """Number of ticks of a duration.

    Raises:
        AspEnvError: the duration is not a whole, positive number of ticks. The message lists near
            time steps, or near durations if no usual time step divides the duration.
    """
    for what, value_s in (("time step", dt_s), ("duration", duration_s)):
        check_duration(what, value_s)
    count = round(duration_s / dt_s)
    if count < 1 or abs(count * dt_s - duration_s) > 1e-6:
        if any(math.isclose(dt_s, step) for step in _TIME_STEPS_S):
            whole = max(math.floor(duration_s / dt_s), 1)
            choose = f"{whole * dt_s:g} or {(whole + 1) * dt_s:g} s instead"
        else:
            choose = f"a time step of {_near(_TIME_STEPS_S, dt_s)} s"
        raise AspEnvError(
            f"{duration_s:g} s is no whole number of ticks of {dt_s:g} s: choose {choose}"
        )
    return count


@dataclass(frozen=True, slots=True, kw_only=True)
class Background:
    """An aerial image of the location, for display only."""

    path: Path
    metres_per_pixel: float
    """Pixel (column, row) shows the point (column, -row) times this factor."""


@dataclass(frozen=True, kw_only=True)
class Recording:
    """Tracks of agents at one location. The arrays are read-only and may be memory-mapped.

    Rows are sorted by track, then frame. A track has a row for every frame from its first to its
    last, so that the row of a frame is `starts[track] + frame - first_frames[track]`.
    """

    name: str
    """The recording's id in its files, such as `00`."""
    location: str
    """Name of the location in the files."""
    frame_rate_hz: float
    num_frames: int
    speed_limit_mps: float | None
    """None where the files give no limit."""
    track_ids: Int[np.ndarray, " tracks"]
    classes: Int[np.ndarray, " tracks"]
    """`AgentClass` of each track."""
    sizes: Float[np.ndarray, "tracks 2"]
    """Length and width, m; positive."""
    first_frames: Int[np.ndarray, " tracks"]
    starts: Int[np.ndarray, " tracks+1"]
    """Track i occupies the rows `starts[i]:starts[i + 1]`."""
    states: Float[np.ndarray, "rows 4"]
    """[x m, y m, heading rad, speed m/s signed along the heading]."""
    road_map: RoadMap
    background: Background | None = None
    signals: Signals | None = None
    """Traffic signals; None if the files contain none."""
    repairs: tuple[str, ...] = ()
    """One line for each fault of the files that the reader repaired."""
    resampled_from_hz: float | None = None
    """Frames per second of the files if the states are interpolated between their frames; None if
    not."""
    start_hour: float | None = None
    """Time of day of the first frame, hours after midnight; None where the files give none."""
    weekday: str | None = None
    """Day of the recording as the files name it; None where they do not."""
    accelerations: Float[np.ndarray, " rows"] | None = None
    """Recorded accelerations along the direction of motion, m/s², signed as the speed: its rate of
    change according to the files. None where the files have none."""
    shows_accelerations: bool = False
    """Whether scenes show `accelerations` in past actions instead of changes of speed."""

    def __post_init__(self) -> None:
        """Checks that the columns of the track table have matching lengths.

        Raises:
            DataError: they do not match, or the signals are of another number of frames.
        """
        tracks = len(self.track_ids)
        if not (
            len(self.classes) == len(self.sizes) == len(self.first_frames) == tracks
            and len(self.starts) == tracks + 1
            and self.starts[-1] == len(self.states)
        ):
            raise DataError(f"recording {self.name}: the track table's columns differ in length")
        if self.signals is not None and self.signals.states.shape[1] != self.num_frames:
            raise DataError(
                f"recording {self.name}: signals with {self.signals.states.shape[1]} frames, "
                f"expected {self.num_frames}"
            )

    def __deepcopy__(self, memo: dict[int, Any]) -> "Recording":
        """Returns the same object, since recordings are immutable."""
        del memo
        return self

    def __len__(self) -> int:
        """Number of tracks."""
        return len(self.track_ids)

    @property
    def duration_s(self) -> float:
        """Duration of all frames, s."""
        return self.num_frames / self.frame_rate_hz

    @cached_property
    def last_frames(self) -> Int[np.ndarray, " tracks"]:
        """The last frame of each track."""
        return self.first_frames + np.diff(self.starts).astype(self.first_frames.dtype) - 1

    @cached_property
    def parked(self) -> Bool[np.ndarray, " tracks"]:
        """Mask of parked agents.

        They are present from the first to the last frame that has any agent, and never farther than
        `PARKED_WITHIN_M` from where they start.
        """
        begin, end = self.first_frames.min(initial=self.num_frames), self.last_frames.max(initial=0)
        always_present = (self.first_frames == begin) & (self.last_frames == end)
        parked = [
            bool(
                always_present[i]
                and np.hypot(*(self.track(i)[:, :2] - self.track(i)[0, :2]).T).max()
                < PARKED_WITHIN_M
            )
            for i in range(len(self))
        ]
        return np.array(parked, dtype=bool)

    @cached_property
    def of_predicted_class(self) -> Bool[np.ndarray, " tracks"]:
        """Mask of tracks of a predicted class, parked agents included."""
        return is_predicted(self.classes)

    @cached_property
    def predicted(self) -> Bool[np.ndarray, " tracks"]:
        """Mask of tracks that may be predicted or driven: of a predicted class, and not parked."""
        return self.of_predicted_class & ~self.parked

    @cached_property
    def extent_m(self) -> tuple[float, float, float, float]:
        """Smallest x, smallest y, largest x and largest y of all positions, m."""
        if not len(self.states):
            return (0.0, 0.0, 1.0, 1.0)
        low, high = self.states[:, :2].min(axis=0), self.states[:, :2].max(axis=0)
        return (float(low[0]), float(low[1]), float(high[0]), float(high[1]))

    @cached_property
    def frame_index(self) -> tuple[Int[np.ndarray, " bounds"], Int[np.ndarray, " rows"]]:
        """(starts, tracks): frame f has the tracks `tracks[starts[f]:starts[f + 1]]`, in order."""
        lengths = np.diff(self.starts)
        tracks = np.repeat(np.arange(len(self), dtype=np.int32), lengths)
        within = np.arange(len(tracks)) - np.repeat(self.starts[:-1], lengths)
        frames = np.repeat(self.first_frames, lengths) + within
        order = np.argsort(frames, kind="stable")
        counts = np.bincount(frames, minlength=self.num_frames)
        return np.concatenate([[0], np.cumsum(counts)]), tracks[order]

    def track(self, index: int) -> Float[np.ndarray, "frames 4"]:
        """The states of a track at all of its frames."""
        return self.states[self.starts[index] : self.starts[index + 1]]

    def tracks_between(self, first_frame: int, last_frame: int) -> Int[np.ndarray, " found"]:
        """Indices of the tracks in [first_frame, last_frame], sorted by first frame, then id."""
        found = np.flatnonzero(
            (self.first_frames <= last_frame) & (self.last_frames >= first_frame)
        )
        return found[np.lexsort((self.track_ids[found], self.first_frames[found]))]
