"""CSV tables: columns by name, the exact line of every fault, and frames from time stamps."""

import csv
import itertools
import math
import re
import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from decimal import Decimal
from pathlib import Path
from typing import Literal

import numpy as np
import pandas as pd
from jaxtyping import Bool, Float, Int

from asp_env.data.readers.compressed import open_table
from asp_env.data.readers.layout import check_content
from asp_env.data.readers.ranges import Limit
from asp_env.errors import DataError
from asp_env.stored import brief

Kind = Literal["id", "whole", "number", "number or empty", "text"]
"""What the cells of a column must be: whole numbers of any size, whole numbers below `EXACT`,
finite numbers, finite numbers or nothing (which is read as NaN), or any text."""

WHOLE = ("id", "whole")
"""Kinds of whole numbers."""

EMPTY = ("", "NaN", "nan", "NA", "N/A", "null", "None")
"""Texts of cells that contain nothing."""

EXACT = 2**53
"""Whole numbers below are exact in double precision, in which cells are parsed."""

ROWS_PER_CHUNK = 250_000
"""Rows that are parsed at a time, which bounds memory. Chosen by hand."""

LOWEST_HZ = 1.0
HIGHEST_HZ = 250.0
"""Frame rates outside of this range indicate times that are not in milliseconds."""

ROUNDING_MS = 1.0
"""Error of a time, since times are whole milliseconds."""

JITTER = 0.3
"""Error of a step between two times in addition, as a share of a frame. Chosen by hand: above the
jitter of cameras, below half a frame."""

WHOLE_WITHIN = 0.01
"""Jittering times are read at a whole number of frames per second if their mean rate differs by
less than this share. Chosen by hand."""

_BLOCK_BYTES = 1 << 22
_UTF16 = (b"\xff\xfe", b"\xfe\xff")
_DTYPES = {"id": np.int64, "whole": np.int64, "number": np.float64, "number or empty": np.float64}


@dataclass(frozen=True, slots=True, kw_only=True)
class Clock:
    """The frame of each row, and the frame rate."""

    frames: Int[np.ndarray, " rows"]
    """Frames, counted from the earliest row."""
    rate_hz: float
    jittering: Float[np.ndarray, " rows"] | None = None
    """Time of each row in frames, where times deviate from the frames by more than rounding."""
    mean_hz: float | None = None
    """Mean frame rate of jittering times."""

    @property
    def step_s(self) -> float:
        """Seconds between two frames."""
        return 1.0 / self.rate_hz


def read_columns(
    path: Path,
    columns: Mapping[str, Kind],
    *,
    optional: frozenset[str] = frozenset(),
    limits: Mapping[str, Limit] = {},
    may_be_empty: bool = False,
) -> Iterator[dict[str, np.ndarray]]:
    """Reads columns of a CSV file (plain, `.gz` or `.xz`), a chunk of rows at a time.

    Args:
        path: the file. Its first line names the columns, in any order, in upper or lower case.
        columns: kind of the cells of each column to read.
        optional: those of `columns` that may be absent.
        limits: plausible ranges by column.
        may_be_empty: whether a file without rows is valid; it yields nothing.

    Yields:
        Arrays (rows,) by name: int64, float64 or str objects. Ids of which one is `EXACT` or more
        are objects of type int, see `number_ids`.

    Raises:
        DataError: the file is missing, damaged or without rows. The message names the line, if a
            single line is wrong.
    """
    try:
        header = header_of(path)
        present = _present(path, header, columns, optional)
        if not _has_even_rows(path, len(header)):
            _diagnose(path, header, present, limits)
        any_rows = False
        for chunk in _chunks(path, header, present, limits):
            any_rows = True
            yield chunk
        if not (any_rows or may_be_empty):
            raise DataError(
                f"{path}: has a header but no rows; copy it again or remove the recording"
            )
    except (pd.errors.ParserError, ValueError) as error:
        if isinstance(error, DataError):
            raise
        header = header_of(path)
        _diagnose(path, header, _present(path, header, columns, frozenset(columns)), limits)
        raise DataError(f"{path}: cannot be read as a table: {_one_line(error)}") from error
    except (OSError, EOFError, zlib.error) as error:
        raise DataError(f"{path}: cannot be read: {_one_line(error)}; copy it again") from error


