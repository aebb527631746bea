"""INTERACTION 1.2: tables of many cases, each an episode of some seconds with clocks of its own.

A table such as `train/DR_CHN_Merging_ZS0_train.csv` has the columns of the INTERACTION layout,
vehicles and pedestrians together, and `case_id`. Each case is a recording,
`DR_CHN_Merging_ZS0_train/1`. The map is `maps/DR_CHN_Merging_ZS0.osm` or `.osm_xy`. A table is read
once, for all of its cases.
"""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from asp_env.data.readers.caching import CacheEntry, cached
from asp_env.data.readers.compressed import CSV
from asp_env.data.readers.interaction import (
    OPTIONAL_TRACKS,
    TRACKS,
    InteractionMeta,
    find_site_map,
    measurements_of,
    read_measurements,
)
from asp_env.data.readers.layout import ClassNames, TrackTable, natural_key, walk
from asp_env.data.readers.measurements import derive_tracks
from asp_env.data.readers.positions import Origin
from asp_env.data.readers.ranges import Limit
from asp_env.data.readers.tables import (
    EXACT,
    Kind,
    find_line,
    has_columns,
    number_texts,
    read_table,
)
from asp_env.errors import DataError
from asp_env.stored import brief

_TABLE = re.compile(rf"^(.+?)(?:_(?:train|val|test|obs))?{CSV}$", re.IGNORECASE)
_NEEDED = ("case_id", "track_id", "timestamp_ms", "agent_type", "x", "y")
_LIMITS = {"case_id": Limit(largest=float(EXACT - 1), unit="a number")}
_CASES: Mapping[str, Kind] = {"case_id": "number", **TRACKS, "track_id": "text"}
_COLUMNS = ("track_ids", "classes", "sizes", "first_frames")


@dataclass(frozen=True, slots=True, kw_only=True)
class CaseFiles:
    """One case of a table."""

    name: str
    root: Path
    """The folder given as DATA. Maps are searched from the table's folder up to it."""
    location: str
    case: float | None
    """The case's id; None if the table's cases cannot be listed."""
    tracks: Path

    @property
    def tables(self) -> tuple[Path, ...]:
        """The table."""
        return (self.tracks,)

    @property
    def background(self) -> None:
        """None: this layout has no background images."""
        return

    def place(self, maps_by_folder: dict[Path, list[Path]]) -> tuple[InteractionMeta, Path]:
        """Metadata and the path of the map.

        Raises:
            DataError: there is no map.
        """
        meta = InteractionMeta(
            location=self.location,
            location_id=self.location,
            speed_limit_mps=None,
            origin=Origin.at(latitude_deg=0.0, longitude_deg=0.0),
        )
        return meta, find_site_map(
            self.tracks.parent, self.root, [self.location], self.name, maps_by_folder
        )


def find_recordings(root: Path) -> tuple[CaseFiles, ...]:
    """The cases of the tables in and below a folder, in natural order of names.

    The cases of a table are listed at its first use, and cached. A table that is damaged is one
    recording, which cannot be read.
    """
    found = []
    for folder, names in walk(root):
        for name in names:
            match = _TABLE.match(name)
            if match is None or not has_columns(folder / name, _NEEDED):
                continue
            path, prefix = folder / name, re.sub(rf"{CSV}$", "", name, flags=re.IGNORECASE)
            try:
                _, arrays = cached(path, [path], lambda path=path: _list_cases(path), "case ids")
                cases: list[float | None] = arrays["case_ids"].tolist()
            except DataError:
                cases = [None]
            found += [
                CaseFiles(
                    name=prefix if case is None else f"{prefix}/{_shown(case)}",
                    root=root,
                    location=match[1],
                    case=case,
                    tracks=path,
                )
                for case in cases
            ]
    return tuple(sorted(found, key=lambda files: natural_key(files.name)))


