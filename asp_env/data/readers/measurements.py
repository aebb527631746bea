"""Recordings from measured positions: tracks are split, smoothed, and their motion is derived.

Readers of layouts without reliable velocities and headings share this: those of INTERACTION, SinD
and geo-trax, and readers of one's own. Only positions and times are used as they are.
"""

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int

from asp_env.data.classes import VULNERABLE
from asp_env.data.readers.layout import TrackTable, shorten, states_of
from asp_env.data.readers.motion_checks import (
    check_conventions,
    check_speeds,
    contradicting_share,
    motion_of,
)
from asp_env.data.readers.ranges import check_duration, check_extent
from asp_env.data.readers.resampling import at_times, frames_within
from asp_env.data.readers.sizes import with_footprints
from asp_env.data.readers.smoothing import (
    JUMP_M,
    count_held,
    find_jumps,
    follow_heading,
    smooth,
)
from asp_env.data.readers.tables import Clock, read_clock
from asp_env.dynamics.bicycle import AXLE_SHARE_OF_LENGTH
from asp_env.errors import DataError

MIN_PIECE_S = 0.5
"""Pieces of tracks between gaps or jumps that are shorter than this are left out: they are too
short for an estimate of speed. Chosen by hand."""

FORWARD_ABOVE_MPS = 3.0
"""No vehicle drives backwards faster than this: above it, a heading against the motion is wrong.
Chosen by hand."""

MAX_WRONG_SHARE = 0.01
"""If more than this share of the headings of fast vehicles are wrong, the headings are taken to be
folded into ±90°. Chosen by hand: single tracker errors must not count."""

