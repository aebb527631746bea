"""Where, when and who: the table of episodes that can be driven."""

import dataclasses
import difflib
import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float, Int, Shaped

from asp_env.data.recording import Recording, frames_per_tick
from asp_env.data.scenarios.tags import COLUMNS, TAGS, describe
from asp_env.errors import AspEnvError, unknown_name

TEXTS = ("recording", "location")
"""What is compared as text, with `=` and `!=` alone."""


_UNITS = ("_s", "_m", "_mps", "_deg")


_SHORT = {name.removesuffix(unit): name for name in COLUMNS for unit in _UNITS}
"""Columns under the names that leave their unit out, and under their own."""


_COMPARISON = re.compile(r"([^<>=!]*)(>=|<=|!=|>|<|=)([^<>=!]*)")


_COMPARE = {
    ">=": np.greater_equal,
    "<=": np.less_equal,
    ">": np.greater,
    "<": np.less,
    "=": np.equal,
    "!=": np.not_equal,
}


@runtime_checkable
class Table(Protocol):
    """What is filtered: an `asp_env.data.scenarios.scenario.ScenarioSet`."""

    def __len__(self) -> int:
        """How many rows there are."""
        ...

    def has(self, tag: str) -> Bool[np.ndarray, " n"]:
        """Which rows carry a tag."""
        ...

    def column(self, name: str) -> Shaped[np.ndarray, " n"]:
        """A column of numbers or names."""
        ...


@dataclass(frozen=True, slots=True, kw_only=True)
class Condition:
    """A tag that is there or not, or a column compared with a value."""

    name: str
    operator: str
    """`=` and `!=` for tags, too."""
    value: float | str | None
    """None for tags."""

    def __str__(self) -> str:
        """As it is written."""
        if self.value is None:
            return self.name if self.operator == "=" else f"!{self.name}"
        value = self.value if isinstance(self.value, str) else f"{self.value:g}"
        return f"{self.name}{self.operator}{value}"


@dataclass(frozen=True, slots=True, kw_only=True)
class ScenarioFilter:
    """Conditions of which every clause must hold; a clause holds where one of its conditions does.

    In words: conditions with `,` between clauses and `|` between the conditions of one, such as
    `left|right,yielding,!standing-start,length>=8,density>5,recording=00`. A condition is a tag
    (`asp_env.data.scenarios.tags.TAGS`), a tag that is not there (`!tag`), or a column
    (`asp_env.data.scenarios.tags.COLUMNS`; the unit may be left out) compared by one of
    `>= <= > < = !=` with a number; `recording` and `location` are compared with names. Empty words
    ask for nothing, so that every scenario fits.
    """

    clauses: tuple[tuple[Condition, ...], ...]

    @classmethod
    def parse(cls, text: str) -> "ScenarioFilter":
        """Reads the words.

        Raises:
            AspEnvError: they are not understood; names that are not known list those that are.
        """
        if not text.strip():
            return cls(clauses=())
        return cls(
            clauses=tuple(
                tuple(_condition(each.strip(), text) for each in clause.split("|"))
                for clause in text.split(",")
            )
        )

    def __str__(self) -> str:
        """The words, in one spelling."""
        return ",".join(map(_clause_text, self.clauses))

    def holds(self, table: Table) -> Bool[np.ndarray, " n"]:
        """(n,) which rows of a `ScenarioSet` fit."""
        fits = np.ones(len(table), dtype=bool)
        for clause in self.clauses:
            fits &= _clause_holds(clause, table)
        return fits

    def explain(self, table: Table) -> str:
        """How many rows each clause would leave by itself."""
        counts = (
            f"{_clause_text(clause)} {int(_clause_holds(clause, table).sum())}"
            for clause in self.clauses
        )
        return ", ".join(counts)


def _clause_text(clause: tuple[Condition, ...]) -> str:
    return "|".join(map(str, clause))


def _clause_holds(clause: tuple[Condition, ...], table: Table) -> Bool[np.ndarray, " n"]:
    fits = np.zeros(len(table), dtype=bool)
    for each in clause:
        if each.value is None:
            fits |= table.has(each.name) == (each.operator == "=")
        else:
            fits |= _COMPARE[each.operator](table.column(each.name), each.value)
    return fits