def read_table(
    path: Path,
    columns: Mapping[str, Kind],
    *,
    optional: frozenset[str] = frozenset(),
    limits: Mapping[str, Limit] = {},
) -> dict[str, np.ndarray]:
    """Reads columns of a CSV file at once; see `read_columns`.

    Raises:
        DataError: see `read_columns`.
    """
    chunks = list(read_columns(path, columns, optional=optional, limits=limits))
    return {name: np.concatenate([chunk[name] for chunk in chunks]) for name in chunks[0]}


@dataclass(frozen=True, slots=True, kw_only=True)
class NumberedIds:
    """Ids of any size as numbers of 64 bits."""

    columns: tuple[Int[np.ndarray, " _"], ...]
    """The ids of each column."""
    originals: tuple[int, ...] | None
    """The id in the files of each number; None where both are equal."""

    def original(self, number: int) -> int:
        """The id in the files."""
        return number if self.originals is None else self.originals[number]

    @property
    def repairs(self) -> list[str]:
        """A line if the numbers are not those of the files."""
        if self.originals is None:
            return []
        return [
            f"track ids of {EXACT:,} or more: all {len(self.originals)} tracks are numbered in "
            f"order of their ids, from {self.originals[0]} as 0 to {self.originals[-1]} as "
            f"{len(self.originals) - 1}"
        ]


def number_ids(*columns: np.ndarray) -> NumberedIds:
    """Converts columns of ids from `read_columns` to int64.

    They are unchanged if all are below `EXACT`. Otherwise the ids of all columns together are
    numbered in their order, from 0.
    """
    if all(column.dtype != object for column in columns):
        return NumberedIds(columns=columns, originals=None)
    known = sorted(set(itertools.chain.from_iterable(column.tolist() for column in columns)))
    numbers = {name: number for number, name in enumerate(known)}
    numbered = tuple(
        np.array([numbers[name] for name in column.tolist()], dtype=np.int64) for column in columns
    )
    return NumberedIds(columns=numbered, originals=tuple(known))


@dataclass(frozen=True, slots=True, kw_only=True)
class NumberedTexts:
    """Ids that may be any texts, as whole numbers."""

    numbers: Float[np.ndarray, " rows"]
    """The number of each id."""
    texts: dict[int, str]
    """The id in the files of each number."""
    repairs: tuple[str, ...]
    """A line if ids are numbers, but not those that they have in the files."""


def number_texts(ids: np.ndarray) -> NumberedTexts:
    """Converts ids that may be any texts to numbers.

    Whole numbers below `EXACT` stay. Other texts, such as P1, larger numbers, and texts of a
    number that another text has already, such as 01 beside 1, get numbers above these in order of
    appearance.

    Args:
        ids: (rows,) texts.
    """
    codes, known = pd.factorize(ids)
    values = np.array(pd.to_numeric(pd.Series(known), errors="coerce"), dtype=np.float64)
    is_number = np.isfinite(values)
    stays = is_number & (values == np.floor(values)) & (np.abs(values) < EXACT)
    is_first = np.zeros(len(values), dtype=bool)
    is_first[np.unique(values, return_index=True)[1]] = True
    stays &= is_first
    start = int(values[stays].max(initial=-1)) + 1
    values[~stays] = start + np.arange((~stays).sum())
    renumbered = np.flatnonzero(is_number & ~stays)
    repairs = ()
    if len(renumbered):
        example = renumbered[0]
        repairs = (
            f"{len(renumbered)} track ids are no whole numbers below {EXACT:,} or equal others: "
            f"they are numbered from {start} on, such as {known[example]} as {values[example]:g}",
        )
    texts = dict(zip(values.astype(np.int64).tolist(), map(str, known), strict=True))
    return NumberedTexts(numbers=values[codes], texts=texts, repairs=repairs)


