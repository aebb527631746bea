"""Trackers of varied traffic: frame rate, errors, smoothing, gaps, and wrong sizes and classes."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from scenarios.noise import savitzky_golay
from scenarios.sumo.ranges import RANGES, Range
from scenarios.tables import Track

_TRACKER = RANGES.tracker

_LEAST_S = 0.6
"""Shortest part of a track that is cut in two."""

_STANDS_MPS = 0.3
"""Below this speed headings wobble."""

_MISTAKEN = {"bicycle": "motorcycle", "motorcycle": "bicycle"}


@dataclass(frozen=True, slots=True, kw_only=True)
class Tracker:
    """The tracker of one recording; see `TrackerRanges`."""

    seed: int
    """Of all errors."""
    frame_rate_hz: float
    position_m: float
    slow_share: float
    correlation_s: float
    heading_rad: float
    standstill: float
    wobble_rad: float
    """Zero where headings do not wobble."""
    window_s: float
    velocity_window_s: float
    gaps_per_minute: float
    wrong_class: float


def draw_tracker(rng: np.random.Generator) -> Tracker:
    """Draws a tracker. Its frame rate belongs to the recording, with and without errors."""
    wobbles = rng.random() < _TRACKER.wobble
    wobble_rad = float(rng.uniform(*_TRACKER.wobble_rad))
    window_s = float(rng.uniform(*_TRACKER.window_s))
    return Tracker(
        seed=int(rng.integers(2**31)),
        frame_rate_hz=float(rng.choice(_TRACKER.frame_rates_hz)),
        position_m=_logarithmic(rng, _TRACKER.position_m),
        slow_share=float(rng.uniform(*_TRACKER.slow_share)),
        correlation_s=float(rng.uniform(*_TRACKER.correlation_s)),
        heading_rad=_logarithmic(rng, _TRACKER.heading_rad),
        standstill=float(rng.uniform(*_TRACKER.standstill)),
        wobble_rad=wobble_rad if wobbles else 0.0,
        window_s=window_s,
        velocity_window_s=max(float(rng.uniform(*_TRACKER.velocity_window_s)), window_s),
        gaps_per_minute=float(rng.uniform(*_TRACKER.gaps_per_minute)),
        wrong_class=float(rng.uniform(*_TRACKER.wrong_class)),
    )


def observe(tracker: Tracker, tracks: list[Track]) -> list[Track]:
    """The tracks as a tracker reports them.

    Args:
        tracker: the tracker.
        tracks: true tracks at its frame rate.

    Returns:
        One track for each true one, in the same order, and behind them the later parts of tracks
        that are cut in two.
    """
    first, later = [], []
    for number, track in enumerate(tracks):
        # A generator for each track: the errors of one do not depend on the length of another.
        rng = np.random.default_rng([tracker.seed, number])
        start, *rest = _observed(rng, tracker, track)
        first.append(start)
        later += rest
    return [*first, *later]


def _logarithmic(rng: np.random.Generator, bounds: Range) -> float:
    return float(np.exp(rng.uniform(*np.log(bounds))))


def _observed(rng: np.random.Generator, tracker: Tracker, track: Track) -> list[Track]:
    """The parts of one observed track."""
    rate_hz, speed = tracker.frame_rate_hz, np.hypot(*track.velocity_mps.T)
    xy = track.xy + tracker.position_m * _errors(rng, tracker, speed, 2)
    heading = np.unwrap(track.heading_rad)
    heading = heading + tracker.heading_rad * _errors(rng, tracker, speed, 1)[:, 0]
    if tracker.wobble_rad:
        heading += _wobble(rng, tracker, speed)
    gaps = _gaps(rng, tracker, len(xy))
    cuts = [gap for gap in gaps if rng.random() < _TRACKER.cut]
    rows = np.arange(len(xy))
    seen = np.ones(len(xy), dtype=bool)
    for begin, end in gaps:
        seen[begin:end] = False
    columns = np.column_stack([xy, heading])
    columns = np.column_stack([np.interp(rows, rows[seen], each[seen]) for each in columns.T])
    columns = _smoothed(columns, tracker.window_s * rate_hz)
    velocity = np.gradient(
        _smoothed(columns[:, :2], tracker.velocity_window_s * rate_hz), 1.0 / rate_hz, axis=0
    )
    factor = rng.uniform(*_TRACKER.size_factor)
    kind = track.kind
    if kind in _MISTAKEN and rng.random() < tracker.wrong_class:
        kind = _MISTAKEN[kind]
    whole = replace(
        track,
        kind=kind,
        length_m=round(track.length_m * factor, 2),
        width_m=round(track.width_m * factor, 2),
        xy=columns[:, :2],
        heading_rad=columns[:, 2],
        velocity_mps=velocity,
        acceleration_mps2=np.gradient(velocity, 1.0 / rate_hz, axis=0),
    )
    begins = [0, *(end for _, end in cuts)]
    ends = [*(begin for begin, _ in cuts), len(xy)]
    return [_part(whole, begin, end) for begin, end in zip(begins, ends, strict=True)]


def _part(track: Track, begin: int, end: int) -> Track:
    return replace(
        track,
        first_frame=track.first_frame + begin,
        xy=track.xy[begin:end],
        heading_rad=track.heading_rad[begin:end],
        velocity_mps=track.velocity_mps[begin:end],
        acceleration_mps2=track.acceleration_mps2[begin:end],
    )


def _smoothed(columns: np.ndarray, frames: float) -> np.ndarray:
    """Smooths columns over a window of about so many frames; windows under five do nothing."""
    window = 2 * int(0.5 * frames) + 1
    return savitzky_golay(columns, window) if window >= 5 else columns


def _errors(
    rng: np.random.Generator, tracker: Tracker, speed_mps: Float[np.ndarray, " n"], columns: int
) -> Float[np.ndarray, "n columns"]:
    """Errors of unit variance: a slowly varying part and one that is independent in each frame.

    The slowly varying part is a stationary Gauss–Markov process, AR(1). Near standstill both change
    more slowly, and the independent part shrinks alike.
    """
    share = tracker.standstill
    pace = share + (1.0 - share) * np.clip(speed_mps / _TRACKER.moves_mps, 0.0, 1.0)
    slow = _gauss_markov(rng, pace / (tracker.correlation_s * tracker.frame_rate_hz), columns)
    quick = rng.normal(size=(len(pace), columns)) * pace[:, None]
    return np.sqrt(tracker.slow_share) * slow + np.sqrt(1.0 - tracker.slow_share) * quick


def _wobble(
    rng: np.random.Generator, tracker: Tracker, speed_mps: Float[np.ndarray, " n"]
) -> Float[np.ndarray, " n"]:
    """Error of the heading at standstill, where a tracker that follows the motion has none."""
    steps = np.full(len(speed_mps), 1.0 / (tracker.correlation_s * tracker.frame_rate_hz))
    stands = np.clip(1.0 - speed_mps / _STANDS_MPS, 0.0, 1.0)
    return tracker.wobble_rad * stands * _gauss_markov(rng, steps, 1)[:, 0]


def _gauss_markov(
    rng: np.random.Generator, steps: Float[np.ndarray, " n"], columns: int
) -> Float[np.ndarray, "n columns"]:
    """A stationary Gauss–Markov process of unit variance.

    Args:
        rng: draws the process.
        steps: (n,) time to each frame from the one before, in correlation times.
        columns: number of independent processes.
    """
    keep = np.exp(-steps)
    renew = np.sqrt(1.0 - keep**2)[:, None] * rng.normal(size=(len(steps), columns))
    values = np.empty((len(steps), columns))
    value = rng.normal(size=columns)
    for i, (kept, new) in enumerate(zip(keep.tolist(), renew, strict=True)):
        value = kept * value + new
        values[i] = value
    return values


def _gaps(rng: np.random.Generator, tracker: Tracker, frames: int) -> list[tuple[int, int]]:
    """First frame and end of each drop-out; between them and at the ends the track is seen."""
    rate_hz = tracker.frame_rate_hz
    least = round(_LEAST_S * rate_hz)
    count = rng.poisson(tracker.gaps_per_minute * frames / (60.0 * rate_hz))
    begins = np.sort(rng.integers(0, frames, count))
    lengths = np.round(rng.uniform(*_TRACKER.gap_s, count) * rate_hz).astype(np.int64)
    found: list[tuple[int, int]] = []
    free = least
    for begin, length in zip(begins.tolist(), lengths.tolist(), strict=True):
        end = begin + max(length, 1)
        if begin >= free and end <= frames - least:
            found.append((begin, end))
            free = end + least
    return found