Located = Callable[[int, float, int, str], str]
"""Called with a track, a time in ms, the occurrence of a row with both (from 1), and a text;
returns the row's file and line, followed by the text with `{track}` and `{time}` filled in."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Measurements:
    """Rows of a table: where an agent was at a time. Rows may be in any order."""

    track: Int[np.ndarray, " rows"]
    """Id of the agent's track."""
    time_ms: Float[np.ndarray, " rows"]
    classes: Int[np.ndarray, " rows"]
    """`AgentClass`; `ClassNames` reads names."""
    positions: Float[np.ndarray, "rows 2"]
    """Centre of the box, [x m, y m], y to the left of x. Subtract large offsets, because states are
    float32."""
    heading: Float[np.ndarray, " rows"]
    """Direction of the front, radians counter-clockwise from +x; NaN where it is unknown."""
    sizes: Float[np.ndarray, "rows 2"]
    """Length and width, m; 0 where they are unknown."""
    speed: Float[np.ndarray, " rows"] | None = None
    """Speed, m/s; NaN where it is unknown. It is only compared with the positions: a factor between
    both is reported, since one of them is in another unit."""

    def select(self, rows: np.ndarray) -> "Measurements":
        """The rows of a mask, or at some indices."""
        columns = {name: getattr(self, name) for name in self.__slots__}
        return replace(
            self, **{name: each[rows] for name, each in columns.items() if each is not None}
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class _Piece:
    """The smoothed part of a track between two gaps or jumps."""

    track: int
    rows: slice
    positions: Float[np.ndarray, "rows 2"]
    velocities: Float[np.ndarray, "rows 2"]


def derive_tracks(
    measurements: Measurements, source: str, located: Located | None = None
) -> tuple[TrackTable, float]:
    """Derives states from positions and times.

    Where times deviate from whole frames by more than rounding, positions are interpolated at whole
    frames. Tracks are split at gaps and jumps, positions are smoothed, and speeds and headings are
    derived from them. The given heading determines which end of a vehicle is its front, unless
    headings contradict fast motion, and the heading of a vehicle that never moves. The heading of a
    vulnerable road user is its direction of motion, of the past alone; before the first motion it
    is that of the file, or 0.

    Args:
        measurements: the rows.
        source: the file or folder that they are from, for error messages.
        located: names the line of a row in error messages; by default its track and time.

    Returns:
        The tracks, and the frames per second.

    Raises:
        DataError: a track has two rows at one time, no track is long enough, or no frame rate fits
            the times, or positions or times are implausible.
    """
    if not len(measurements.track):
        raise DataError(f"{source}: has no rows; copy it again or remove the recording")
    rows = measurements.select(np.lexsort((measurements.time_ms, measurements.track)))

    def line_of(row: int, what: str) -> str:
        track, time_ms = int(rows.track[row]), float(rows.time_ms[row])
        if located is None:
            return f"{source}: {what.format(track=track, time=f'{time_ms:g}')}"
        before = (rows.track[:row] == track) & (rows.time_ms[:row] == time_ms)
        return located(track, time_ms, int(before.sum()) + 1, what)

    def place_of(row: int) -> str:
        return line_of(row, "track {track} at {time} ms")

    same = (np.diff(rows.track) == 0) & (np.diff(rows.time_ms) == 0)
    if same.any():
        raise DataError(
            line_of(int(same.argmax()) + 1, "a second row of track {track} at {time} ms")
            + ", expected one; remove one of the two"
        )
    check_extent(rows.positions, ("x", "y"), place_of)
    clock = read_clock(rows.track, rows.time_ms, line_of)
    check_duration(clock.frames, place_of)
    repairs: list[str] = []
    resampled_from_hz = None
    if clock.jittering is not None:
        resampled_from_hz = clock.mean_hz
        rows, clock = _without_jitter(rows, clock, repairs)
    pieces = _pieces(rows, clock, repairs)
    if not pieces:
        raise DataError(
            f"{source}: no track lasts {MIN_PIECE_S:g} s without a gap or jump; "
            "copy it again or remove the recording"
        )
    rows = _checked(rows, clock, source, repairs)
    kinds, sizes = _kinds_and_sizes(rows, pieces, source, repairs)
    vulnerable = np.isin(kinds, [int(kind) for kind in VULNERABLE])
    folded = _headings_are_folded(rows, pieces, vulnerable, repairs)
    measured = np.concatenate(
        [
            _measured(rows, piece, float(size[0]), clock.step_s, folded, bool(is_vulnerable))
            for piece, size, is_vulnerable in zip(pieces, sizes, vulnerable, strict=True)
        ]
    )
    lengths = np.array([len(piece.positions) for piece in pieces])
    starts = np.concatenate([[0], np.cumsum(lengths)]).astype(np.int64)
    states = states_of(measured, np.repeat(starts[:-1], lengths), np.repeat(vulnerable, lengths))
    table = TrackTable(
        track_ids=np.array([piece.track for piece in pieces], dtype=np.int64),
        classes=kinds,
        sizes=sizes,
        first_frames=np.array([clock.frames[piece.rows.start] for piece in pieces]),
        starts=starts,
        states=states,
        repairs=tuple(repairs),
        resampled_from_hz=resampled_from_hz,
    )
    return table, clock.rate_hz


def _pieces(rows: Measurements, clock: Clock, repairs: list[str]) -> list[_Piece]:
    """Splits tracks at gaps and jumps. Later pieces of a track get new ids."""
    changes = np.diff(rows.track) != 0
    gaps = ~changes & (np.diff(clock.frames) > 1)
    jumps = np.zeros_like(gaps)
    for begin, end in _stretches(changes | gaps):
        jumps[begin : end - 1] = find_jumps(rows.positions[begin:end])
    _report_splits(rows, gaps, "gaps in tracks' times, split there", repairs)
    _report_splits(rows, jumps, f"jumps of over {JUMP_M:g} m in tracks, split there", repairs)

    new_id = int(rows.track.max()) + 1
    pieces: list[_Piece] = []
    later: list[_Piece] = []
    held, short = [], []
    for first, end in _stretches(changes | gaps | jumps):
        track = int(rows.track[first])
        begin = first + count_held(rows.positions[first:end], clock.step_s)
        if begin > first:
            held.append(track)
        if end - begin < max(round(MIN_PIECE_S * clock.rate_hz), 2):
            short.append(track)
            continue
        positions, velocities = smooth(rows.positions[begin:end], clock.step_s)
        is_later = bool(pieces) and pieces[-1].track == track
        piece = _Piece(
            track=new_id + len(later) if is_later else track,
            rows=slice(begin, end),
            positions=positions,
            velocities=velocities,
        )
        (later if is_later else pieces).append(piece)
    _report_tracks(held, "tracks repeat their first position, repeated rows left out", repairs)
    _report_tracks(short, f"tracks have pieces under {MIN_PIECE_S:g} s, these left out", repairs)
    return pieces + later


def _without_jitter(
    rows: Measurements, clock: Clock, repairs: list[str]
) -> tuple[Measurements, Clock]:
    """Rows at whole frames, from rows whose times jitter; tracks have the same gaps as before."""
    assert clock.jittering is not None
    begin_ms = float(rows.time_ms.min())
    nearest, positions, frames = [], [], []
    after = (np.diff(rows.track) != 0) | (np.diff(clock.frames) > 1)
    for first, end in _stretches(after):
        times = clock.jittering[first:end]
        wanted = frames_within(times)
        frames.append(wanted)
        positions.append(at_times(rows.positions[first:end], times, wanted.astype(np.float64)))
        middles = 0.5 * (times[1:] + times[:-1])
        nearest.append(first + np.searchsorted(middles, wanted))
    row = np.concatenate(nearest)
    frame = np.concatenate(frames)
    off_ms = 1000.0 / clock.rate_hz * np.abs(clock.jittering - np.round(clock.jittering)).max()
    repairs.append(
        f"timestamp_ms is up to {off_ms:.3g} ms off frames of {clock.rate_hz:g} Hz: positions "
        "interpolated at these frames"
    )
    on_frames = replace(
        rows.select(row),
        time_ms=begin_ms + frame * 1000.0 / clock.rate_hz,
        positions=np.concatenate(positions),
    )
    return on_frames, replace(clock, frames=frame, jittering=None)


def _stretches(ends_after: Bool[np.ndarray, " steps"]) -> list[tuple[int, int]]:
    """First row and end of each stretch of rows between marked steps."""
    bounds = [0, *(np.flatnonzero(ends_after) + 1).tolist(), len(ends_after) + 1]
    return list(itertools.pairwise(bounds))


def _report_tracks(tracks: Sequence[int], what: str, repairs: list[str]) -> None:
    if tracks:
        names = [str(track) for track in dict.fromkeys(tracks)]
        repairs.append(f"{len(names)} {what}: {shorten(names)}")


def _report_splits(
    rows: Measurements, after: Bool[np.ndarray, " steps"], what: str, repairs: list[str]
) -> None:
    if after.any():
        splits = [
            f"{rows.track[row]} after {rows.time_ms[row]:g} ms" for row in np.flatnonzero(after)
        ]
        repairs.append(f"{len(splits)} {what}: {shorten(splits)}")


def _kinds_and_sizes(
    rows: Measurements, pieces: Sequence[_Piece], source: str, repairs: list[str]
) -> tuple[Int[np.ndarray, " pieces"], Float[np.ndarray, "pieces 2"]]:
    """Each piece's class, which is that of its first row, and its median size."""
    kinds = np.array([rows.classes[piece.rows.start] for piece in pieces], dtype=np.int8)
    sizes = np.array([np.median(rows.sizes[piece.rows], axis=0) for piece in pieces])
    differ = [
        piece.track
        for piece, kind in zip(pieces, kinds, strict=True)
        if (rows.classes[piece.rows] != kind).any()
    ]
    _report_tracks(differ, "tracks change their agent_type", repairs)
    return kinds, with_footprints(sizes, kinds, source, repairs)


def _checked(rows: Measurements, clock: Clock, source: str, repairs: list[str]) -> Measurements:
    """The rows, without headings if these contradict the motion at either end of most vehicles.

    Raises:
        DataError: one convention explains all headings, or positions are in degrees.
    """
    motion = motion_of(rows.track, clock.frames, rows.positions, clock.rate_hz)
    if rows.speed is not None:
        repairs += check_speeds(motion, rows.speed, clock.rate_hz, source)
    vulnerable = np.isin(rows.classes, [int(kind) for kind in VULNERABLE])
    headings = np.where(vulnerable, np.nan, rows.heading)
    check_conventions(motion, headings, source, unit="radians")
    if (share := contradicting_share(motion, headings)) <= 0.5:
        return rows
    repairs.append(
        f"the headings of {100 * share:.0f} % of the fast vehicles contradict their motion: "
        "headings are not used, and vehicles that never move head along +x"
    )
    return replace(rows, heading=np.full(len(rows.track), np.nan))


def _headings_are_folded(
    rows: Measurements,
    pieces: Sequence[_Piece],
    vulnerable: Bool[np.ndarray, " pieces"],
    repairs: list[str],
) -> bool:
    """Whether the file's headings do not distinguish a vehicle's front from its rear."""
    fast = wrong = 0
    for piece, is_vulnerable in zip(pieces, vulnerable, strict=True):
        heading = rows.heading[piece.rows]
        if is_vulnerable or np.isnan(heading).any():
            continue
        moves = np.hypot(*piece.velocities.T) > FORWARD_ABOVE_MPS
        along = (piece.velocities * np.stack([np.cos(heading), np.sin(heading)], axis=-1)).sum(-1)
        fast += int(moves.sum())
        wrong += int((moves & (along < 0)).sum())
    if wrong <= MAX_WRONG_SHARE * fast:
        return False
    share = 100 * wrong / fast
    repairs.append(
        f"{share:.0f} % of the headings of fast vehicles point backwards: "
        "the front is determined from motion alone"
    )
    return True


def _measured(
    rows: Measurements, piece: _Piece, length_m: float, dt_s: float, folded: bool, vulnerable: bool
) -> Float[np.ndarray, "rows 5"]:
    """x, y, heading in degrees, velocity along x and y."""
    heading = rows.heading[piece.rows]
    if np.isnan(heading).any():
        heading = None
    if vulnerable:
        heading = np.zeros(len(piece.positions)) if heading is None else heading
    else:
        rear_m = AXLE_SHARE_OF_LENGTH * length_m
        heading = follow_heading(piece.positions, heading, rear_m, dt_s, folded=folded)
    return np.column_stack([piece.positions, np.degrees(heading), piece.velocities])