def find_line(path: Path, cells: Mapping[str, object], *, occurrence: int = 1) -> int:
    """Finds a line by the content of some of its cells.

    Args:
        path: the file.
        cells: content by column. Numbers are compared by value.
        occurrence: which of several matching lines to find, from 1.

    Returns:
        The number of the line, from 1; 0 if there is none.
    """
    header = header_of(path)
    columns = {name: _places(header, name)[0] for name in cells}
    for number, row in itertools.islice(_lines(path), 1, None):
        if len(row) >= len(header) and all(
            _same(row[columns[name]], cells[name]) for name in cells
        ):
            occurrence -= 1
            if not occurrence:
                return number
    return 0


def read_clock(
    tracks: Int[np.ndarray, " rows"],
    times_ms: Float[np.ndarray, " rows"],
    located: Callable[[int, str], str],
) -> Clock:
    """Determines the frame of each row, and the frame rate, from the rows' times.

    A frame lasts as long as the median step between rows of a track. The rate is a whole number if
    one explains all times to the millisecond, since 30 Hz are steps of 33 and 34 ms. Times that no
    rate explains to the millisecond jitter. Where the tracks have times of their own, these have to
    be frames within each track only.

    Args:
        tracks: track of each row. Rows are sorted by track, then time.
        times_ms: time of each row, strictly increasing within a track.
        located: called with a row and a text; returns the row's file and line, followed by the
            text with `{track}` and `{time}` filled in. It begins error messages.

    Raises:
        DataError: no track has two rows, the rate is impossible, or a row lies between frames.
    """
    steps_ms = np.diff(times_ms)[np.diff(tracks) == 0]
    if not len(steps_ms):
        raise DataError(
            located(0, "no track has a second row")
            + ", so there is no frame rate; copy the file again or remove the recording"
        )
    step_ms = float(np.median(steps_ms))
    if not LOWEST_HZ <= 1000.0 / step_ms <= HIGHEST_HZ:
        raise DataError(
            located(0, "timestamp_ms of its rows")
            + f" and later rows are {step_ms:g} apart, which makes {1000.0 / step_ms:g} Hz; "
            f"expected {LOWEST_HZ:g} to {HIGHEST_HZ:g} Hz and times in milliseconds"
        )
    known_ms, inverse = np.unique(times_ms, return_inverse=True)
    since_ms = known_ms - known_ms[0]
    single = np.abs(steps_ms - step_ms) <= ROUNDING_MS + JITTER * step_ms
    step_ms = float(steps_ms[single].mean())
    whole_hz = round(1000.0 / step_ms)
    frames = np.round(since_ms * whole_hz / 1000.0)
    if np.abs(since_ms - frames * 1000.0 / whole_hz).max() <= min(ROUNDING_MS, 0.25 * step_ms):
        clock = Clock(frames=frames.astype(np.int64)[inverse], rate_hz=float(whole_hz))
        double = (np.diff(tracks) == 0) & (np.diff(clock.frames) == 0)
        if double.any():
            raise DataError(
                located(int(double.argmax()) + 1, "a second row of track {track} at {time} ms")
                + f", less than a frame of {step_ms:g} ms after the first; remove one of the two"
            )
        return clock

    counts, off = _frames_apart(np.diff(known_ms), step_ms)
    if off.any():
        counts, off_in_tracks = _frames_apart(steps_ms, step_ms)
        if not off_in_tracks.any():
            return _clock_of_each_track(tracks, times_ms, counts, step_ms)
        late = int(np.flatnonzero(times_ms == known_ms[int(off.argmax()) + 1])[0])
        raise DataError(
            located(late, "timestamp_ms is {time}")
            + f", {np.diff(known_ms)[int(off.argmax())]:g} ms after the previous time; expected "
            f"multiples of {step_ms:g} ms as between most rows: correct the line or remove it"
        )
    frames = np.concatenate([[0], np.cumsum(counts)])
    rate_hz = 1000.0 * float(frames[-1] / since_ms[-1])
    deviations_ms = np.abs(since_ms - frames * 1000.0 / rate_hz)
    mean_hz, jittering = None, None
    if deviations_ms.max() > ROUNDING_MS:
        mean_hz = rate_hz
        if abs(rate_hz - round(rate_hz)) < WHOLE_WITHIN * rate_hz:
            rate_hz = float(round(rate_hz))
        jittering = (since_ms * rate_hz / 1000.0)[inverse]
    return Clock(
        frames=frames.astype(np.int64)[inverse],
        rate_hz=rate_hz,
        jittering=jittering,
        mean_hz=mean_hz,
    )


