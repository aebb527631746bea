"""`XX_tracks.csv` and `XX_tracksMeta.csv` into one table of tracks."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from asp_env.data.classes import FOOTPRINTS_M, VULNERABLE, parse_class
from asp_env.data.readers.levelx import LevelxFiles
from asp_env.data.readers.osm import shorten
from asp_env.data.readers.tables import (
    Kind,
    find_line,
    read_columns,
    read_table,
)
from asp_env.dynamics import wrap_angle
from asp_env.errors import DataError

MOVES_MPS = 0.3
"""Above this the direction of motion is a vulnerable road user's heading."""

_META: Mapping[str, Kind] = {
    "trackId": "whole",
    "initialFrame": "whole",
    "finalFrame": "whole",
    "width": "number",
    "length": "number",
    "class": "text",
}
_TRACKS: Mapping[str, Kind] = {
    "trackId": "whole",
    "frame": "whole",
    "xCenter": "number",
    "yCenter": "number",
    "heading": "number",
    "xVelocity": "number",
    "yVelocity": "number",
    "width": "number",
    "length": "number",
}
_MEASURED = ("xCenter", "yCenter", "heading", "xVelocity", "yVelocity")


@dataclass(frozen=True, slots=True, kw_only=True)
class TrackTable:
    """The columns of a `Recording` that come from its tracks, and what had to be mended."""

    track_ids: Int[np.ndarray, " tracks"]
    classes: Int[np.ndarray, " tracks"]
    sizes: Float[np.ndarray, "tracks 2"]
    first_frames: Int[np.ndarray, " tracks"]
    starts: Int[np.ndarray, " tracks+1"]
    states: Float[np.ndarray, "rows 4"]
    repairs: tuple[str, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class _Rows:
    """Rows sorted by track, then frame."""

    track: Int[np.ndarray, " rows"]
    frame: Int[np.ndarray, " rows"]
    measured: Float[np.ndarray, "rows 5"]
    """x, y, heading in degrees, velocity along x and y."""
    sizes: Float[np.ndarray, "rows 2"]


def read_tracks(files: LevelxFiles) -> TrackTable:
    """Reads a recording's tracks.

    Vehicles keep the file's heading; their speed is the velocity's, negative when they back up.
    Vulnerable road users head where they move; below 0.3 m/s they keep the heading they had, and
    before they first move the file's. Their speed is the size of the velocity.
    A track with a gap in its frames is split there: what follows gets an id of its own.

    Raises:
        DataError: a file is damaged, or the two disagree on which tracks there are.
    """
    meta = read_table(files.tracks_meta, _META)
    ids = meta["trackId"]
    if len(np.unique(ids)) < len(ids):
        values, counts = np.unique(ids, return_counts=True)
        twice = int(values[counts > 1][0])
        line = find_line(files.tracks_meta, {"trackId": twice}, occurrence=2)
        raise DataError(
            f"{files.tracks_meta}, line {line}: track {twice} is listed twice, expected once; "
            "remove one of the two"
        )
    order = np.argsort(ids)
    classes = _classes(files, meta["class"])[order]
    rows = _read_rows(files)
    _check_ids(files, rows, ids[order])
    repairs: list[str] = []
    begins = np.flatnonzero(np.diff(rows.track, prepend=rows.track[0] - 1))
    _compare_frames(rows, begins, meta, order, repairs)
    sizes = _sizes(rows.sizes[begins], meta, order, classes)

    splits = np.flatnonzero((np.diff(rows.track) == 0) & (np.diff(rows.frame) > 1)) + 1
    starts = np.union1d(begins, splits)
    owner = np.searchsorted(ids[order], rows.track[starts])
    new_ids = ids[order][owner]
    fresh = np.isin(starts, splits)
    new_ids[fresh] = ids.max() + 1 + np.arange(fresh.sum())
    if len(splits):
        told = [f"{rows.track[at]} after frame {rows.frame[at - 1]}" for at in splits]
        repairs.append(f"{len(splits)} gaps in tracks' frames, split there: {shorten(told)}")
    by_id = np.argsort(new_ids, kind="stable")
    vulnerable = np.isin(classes, [int(kind) for kind in VULNERABLE])
    return _assemble(rows, starts, by_id, new_ids, owner, classes, sizes, vulnerable, repairs)


def _assemble(
    rows: _Rows,
    starts: Int[np.ndarray, " tracks"],
    by_id: Int[np.ndarray, " tracks"],
    new_ids: Int[np.ndarray, " tracks"],
    owner: Int[np.ndarray, " tracks"],
    classes: Int[np.ndarray, " metas"],
    sizes: Float[np.ndarray, "metas 2"],
    vulnerable: Bool[np.ndarray, " metas"],
    repairs: list[str],
) -> TrackTable:
    lengths = np.diff(starts, append=len(rows.track))
    states = states_of(
        rows.measured, np.repeat(starts, lengths), np.repeat(vulnerable[owner], lengths)
    )
    if (np.diff(by_id) < 0).any():
        ends = starts + lengths
        states = np.concatenate([states[starts[track] : ends[track]] for track in by_id])
    return TrackTable(
        track_ids=new_ids[by_id],
        classes=classes[owner][by_id],
        sizes=sizes[owner][by_id],
        first_frames=rows.frame[starts][by_id].astype(np.int64),
        starts=np.concatenate([[0], np.cumsum(lengths[by_id])]).astype(np.int64),
        states=states,
        repairs=tuple(repairs),
    )


def states_of(
    measured: Float[np.ndarray, "rows 5"],
    first_row: Int[np.ndarray, " rows"],
    vulnerable: Bool[np.ndarray, " rows"],
) -> Float[np.ndarray, "rows 4"]:
    """The states of a recording's rows.

    Vulnerable road users head where they move, from the past alone; vehicles' speeds have the
    sign of motion along the heading.

    Args:
        measured: x, y, heading in degrees, velocity along x and y.
        first_row: of each row, the first of its track.
        vulnerable: which rows are of vulnerable road users.
    """
    heading = np.radians(measured[:, 2])
    velocity_x, velocity_y = measured[:, 3], measured[:, 4]
    total = np.hypot(velocity_x, velocity_y)
    moves = vulnerable & (total > MOVES_MPS)
    row = np.arange(len(measured))
    last_moving = np.maximum.accumulate(np.where(moves, row, -1))
    known = vulnerable & (last_moving >= first_row)
    course = np.arctan2(velocity_y, velocity_x)
    heading = np.where(known, course[last_moving], heading)
    along = velocity_x * np.cos(heading) + velocity_y * np.sin(heading)
    # the bicycle's speed is that of the box's centre, which slips sideways in bends
    speed = np.where(vulnerable, total, np.copysign(total, along))
    states = np.stack([measured[:, 0], measured[:, 1], wrap_angle(heading), speed], axis=-1)
    return states.astype(np.float32)


def _classes(files: LevelxFiles, names: np.ndarray) -> Int[np.ndarray, " metas"]:
    numbers = {}
    for name in dict.fromkeys(names):
        try:
            numbers[name] = int(parse_class(str(name)))
        except DataError as error:
            line = find_line(files.tracks_meta, {"class": str(name)})
            raise DataError(f"{files.tracks_meta}, line {line}: {error}") from None
    return np.array([numbers[name] for name in names], dtype=np.int8)


def _read_rows(files: LevelxFiles) -> _Rows:
    track, frame, measured, sizes = [], [], [], []
    optional = frozenset({"width", "length"})
    for chunk in read_columns(files.tracks, _TRACKS, optional=optional):
        track.append(chunk["trackId"].astype(np.int32))
        frame.append(chunk["frame"].astype(np.int32))
        measured.append(np.stack([chunk[name] for name in _MEASURED], axis=-1).astype(np.float32))
        unknown = np.zeros(len(chunk["frame"]))
        both = [chunk.get("length", unknown), chunk.get("width", unknown)]
        sizes.append(np.stack(both, axis=-1).astype(np.float32))
    rows = _Rows(
        track=np.concatenate(track),
        frame=np.concatenate(frame),
        measured=np.concatenate(measured),
        sizes=np.concatenate(sizes),
    )
    return _sorted(files, rows)


def _sorted(files: LevelxFiles, rows: _Rows) -> _Rows:
    step, later = np.diff(rows.track), np.diff(rows.frame)
    if not ((step > 0) | ((step == 0) & (later > 0))).all():
        order = np.lexsort((rows.frame, rows.track))
        rows = _Rows(
            track=rows.track[order],
            frame=rows.frame[order],
            measured=rows.measured[order],
            sizes=rows.sizes[order],
        )
        same = (np.diff(rows.track) == 0) & (np.diff(rows.frame) == 0)
        if same.any():
            at = int(same.argmax())
            values = {"trackId": int(rows.track[at]), "frame": int(rows.frame[at])}
            line = find_line(files.tracks, values, occurrence=2)
            raise DataError(
                f"{files.tracks}, line {line}: a second row for track {values['trackId']} at frame "
                f"{values['frame']}, expected one; remove one of the two"
            )
    if rows.frame.min() < 0:
        first = int(rows.frame.min())
        line = find_line(files.tracks, {"frame": first})
        raise DataError(f"{files.tracks}, line {line}: frame is {first}, expected 0 or more")
    return rows


def _check_ids(files: LevelxFiles, rows: _Rows, ids: Int[np.ndarray, " metas"]) -> None:
    there = np.unique(rows.track)
    strangers = np.setdiff1d(there, ids)
    if len(strangers):
        line = find_line(files.tracks, {"trackId": int(strangers[0])})
        raise DataError(
            f"{files.tracks}, line {line}: track {strangers[0]} is not in "
            f"{files.tracks_meta.name}, expected each of its tracks there; "
            "the files are of different recordings or damaged"
        )
    absent = np.setdiff1d(ids, there)
    if len(absent):
        line = find_line(files.tracks_meta, {"trackId": int(absent[0])})
        raise DataError(
            f"{files.tracks}: has no row for {len(absent)} tracks of {files.tracks_meta.name}, "
            f"the first being {absent[0]} (line {line} there); the file is cut: copy it again"
        )


def _compare_frames(
    rows: _Rows,
    begins: Int[np.ndarray, " metas"],
    meta: Mapping[str, np.ndarray],
    order: Int[np.ndarray, " metas"],
    repairs: list[str],
) -> None:
    last = np.append(begins[1:], len(rows.frame)) - 1
    differ = (rows.frame[begins] != meta["initialFrame"][order]) | (
        rows.frame[last] != meta["finalFrame"][order]
    )
    if differ.any():
        told = [str(track) for track in rows.track[begins][differ]]
        repairs.append(
            f"{len(told)} tracks begin or end at another frame than tracksMeta says: "
            f"{shorten(told)}"
        )


def _sizes(
    in_rows: Float[np.ndarray, "metas 2"],
    meta: Mapping[str, np.ndarray],
    order: Int[np.ndarray, " metas"],
    classes: Int[np.ndarray, " metas"],
) -> Float[np.ndarray, "metas 2"]:
    """The rows' sizes, where they are zero the metadata's, where these are the class's."""
    in_meta = np.stack([meta["length"], meta["width"]], axis=-1)[order].astype(np.float32)
    sizes = np.where((in_rows > 0).all(axis=-1, keepdims=True), in_rows, in_meta)
    return np.where((sizes > 0).all(axis=-1, keepdims=True), sizes, FOOTPRINTS_M[classes])