def read_case(files: CaseFiles, tables: dict[Path, CacheEntry]) -> tuple[TrackTable, float]:
    """The tracks of a case, and the frames per second.

    Args:
        files: the case.
        tables: tables that are already read. The case's table is added.

    Raises:
        DataError: the table or the case is damaged.
    """
    path = files.tracks
    if path not in tables:
        tables[path] = cached(path, [path], lambda: _read_cases(path), "cases")
    facts, arrays = tables[path]
    number = int(np.flatnonzero(arrays["case_ids"] == files.case)[0])
    about: dict[str, Any] = facts["cases"][number]
    if "fault" in about:
        raise DataError(about["fault"])
    first, end = arrays["case_tracks"][number : number + 2]
    starts = arrays["starts"][first : end + 1]
    rows = slice(starts[0], starts[-1])
    table = TrackTable(
        **_columns_of(arrays, int(first), int(end)),
        starts=starts - starts[0],
        states=arrays["states"][rows],
        repairs=tuple(about["repairs"]),
        resampled_from_hz=about["resampled_from_hz"],
    )
    return table, about["rate_hz"]


def _columns_of(arrays: Mapping[str, np.ndarray], first: int, end: int) -> dict[str, Any]:
    return {name: arrays[name][first:end] for name in _COLUMNS}


def _shown(case: float) -> str:
    """A case's id in the name of its recording: all digits, so that names differ as ids do."""
    return str(int(case)) if case == int(case) else repr(float(case))


def _list_cases(path: Path) -> CacheEntry:
    table = read_table(path, {"case_id": "number"}, limits=_LIMITS)
    return {}, {"case_ids": np.unique(table["case_id"])}


def _read_cases(path: Path) -> CacheEntry:
    names = ClassNames()
    columns = read_measurements(path, names, _CASES, optional=OPTIONAL_TRACKS, limits=_LIMITS)
    if not len(columns["track_id"]):
        raise DataError(f"{path}: has a header but no rows; copy it again or remove the recording")
    ids = number_texts(columns["track_id"])
    columns["track_id"] = ids.numbers
    of_table = (*names.repairs(), *ids.repairs)
    order = np.argsort(columns["case_id"], kind="stable")
    columns = {name: cells[order] for name, cells in columns.items()}
    measurements = measurements_of(columns)
    case_ids, begins = np.unique(columns["case_id"], return_index=True)
    cases, tables = [], []
    for case, begin, end in zip(case_ids, begins, [*begins[1:], len(order)], strict=True):

        def located(
            track: int, time_ms: float, occurrence: int, what: str, case: float = float(case)
        ) -> str:
            cells = {"case_id": case, "track_id": ids.texts[track]}
            line = find_line(path, {**cells, "timestamp_ms": time_ms}, occurrence=occurrence)
            text = what.format(track=brief(cells["track_id"]), time=f"{time_ms:g}")
            return f"{path}, line {line}: case {_shown(case)}: {text}"

        rows = measurements.select(np.arange(begin, end))
        try:
            table, rate_hz = derive_tracks(rows, f"{path}, case {_shown(case)}", located)
        except DataError as error:
            cases.append({"fault": str(error)})
        else:
            repairs = [*(of_table if case == case_ids[0] else ()), *table.repairs]
            cases.append(
                {
                    "rate_hz": rate_hz,
                    "resampled_from_hz": table.resampled_from_hz,
                    "repairs": repairs,
                }
            )
            tables.append(table)
    counts = np.zeros(len(cases), dtype=np.int64)
    counts[["fault" not in case for case in cases]] = [len(table.track_ids) for table in tables]
    lengths = [np.diff(table.starts) for table in tables] or [np.zeros(0, dtype=np.int64)]
    arrays: dict[str, np.ndarray] = {
        name: np.concatenate([getattr(table, name) for table in tables] or [np.zeros(0)])
        for name in (*_COLUMNS, "states")
    }
    arrays["starts"] = np.concatenate([[0], np.cumsum(np.concatenate(lengths))]).astype(np.int64)
    arrays["case_ids"] = case_ids
    arrays["case_tracks"] = np.concatenate([[0], np.cumsum(counts)])
    return {"cases": cases}, arrays