def _frames_apart(
    steps_ms: Float[np.ndarray, " steps"], step_ms: float
) -> tuple[Float[np.ndarray, " steps"], Bool[np.ndarray, " steps"]]:
    """How many frames some steps last, and which of them are no whole number of frames."""
    apart = steps_ms / step_ms
    counts = np.round(apart)
    return counts, (counts < 1) | (np.abs(apart - counts) > JITTER + ROUNDING_MS / step_ms)


def _clock_of_each_track(
    tracks: Int[np.ndarray, " rows"],
    times_ms: Float[np.ndarray, " rows"],
    counts: Float[np.ndarray, " steps"],
    step_ms: float,
) -> Clock:
    """The clock of tracks with times of their own, which jitter or lie between those of others.

    Args:
        tracks: track of each row.
        times_ms: time of each row.
        counts: frames of each step between two rows of one track.
        step_ms: mean duration of steps of one frame.
    """
    mean_hz = 1000.0 / step_ms
    rate_hz = mean_hz
    if abs(mean_hz - round(mean_hz)) < WHOLE_WITHIN * mean_hz:
        rate_hz = float(round(mean_hz))
    jittering = (times_ms - times_ms.min()) * (rate_hz / 1000.0)
    begins = np.flatnonzero(np.diff(tracks, prepend=tracks[0] - 1))
    apart = np.zeros(len(tracks))
    apart[1:][np.diff(tracks) == 0] = counts
    since_begin = np.cumsum(apart)
    lengths = np.diff(begins, append=len(tracks))
    offset = np.round(jittering[begins]) - since_begin[begins]
    frames = since_begin + np.repeat(offset, lengths)
    return Clock(
        frames=frames.astype(np.int64), rate_hz=rate_hz, jittering=jittering, mean_hz=mean_hz
    )


def header_of(path: Path) -> list[str]:
    """The names of a table's columns, without spaces around them.

    Raises:
        DataError: the file is empty, damaged, or not a table in UTF-8 with commas.
    """
    _check_encoding(path)
    for number, row in _lines(path):
        if len(row) == 1 and (mark := next((mark for mark in ";\t|" if mark in row[0]), None)):
            raise DataError(
                f"{path}, line {number}: columns are separated by {mark!r}, expected ',', and "
                "points in decimal numbers: save it as CSV with commas"
            )
        return [name.strip() for name in row]
    raise DataError(f"{path}: is empty; expected a table with a header; copy it again")


def _check_encoding(path: Path) -> None:
    """Refuses web pages, and encodings and line ends that no table here has."""
    with open_table(path) as file:
        start = file.read(1 << 10)
    check_content(path, start)
    if start.startswith(_UTF16) or b"\0" in start[:4]:
        raise DataError(
            f"{path}: is encoded in UTF-16 or UTF-32, expected UTF-8: save it as CSV in UTF-8"
        )
    if b"\r" in start.replace(b"\r\n", b"") and b"\n" not in start:
        raise DataError(
            f"{path}: its lines end in carriage returns alone, expected line feeds: save it again "
            "with line ends of Unix or Windows"
        )