def _condition(words: str, text: str) -> Condition:
    if words.startswith("!") or not set(words) & set("<>="):
        tag = words.removeprefix("!").strip()
        if not tag:
            raise AspEnvError(
                f"scenarios {text!r}: a condition is empty; expected tags and comparisons with "
                "commas between them, such as left,length>=8"
            )
        if tag not in TAGS:
            raise unknown_name("scenario tag", tag, TAGS)
        return Condition(name=tag, operator="!=" if words.startswith("!") else "=", value=None)
    match = _COMPARISON.fullmatch(words)
    if match is None:
        raise AspEnvError(
            f"scenarios {text!r}: {words!r} is not understood; expected a tag, !tag, or a column "
            "compared with a value, such as length>=8"
        )
    name, operator, value = (part.strip() for part in match.groups())
    name = _SHORT.get(name, name)
    if name in TEXTS:
        return _text_condition(name, operator, value)
    if name not in COLUMNS:
        raise unknown_name("scenario column", name, (*COLUMNS, *TEXTS))
    try:
        number = float(value)
    except ValueError:
        number = math.nan
    if math.isnan(number):
        raise AspEnvError(f"scenarios {text!r}: {name}{operator}{value}: expected a number")
    return Condition(name=name, operator=operator, value=number)


def _text_condition(name: str, operator: str, value: str) -> Condition:
    if operator not in ("=", "!=") or not value:
        raise AspEnvError(
            f"scenarios: {name}{operator}{value}: expected {name}=NAME or {name}!=NAME"
        )
    return Condition(name=name, operator=operator, value=value)


MAX_LENGTH_S = 15.0
MIN_LENGTH_S = 4.0
MIN_DISTANCE_M = 10.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Scenario:
    """One episode: an ego in a stretch of a recording."""

    source: str
    """DATA as the user named it."""
    recording: int
    """Index of the recording in its source."""
    recording_name: str
    start_tick: int
    """The tick of the first observation; its history lies before it."""
    length: int
    """How many steps the recording provides after `start_tick`."""
    ego_id: int
    seed: int = 0
    """Seeds the generator of this episode, for drivers that draw."""
    tags: tuple[str, ...] = ()

    @property
    def name(self) -> str:
        """A readable name, unique within the source, which may be a file's."""
        place = self.recording_name.replace("/", "_")
        return f"{place}-{self.ego_id}-{self.start_tick}"


