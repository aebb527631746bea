"""Whether the headings and speeds of files agree with the motion of the positions.

A file that follows another convention than its layout (radians, clockwise, from north, km/h, feet)
is plausible cell by cell, and everything that is computed from it is wrong. The positions show it.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from asp_env.data.readers.layout import shorten
from asp_env.errors import DataError

MOVES_ABOVE_MPS = 2.0
"""Slower motion is not compared: noise of positions would dominate. Chosen by hand."""

DRIVES_ABOVE_MPS = 3.0
"""No vehicle drives backwards faster than this: above it, the heading is the direction of motion.
Chosen by hand."""

SPAN_S = 0.4
"""Motion is measured over this time, which averages the noise of positions. Chosen by hand."""

STEADY_ABOVE = 0.3
"""Motion of a track is compared if the mean of its motion above `MOVES_ABOVE_MPS` is at least this
share of its mean speed: positions of a vehicle that stands may jump, but come back. Chosen by
hand."""

SAME_SPEED = 1.15
"""A track's speed agrees with its motion if their ratio is below this and above its inverse. Chosen
by hand: smoothed positions and speeds differ by a few per cent."""

AGREES_ABOVE = math.cos(math.radians(30.0))
"""Mean cosine of the angle between two directions of a track that agree. Chosen by hand."""

CONTRADICTS_BELOW = math.cos(math.radians(60.0))
"""Mean cosine of the angle between two directions of a track that contradict. Chosen by hand."""

MIN_WRONG_SHARE = 0.2
"""Where one convention explains all headings, this share of contradictions is a fault of the file.
Chosen by hand: on a road along x, half of the headings in radians look like degrees."""

EXPLAINED_SHARE = 0.95
"""A convention explains the headings if so many tracks agree. Chosen by hand: trackers err."""

FACTORS: Mapping[str, float] = {
    "velocities in km/h": 3.6,
    "velocities in mph": 1 / 0.44704,
    "velocities in feet per second": 1 / 0.3048,
    "positions in feet": 0.3048,
    "positions in centimetres": 0.01,
    "positions in millimetres": 0.001,
    "positions in kilometres": 1000.0,
}
"""What makes velocities this many times the motion of the positions."""

DEGREES = (5e4, 2e5)
"""Ratios of velocities to the motion of positions in degrees: a degree has 111 km, of longitude
less."""

Angles = Float[np.ndarray, " fast"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Motion:
    """Positions and velocities in the middle of spans of `SPAN_S`, for the rows that have one."""

    row: Int[np.ndarray, " spans"]
    """The row in the middle of each span."""
    track: Int[np.ndarray, " spans"]
    moved: Float[np.ndarray, "spans 2"]
    """Velocity that follows from the positions, m/s."""


def motion_of(
    tracks: Int[np.ndarray, " rows"],
    frames: Int[np.ndarray, " rows"],
    positions: Float[np.ndarray, "rows 2"],
    rate_hz: float,
) -> Motion:
    """The motion of positions, without tracks that lead nowhere (`STEADY_ABOVE`).

    Args:
        tracks: track of each row. Rows are sorted by track, then frame.
        frames: frame of each row.
        positions: metres.
        rate_hz: frames per second.
    """
    half = max(round(0.5 * SPAN_S * rate_hz), 1)
    first = np.arange(max(len(tracks) - 2 * half, 0))
    last = first + 2 * half
    whole = (tracks[first] == tracks[last]) & (frames[last] - frames[first] == 2 * half)
    first, last = first[whole], last[whole]
    moved = (positions[last] - positions[first]).astype(np.float64) * (rate_hz / (2 * half))
    _, of_id = np.unique(tracks[first], return_inverse=True)
    speeds = np.hypot(*moved.T)
    fast = moved * (speeds > MOVES_ABOVE_MPS)[:, None]
    total = np.hypot(_sums(fast[:, 0], of_id), _sums(fast[:, 1], of_id))
    steady = (total >= STEADY_ABOVE * _sums(np.hypot(*fast.T), of_id))[of_id]
    return Motion(row=(first + half)[steady], track=tracks[first][steady], moved=moved[steady])


def check_velocities(
    motion: Motion,
    velocities: Float[np.ndarray, "rows 2"],
    rate_hz: float,
    source: str,
    rate_source: str,
) -> list[str]:
    """Compares velocities with the motion of the positions.

    Args:
        motion: that of the positions.
        velocities: those of the file, m/s.
        rate_hz: frames per second.
        source: the file, for error messages.
        rate_source: the file with the frame rate.

    Returns:
        A line for a report if the velocities of some moving tracks contradict their motion.

    Raises:
        DataError: those of most moving tracks do.
    """
    given = velocities[motion.row].astype(np.float64)
    speeds, moved = np.hypot(*given.T), np.hypot(*motion.moved.T)
    moves = (moved > MOVES_ABOVE_MPS) | (speeds > MOVES_ABOVE_MPS)
    ids, of_id = np.unique(motion.track[moves], return_inverse=True)
    if not len(ids):
        return []
    given, along = given[moves], motion.moved[moves]
    ratios = _sums(speeds[moves], of_id) / np.maximum(_sums(moved[moves], of_id), 1e-9)
    cosines = _mean_cosines(given, along, of_id)
    scaled = (ratios > SAME_SPEED) | (ratios < 1 / SAME_SPEED)
    wrong = scaled | (cosines < CONTRADICTS_BELOW)
    count = int(wrong.sum())
    turned: dict[str, Float[np.ndarray, "n 2"]] = {
        "the signs are reversed": -given,
        "the columns are exchanged": given[:, ::-1],
        "y points down in positions or in velocities": given * np.array([1.0, -1.0]),
    }
    hints = [
        what
        for what, vectors in turned.items()
        if (_mean_cosines(vectors, along, of_id) > AGREES_ABOVE).mean() >= EXPLAINED_SHARE
    ]
    begin = f"{source}: xVelocity and yVelocity of {count} of {len(ids)} moving tracks are"
    if 2 * scaled.sum() > len(ids):
        ratio = float(np.median(ratios[scaled]))
        raise DataError(
            f"{begin} {ratio:.3g} times the motion of xCenter and yCenter, expected the same"
            f"{_ratio_hint(ratio, rate_hz)}: convert the columns to metres and m/s, or correct "
            f"frameRate ({rate_hz:g}) in {rate_source}"
        )
    if 2 * count > len(ids) or (count >= MIN_WRONG_SHARE * len(ids) and hints):
        hint = f" ({', or '.join(hints)})" if hints else ""
        raise DataError(
            f"{begin} in another direction than the motion of xCenter and yCenter{hint}; expected "
            "velocities along the axes of the positions, y up: correct the columns"
        )
    return [_of_some("velocities contradict the motion", ids[wrong])] if count else []


HIGHEST_MPS = 1e9
"""Speeds above are as wrong as this one, whose ratios to slow motion are finite."""


def check_speeds(
    motion: Motion, speeds_mps: Float[np.ndarray, " rows"], rate_hz: float, source: str
) -> list[str]:
    """Compares speeds that are not used with the motion of the positions.

    Args:
        motion: that of the positions.
        speeds_mps: those of the file; NaN where they are unknown.
        rate_hz: frames per second.
        source: the file, for error messages.

    Returns:
        A line for a report if the speeds of most moving tracks contradict their motion.

    Raises:
        DataError: they do by a factor that only positions in other units than metres explain.
    """
    speeds = np.minimum(speeds_mps[motion.row], HIGHEST_MPS)
    moved = np.hypot(*motion.moved.T)
    moves = np.isfinite(speeds) & ((moved > MOVES_ABOVE_MPS) | (speeds > MOVES_ABOVE_MPS))
    ids, of_id = np.unique(motion.track[moves], return_inverse=True)
    if not len(ids):
        return []
    ratios = _sums(speeds[moves], of_id) / np.maximum(_sums(moved[moves], of_id), 1e-9)
    wrong = (ratios > SAME_SPEED) | (ratios < 1 / SAME_SPEED)
    if 2 * wrong.sum() <= len(ids):
        return []
    ratio = float(np.median(ratios[wrong]))
    what = (
        f"the speeds of {int(wrong.sum())} of {len(ids)} moving tracks are {ratio:.3g} times the "
        f"motion of the positions{_ratio_hint(ratio, rate_hz)}"
    )
    if DEGREES[0] <= ratio <= DEGREES[1]:
        raise DataError(f"{source}: {what}; expected metres: convert the columns to metres")
    return [f"{what}: speeds are derived from the positions, which have to be metres"]


def check_headings(
    motion: Motion, headings: Float[np.ndarray, " rows"], source: str, *, unit: str
) -> list[str]:
    """Compares headings of vehicles with the direction of their motion.

    Args:
        motion: that of the positions of vehicles.
        headings: those of the file, in radians, converted from its unit; NaN where unknown.
        source: the file, for error messages.
        unit: the layout's unit, `degrees` or `radians`.

    Returns:
        A line for a report if some vehicles head against their motion.

    Raises:
        DataError: most do, or many do and one convention explains all headings.
    """
    found = _contradictions(motion, headings)
    if found is None:
        return []
    ids, wrong, _, _ = found
    share = float(wrong.mean())
    names = explaining(motion, headings, unit=unit, folded=True)
    if share > 0.5 or (share >= MIN_WRONG_SHARE and names):
        raise _headings_error(source, int(wrong.sum()), len(ids), names, unit)
    return [_of_some("headings contradict the motion", ids[wrong])] if wrong.any() else []


def contradicting_share(motion: Motion, headings: Float[np.ndarray, " rows"]) -> float:
    """Share of the fast vehicles whose headings contradict their motion, either end in front."""
    found = _contradictions(motion, headings)
    if found is None:
        return 0.0
    _, _, course, of_id = found
    given = headings[motion.row[_drives(motion, headings)]]
    return float((_mean(np.abs(np.cos(given - course)), of_id) < CONTRADICTS_BELOW).mean())


def check_conventions(
    motion: Motion, headings: Float[np.ndarray, " rows"], source: str, *, unit: str
) -> None:
    """As `check_headings`, where headings only state which end of a vehicle is its front.

    Raises:
        DataError: many headings contradict the motion, and one convention explains all of them.
    """
    found = _contradictions(motion, headings)
    if found is None:
        return
    ids, wrong, _, _ = found
    if wrong.mean() >= MIN_WRONG_SHARE and (
        names := explaining(motion, headings, unit=unit, folded=False)
    ):
        raise _headings_error(source, int(wrong.sum()), len(ids), names, unit)


def explaining(
    motion: Motion, headings: Float[np.ndarray, " rows"], *, unit: str, folded: bool
) -> list[str]:
    """Names of the conventions under which all headings agree with the motion.

    Args:
        motion: that of the positions of vehicles.
        headings: those of the file, in radians, converted from `unit`.
        unit: the layout's unit, `degrees` or `radians`.
        folded: whether headings of the rear, or of either end, are conventions to name as well.
    """
    found = _contradictions(motion, headings)
    if found is None:
        return []
    _, _, course, of_id = found
    given = headings[motion.row[_drives(motion, headings)]]
    other, factor = (
        ("in radians", 180.0 / math.pi) if unit == "degrees" else ("in degrees", math.pi / 180.0)
    )
    axes: dict[str, Callable[[Angles], Angles]] = {
        "": lambda angle: angle,
        "clockwise from +x (or y of the positions points down)": lambda angle: -angle,
        "clockwise from north (+y)": lambda angle: 0.5 * math.pi - angle,
        "counter-clockwise from north (+y)": lambda angle: angle + 0.5 * math.pi,
    }
    if folded:
        axes["of the rear (turned by 180°)"] = lambda angle: angle + math.pi

    def agrees(angles: Angles) -> bool:
        similar = _mean(np.cos(angles - course), of_id) > AGREES_ABOVE
        return bool(similar.mean() >= EXPLAINED_SHARE)

    for prefix, scale in (("", 1.0), (other, factor)):
        names = [
            " and ".join(part for part in (prefix, name) if part)
            for name, turn in axes.items()
            if (prefix or name) and agrees(turn(scale * given))
        ]
        if names:
            return names
    either = _mean(np.abs(np.cos(given - course)), of_id) > AGREES_ABOVE
    if folded and either.mean() >= EXPLAINED_SHARE:
        return ["of either end (folded into ±90°)"]
    return []


def _headings_error(
    source: str, wrong: int, total: int, names: Sequence[str], unit: str
) -> DataError:
    hint = f": they are {', or '.join(names)}" if names else ""
    return DataError(
        f"{source}: the headings of {wrong} of {total} moving vehicles contradict their motion"
        f"{hint}; expected {unit} counter-clockwise from +x: convert the column"
    )


def _drives(motion: Motion, headings: Float[np.ndarray, " rows"]) -> Bool[np.ndarray, " spans"]:
    fast = np.hypot(*motion.moved.T) > DRIVES_ABOVE_MPS
    return np.asarray(fast & np.isfinite(headings[motion.row]))


def _contradictions(
    motion: Motion, headings: Float[np.ndarray, " rows"]
) -> tuple[np.ndarray, Bool[np.ndarray, " ids"], Angles, Int[np.ndarray, " fast"]] | None:
    """Tracks, whether they contradict; course and number of the track of each fast span."""
    fast = _drives(motion, headings)
    ids, of_id = np.unique(motion.track[fast], return_inverse=True)
    if not len(ids):
        return None
    course = np.arctan2(motion.moved[fast, 1], motion.moved[fast, 0])
    similar = _mean(np.cos(headings[motion.row[fast]] - course), of_id)
    return ids, np.asarray(similar < CONTRADICTS_BELOW), course, of_id


def _sums(values: np.ndarray, of_id: np.ndarray) -> np.ndarray:
    return np.bincount(of_id, weights=values)


def _mean(values: np.ndarray, of_id: np.ndarray) -> np.ndarray:
    return _sums(values, of_id) / np.bincount(of_id)


def _mean_cosines(
    given: Float[np.ndarray, "n 2"], moved: Float[np.ndarray, "n 2"], of_id: np.ndarray
) -> np.ndarray:
    """Mean cosine of the angle between two vectors, by track; 1 where either is 0."""
    lengths = np.hypot(*given.T) * np.hypot(*moved.T)
    cosines = np.where(lengths > 0, (given * moved).sum(-1) / np.maximum(lengths, 1e-12), 1.0)
    return _mean(cosines, of_id)


def _ratio_hint(ratio: float, rate_hz: float) -> str:
    known = {**FACTORS, "velocities in metres per frame": 1 / rate_hz}
    hints = [what for what, factor in known.items() if abs(ratio / factor - 1) < 0.05]
    if DEGREES[0] <= ratio <= DEGREES[1]:
        hints.append("positions in degrees")
    if not hints and ratio > 0 and 1.0 <= rate_hz * ratio <= 250.0:
        hints.append(f"as at {rate_hz * ratio:.4g} Hz, or positions in pixels")
    return f" ({', or '.join(hints)})" if hints else ""


def _of_some(what: str, ids: np.ndarray) -> str:
    names = shorten([str(track) for track in ids.tolist()])
    return f"{what} of {len(ids)} tracks: {names}"