def has_columns(path: Path, names: Iterable[str]) -> bool:
    """Whether a file is a table with all of some columns, in upper or lower case.

    The columns are found in tables of another encoding or with other separators, too, so that
    reading such a table names what is wrong with it.
    """
    try:
        with open_table(path) as file:
            start = file.read(1 << 14)
    except (DataError, OSError, EOFError, zlib.error):
        return False
    text = start.replace(b"\0", b"").decode("utf-8-sig", "replace")
    if start.startswith(_UTF16):
        text = text.lstrip("\ufffd")
    line = next((line for line in text.splitlines() if line.strip()), "")
    header = {name.strip(' "\t').lower() for name in re.split(r"[,;\t|]", line)}
    return all(name.lower() in header for name in names)


def _places(header: list[str], name: str) -> list[int]:
    """Indices of the columns with a name, in upper or lower case."""
    return [index for index, given in enumerate(header) if given.lower() == name.lower()]


def _present(
    path: Path, header: list[str], columns: Mapping[str, Kind], optional: frozenset[str]
) -> dict[int, tuple[str, Kind]]:
    """Name and kind of the columns to read, by their index in the file."""
    places = {name: _places(header, name) for name in columns}
    missing = [name for name in columns if not places[name] and name not in optional]
    if missing:
        raise DataError(
            f"{path}: lacks the column {', '.join(map(repr, missing))}; "
            f"expected it among those found: {' '.join(', '.join(header).split())[:200]}; "
            "rename or add the column, in the first line of the file"
        )
    if double := next((name for name in columns if len(places[name]) > 1), None):
        numbers = " and ".join(str(index + 1) for index in places[double])
        raise DataError(
            f"{path}, line 1: columns {numbers} are called {double!r} (spaces around names and "
            "upper case are ignored), expected one; rename or remove the others"
        )
    return {places[name][0]: (name, kind) for name, kind in columns.items() if places[name]}


def _has_even_rows(path: Path, num_columns: int) -> bool:
    """Whether the number of commas fits the number of lines. Much faster than parsing."""
    commas = lines = 0
    last = b"\n"
    with open_table(path) as file:
        while block := file.read(_BLOCK_BYTES):
            commas += block.count(b",")
            lines += block.count(b"\n")
            last = block[-1:]
    return commas == (lines + (last != b"\n")) * (num_columns - 1)


def _chunks(
    path: Path,
    header: list[str],
    columns: Mapping[int, tuple[str, Kind]],
    limits: Mapping[str, Limit],
) -> Iterator[dict[str, np.ndarray]]:
    kinds = dict(columns.values())
    index_of = {name: index for index, (name, _) in columns.items()}
    for number, frame in enumerate(_frames(path, header, columns)):
        if not len(frame):
            continue
        chunk = {}
        for name, kind in kinds.items():
            cells = frame[name].to_numpy()
            if kind == "id" and EXACT <= float(np.abs(cells).max()) < math.inf:
                chunk[name] = _exact_ids(path, header, index_of[name], number)
            else:
                chunk[name] = _checked(cells, kind, limits.get(name))
        yield chunk


def _frames(
    path: Path, header: list[str], columns: Mapping[int, tuple[str, Kind]]
) -> Iterator[pd.DataFrame]:
    """The parsed chunks of a file: texts as they are, all else in double precision."""
    kinds = dict(columns.values())
    names = [columns[i][0] if i in columns else f"column {i + 1}" for i in range(len(header))]
    with (
        open_table(path) as file,
        pd.read_csv(
            file,
            header=0,
            names=names,
            usecols=list(columns),
            dtype={name: str if kind == "text" else np.float64 for name, kind in kinds.items()},
            chunksize=ROWS_PER_CHUNK,
            index_col=False,
            encoding="utf-8-sig",
            encoding_errors="replace",
            keep_default_na="text" not in kinds.values(),
            na_values={
                name: list(EMPTY) for name, kind in kinds.items() if kind == "number or empty"
            },
        ) as reader,
    ):
        yield from reader


def _exact_ids(path: Path, header: list[str], index: int, number: int) -> np.ndarray:
    """The ids of chunk `number` as objects of type int: parsed again, as texts."""
    frames = _frames(path, header, {index: ("id", "text")})
    frame = next(itertools.islice(frames, number, None))
    return np.array([_exact_id(cell) for cell in frame["id"]], dtype=object)