@dataclass(frozen=True, slots=True, kw_only=True)
class ScenarioSet:
    """Scenarios as a table of one row each, that can be filtered, sorted and sampled.

    Rows are ordered by recording, track and start until they are ordered otherwise. A row is taken
    as a `Scenario` by its number; columns are read as they are.
    """

    source: str
    """DATA as the user named it."""
    recordings: tuple[str, ...]
    """Names of the source's recordings."""
    locations: tuple[str, ...]
    """Where each of them was made."""
    dt_s: float
    """Seconds per tick."""
    history: int
    """Ticks of history before each start."""
    recording: Int[np.ndarray, " n"]
    """Index into `recordings`."""
    ego_id: Int[np.ndarray, " n"]
    start_tick: Int[np.ndarray, " n"]
    length: Int[np.ndarray, " n"]
    seed: Int[np.ndarray, " n"]
    tags: Bool[np.ndarray, "n tags"]
    """Which of `TAGS` each has."""
    values: Float[np.ndarray, "n columns"]
    """`COLUMNS` of each."""

    def __len__(self) -> int:
        """How many there are."""
        return len(self.recording)

    def __getitem__(self, index: int) -> Scenario:
        """One of them."""
        return Scenario(
            source=self.source,
            recording=int(self.recording[index]),
            recording_name=self.recordings[int(self.recording[index])],
            start_tick=int(self.start_tick[index]),
            length=int(self.length[index]),
            ego_id=int(self.ego_id[index]),
            seed=int(self.seed[index]),
            tags=tuple(TAGS[i] for i in np.flatnonzero(self.tags[index])),
        )

    def __iter__(self) -> Iterator[Scenario]:
        """All of them in order."""
        return (self[index] for index in range(len(self)))

    def column(self, name: str) -> Shaped[np.ndarray, " n"]:
        """One of `COLUMNS`, or `recording` or `location` as names.

        Raises:
            AspEnvError: there is none of this name.
        """
        if name in COLUMNS:
            return self.values[:, [*COLUMNS].index(name)]
        texts = {"recording": self.recordings, "location": self.locations}
        if name not in texts:
            raise unknown_name("scenario column", name, (*COLUMNS, *texts))
        return np.array(texts[name], dtype=np.str_)[self.recording]

    def has(self, tag: str) -> Bool[np.ndarray, " n"]:
        """Which of them carry a tag.

        Raises:
            AspEnvError: there is no such tag.
        """
        if tag not in TAGS:
            raise unknown_name("scenario tag", tag, TAGS)
        return self.tags[:, TAGS.index(tag)]

    def counts(self) -> dict[str, int]:
        """How many carry each tag."""
        return dict(zip(TAGS, self.tags.sum(axis=0).tolist(), strict=True))

    def select(self, rows: Int[np.ndarray, " m"] | Bool[np.ndarray, " n"]) -> "ScenarioSet":
        """The scenarios at some rows, in their order."""
        return ScenarioSet(
            source=self.source,
            recordings=self.recordings,
            locations=self.locations,
            dt_s=self.dt_s,
            history=self.history,
            recording=self.recording[rows],
            ego_id=self.ego_id[rows],
            start_tick=self.start_tick[rows],
            length=self.length[rows],
            seed=self.seed[rows],
            tags=self.tags[rows],
            values=self.values[rows],
        )

    def filtered(self, what: str | ScenarioFilter) -> "ScenarioSet":
        """Those that fit, in their order, and with the seeds that they have.

        Args:
            what: a filter, or its words, such as `left,!standing-start,length>=8,density>5`.

        Raises:
            AspEnvError: the words are not understood, or no scenario fits.
        """
        wanted = ScenarioFilter.parse(what) if isinstance(what, str) else what
        fits = wanted.holds(self)
        if wanted.clauses and not fits.any():
            raise AspEnvError(
                f"scenarios {str(wanted)!r}: none of the {len(self)} of {self.source!r} fits "
                f"(each condition alone: {wanted.explain(self)}); ask for less"
            )
        return self.select(fits)

    def tagged(self, tag: str) -> "ScenarioSet":
        """Those that carry a tag; there may be none.

        Raises:
            AspEnvError: there is no such tag.
        """
        return self.select(self.has(tag))

    def sorted_by(self, column: str, *, descending: bool = False) -> "ScenarioSet":
        """All of them by a column; those that are equal in it keep their order.

        Raises:
            AspEnvError: there is no such column.
        """
        _, rank = np.unique(self.column(column), return_inverse=True)
        return self.select(np.argsort(-rank if descending else rank, kind="stable"))

    def sample(self, count: int, *, seed: int) -> "ScenarioSet":
        """So many of them, drawn without replacement, in their order; all where there are fewer.

        Raises:
            AspEnvError: the count is less than 1.
        """
        _check_count(count)
        rng = np.random.default_rng(seed)
        drawn = rng.choice(len(self), size=min(count, len(self)), replace=False)
        return self.select(np.sort(drawn))

    def evenly_spaced(self, count: int) -> "ScenarioSet":
        """So many of them, evenly over all; all where there are fewer.

        Raises:
            AspEnvError: the count is less than 1.
        """
        _check_count(count)
        at = np.linspace(0, len(self) - 1, min(count, len(self))).round()
        return self.select(at.astype(np.int64))

    def by_name(self, name: str) -> Scenario:
        """The one that is called so.

        Raises:
            AspEnvError: none is.
        """
        names = [each.name for each in self]
        if name in names:
            return self[names.index(name)]
        near = difflib.get_close_matches(name, names, n=3, cutoff=0.0)
        raise AspEnvError(
            f"unknown scenario {name!r}: {len(self)} are known, such as {', '.join(near) or 'none'}"
        )