def _exact_id(cell: str) -> int:
    try:
        return int(cell)
    except ValueError:  # such as 5.0 and 1e20
        value = Decimal(cell)
        if not math.isfinite(float(value)) or value != value.to_integral_value():
            raise ValueError("a cell is not a whole number") from None
        return int(value)


def _checked(cells: np.ndarray, kind: Kind, limit: Limit | None) -> np.ndarray:
    if kind == "text":
        return cells.astype(object)
    may_be_nan = kind == "number or empty"
    if not (np.isfinite(cells) | (may_be_nan & np.isnan(cells))).all():
        raise ValueError("a cell is not a number")
    if kind in WHOLE and not ((cells == np.floor(cells)) & (np.abs(cells) < EXACT)).all():
        raise ValueError("a cell is not a whole number")
    if limit is not None and (np.abs(cells) > limit.largest).any():
        raise ValueError("a cell is out of range")
    return cells.astype(_DTYPES[kind])


def _diagnose(
    path: Path,
    header: list[str],
    columns: Mapping[int, tuple[str, Kind]],
    limits: Mapping[str, Limit],
) -> None:
    """Raises an error that names the first wrong line, if any. Slow: for damaged files only."""
    for number, row in itertools.islice(_lines(path), 1, None):
        if len(row) < len(header) or any(cell.strip() for cell in row[len(header) :]):
            raise DataError(
                f"{path}, line {number}: has {len(row)} fields, expected {len(header)} as in the "
                "header; the line is truncated or damaged: copy the file again"
            )
        for index, (name, kind) in columns.items():
            if expected := _expected(row[index], kind, limits.get(name)):
                more = _count_beyond(path, index, limits.get(name))
                do = "; if no id is one, number the agents in all tables" if kind == "id" else ""
                raise DataError(
                    f"{path}, line {number}: {name} is {brief(repr(row[index]))}{more}, expected "
                    f"{expected}; correct the line or remove it{do}"
                )


def _expected(cell: str, kind: Kind, limit: Limit | None) -> str:
    """What a cell should be instead; empty if it is valid."""
    if kind == "text" or (kind == "number or empty" and cell.strip() in EMPTY):
        return ""
    try:
        value = float(cell)
    except ValueError:
        return "a number"
    if not math.isfinite(value):
        return "a finite number"
    if kind in WHOLE and value != math.floor(value):
        return "a whole number"
    if kind == "whole" and abs(value) >= EXACT:
        return f"a whole number below {EXACT:,}"
    return str(limit) if limit is not None and abs(value) > limit.largest else ""


def _count_beyond(path: Path, index: int, limit: Limit | None) -> str:
    """How many cells of a column are beyond its limit, if several are."""
    if limit is None:
        return ""
    beyond = rows = 0
    for _, row in itertools.islice(_lines(path), 1, None):
        beyond += len(row) > index and bool(_expected(row[index], "number or empty", limit))
        rows += 1
    return f", and {beyond - 1:,} of {rows - 1:,} other rows are beyond" if beyond > 1 else ""


def _lines(path: Path) -> Iterator[tuple[int, list[str]]]:
    """Number, from 1, and cells of every line that is not blank."""
    with open_table(path) as file:
        for number, line in enumerate(file, start=1):
            text = line.decode("utf-8-sig", "replace").rstrip("\r\n")
            try:  # line by line, so that an unclosed quote affects no other line
                row = next(csv.reader([text.replace("\0", "?").replace("\r", "?")]), [])
            except csv.Error as error:
                raise DataError(f"{path}, line {number}: cannot be read: {error}") from error
            if any(cell.strip() for cell in row) or len(row) > 1:
                yield number, row


def _same(cell: str, value: object) -> bool:
    if isinstance(value, str):
        return cell == value
    if isinstance(value, int) and abs(value) >= EXACT:
        return _exact_id(cell) == value
    return float(cell) == value


def _one_line(error: BaseException) -> str:
    return " ".join(str(error).split()) or type(error).__name__