def _check_count(count: int) -> None:
    if count < 1:
        raise AspEnvError(f"{count} scenarios: expected at least 1")


def find_scenarios(
    recordings: Sequence[Recording],
    *,
    source: str,
    dt_s: float,
    history: int,
    allowed: Sequence[Bool[np.ndarray, " _"]] | None = None,
) -> ScenarioSet:
    """Every stretch of a vehicle's track that is worth driving.

    A track of a predicted class is cut, from the first tick with `history` ticks behind it, into
    windows of at most 15 s without overlap; those of at least 4 s in which the vehicle covers at
    least 10 m are kept, with the tags and columns of `asp_env.data.scenarios.tags`. With `allowed`,
    scenarios and their histories keep to the ticks that are so marked in each recording.
    """
    found = []
    for number, recording in enumerate(recordings):
        stride = frames_per_tick(recording.frame_rate_hz, dt_s)
        ticks_allowed = None if allowed is None else allowed[number]
        for track in np.flatnonzero(recording.predicted).tolist():
            first, last = track_ticks(recording, track, stride)
            windows = _windows(first, last, history, dt_s, ticks_allowed)
            found += [(number, track, start, length) for start, length in windows]
    rows = np.array(found, dtype=np.int64).reshape(-1, 4)
    every = make_scenarios(recordings, rows, source=source, dt_s=dt_s, history=history)
    worth = every.select(every.column("distance_m") >= MIN_DISTANCE_M)
    return dataclasses.replace(worth, seed=np.arange(len(worth)))


def make_scenarios(
    recordings: Sequence[Recording],
    rows: Int[np.ndarray, "n 4"],
    *,
    source: str,
    dt_s: float,
    history: int,
    seeds: Int[np.ndarray, " n"] | None = None,
) -> ScenarioSet:
    """The table of some scenarios, with their tags and columns.

    Args:
        recordings: where they are.
        rows: (recording, track, start tick, length) of each, both indices; within the track.
        source: DATA as the user named it.
        dt_s: seconds per tick.
        history: ticks of history before each start.
        seeds: of the episodes; numbers from 0 on by default.
    """
    tags = np.zeros((len(rows), len(TAGS)), dtype=bool)
    values = np.zeros((len(rows), len(COLUMNS)))
    ego_ids = np.zeros(len(rows), dtype=np.int64)
    for number in np.unique(rows[:, 0]).tolist():
        mine, recording = rows[:, 0] == number, recordings[number]
        stride = frames_per_tick(recording.frame_rate_hz, dt_s)
        tags[mine], values[mine] = describe(recording, *rows[mine, 1:].T, stride=stride)
        ego_ids[mine] = recording.track_ids[rows[mine, 1]]
    return ScenarioSet(
        source=source,
        recordings=tuple(recording.name for recording in recordings),
        locations=tuple(recording.location for recording in recordings),
        dt_s=dt_s,
        history=history,
        recording=rows[:, 0],
        ego_id=ego_ids,
        start_tick=rows[:, 2],
        length=rows[:, 3],
        seed=np.arange(len(rows)) if seeds is None else seeds,
        tags=tags,
        values=values,
    )


def track_ticks(recording: Recording, track: int, stride: int) -> tuple[int, int]:
    """The first and the last tick at which a track is seen."""
    first = -(-int(recording.first_frames[track]) // stride)
    return first, int(recording.last_frames[track]) // stride


def _windows(
    first: int, last: int, history: int, dt_s: float, allowed: Bool[np.ndarray, " ticks"] | None
) -> Iterator[tuple[int, int]]:
    """(start, length) of the windows in every allowed stretch of the ticks first to last."""
    longest, shortest = int(MAX_LENGTH_S / dt_s + 1e-6), math.ceil(MIN_LENGTH_S / dt_s - 1e-6)
    marked = np.ones(last - first + 1, dtype=bool) if allowed is None else allowed[first : last + 1]
    edges = np.flatnonzero(np.diff(marked, prepend=False, append=False)) + first
    for begin, end in edges.reshape(-1, 2).tolist():
        for start in range(begin + history, end - shortest, longest):
            yield start, min(longest, end - 1 - start)
