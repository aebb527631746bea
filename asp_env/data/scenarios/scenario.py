"""Scenarios: the episodes that can be driven, as a table with a filter language."""

import dataclasses
import difflib
import math
import re
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int, Shaped

from asp_env.data.recording import Recording, frames_per_tick
from asp_env.data.scenarios.tags import COLUMNS, TAGS, describe
from asp_env.errors import AspEnvError, unknown_name

MAX_LENGTH_S = 15.0
"""Longest scenario. Chosen by hand."""

MIN_LENGTH_S = 4.0
"""Shortest scenario. Chosen by hand."""

SHORT_HISTORY_S = 0.6
"""History of scenarios and snippets of data whose recordings are all too short for the usual one,
such as the cases of INTERACTION 1.2, 4 s. A multiple of all usual time steps."""

SHORT_LENGTH_S = 2.0
"""Shortest scenario of such data. Chosen by hand."""

MIN_DISTANCE_M = 10.0
"""Shortest distance that the ego drives in a scenario. Chosen by hand: parking is left out."""

TEXT_COLUMNS = ("recording", "location")
"""Columns of text, which are compared by `=` and `!=` only."""

_UNITS = ("_s", "_m", "_mps", "_deg")

_COLUMN_OF = {name.removesuffix(unit): name for name in COLUMNS for unit in _UNITS}
"""Column by its name, with or without the unit."""

_COMPARISON = re.compile(r"([^<>=!]*)(>=|<=|!=|>|<|=)([^<>=!]*)")

_OPERATORS = {
    ">=": np.greater_equal,
    "<=": np.less_equal,
    ">": np.greater,
    "<": np.less,
    "=": np.equal,
    "!=": np.not_equal,
}


@dataclass(frozen=True, slots=True, kw_only=True)
class Scenario:
    """An episode that can be driven: an ego and a period of a recording."""

    source: str
    """The data as the user named them."""
    recording: int
    """Index of the recording in its source."""
    recording_name: str
    start_tick: int
    """The tick of the first observation, which follows the history."""
    length: int
    """Number of recorded ticks after `start_tick`."""
    ego_id: int
    """Track id of the ego."""
    seed: int = 0
    """Seed of the episode's random generator, for drivers that sample."""
    tags: tuple[str, ...] = ()

    @property
    def name(self) -> str:
        """A readable name, unique within the source and valid as a file name."""
        place = self.recording_name.replace("/", "_")
        return f"{place}-{self.ego_id}-{self.start_tick}"


@dataclass(frozen=True, slots=True, kw_only=True)
class Condition:
    """A tag that a scenario must or must not have, or a column compared with a value."""

    name: str
    """Name of the tag or column."""
    operator: str
    """A key of `_OPERATORS`; of tags, `=` (has the tag) or `!=` (does not have it)."""
    value: float | str | None
    """None for tags."""

    def __str__(self) -> str:
        if self.value is None:
            return self.name if self.operator == "=" else f"!{self.name}"
        value = self.value if isinstance(self.value, str) else f"{self.value:g}"
        return f"{self.name}{self.operator}{value}"


@dataclass(frozen=True, slots=True, kw_only=True)
class ScenarioFilter:
    """A conjunction of clauses, each of which is a disjunction of conditions.

    Written as text, `,` separates clauses and `|` the conditions of a clause, as in
    `left|right,yielding,!standing-start,length>=8,density>5,recording=00`. A condition is a tag
    (`asp_env.data.scenarios.tags.TAGS`), a negated tag (`!tag`), or a column
    (`asp_env.data.scenarios.tags.COLUMNS`, with or without its unit) compared by one of
    `>= <= > < = !=` with a number; `recording` and `location` are compared with names. The empty
    text matches every scenario.
    """

    clauses: tuple[tuple[Condition, ...], ...]

    @classmethod
    def parse(cls, text: str) -> "ScenarioFilter":
        """Parses a filter.

        Raises:
            AspEnvError: the text is not a filter; for an unknown name, the message lists all names.
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
        return ",".join(map(_clause_text, self.clauses))

    def matches(self, scenarios: "ScenarioSet") -> Bool[np.ndarray, " n"]:
        """Mask of the scenarios that match."""
        mask = np.ones(len(scenarios), dtype=bool)
        for clause in self.clauses:
            mask &= _clause_matches(clause, scenarios)
        return mask

    def explain(self, scenarios: "ScenarioSet") -> str:
        """The number of scenarios that each clause alone matches, as text."""
        counts = (
            f"{_clause_text(clause)} {int(_clause_matches(clause, scenarios).sum())}"
            for clause in self.clauses
        )
        return ", ".join(counts)


@dataclass(frozen=True, slots=True, kw_only=True)
class ScenarioSet:
    """A table of scenarios that can be filtered, sorted and sampled.

    Rows are sorted by recording, track and start unless they have been sorted otherwise. An index
    selects a row as a `Scenario`.
    """

    source: str
    """The data as the user named them."""
    recordings: tuple[str, ...]
    """Names of the source's recordings."""
    locations: tuple[str, ...]
    """Location of each recording."""
    dt_s: float
    """Seconds per tick."""
    history: int
    """Number of ticks before each start that belong to the history."""
    recording: Int[np.ndarray, " n"]
    """Index into `recordings`."""
    ego_id: Int[np.ndarray, " n"]
    start_tick: Int[np.ndarray, " n"]
    length: Int[np.ndarray, " n"]
    seed: Int[np.ndarray, " n"]
    tags: Bool[np.ndarray, "n tags"]
    """Which of `TAGS` each scenario has."""
    values: Float[np.ndarray, "n columns"]
    """The `COLUMNS` of each scenario."""

    def __len__(self) -> int:
        """Number of scenarios."""
        return len(self.recording)

    def __getitem__(self, index: int) -> Scenario:
        """The scenario of one row."""
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
        """All scenarios in order."""
        return (self[index] for index in range(len(self)))

    def column(self, name: str) -> Shaped[np.ndarray, " n"]:
        """One of `COLUMNS`, or the names of the column `recording` or `location`.

        Raises:
            AspEnvError: the name is unknown.
        """
        if name in COLUMNS:
            return self.values[:, [*COLUMNS].index(name)]
        texts = {"recording": self.recordings, "location": self.locations}
        if name not in texts:
            raise unknown_name("scenario column", name, (*COLUMNS, *texts))
        return np.array(texts[name], dtype=np.str_)[self.recording]

    def has(self, tag: str) -> Bool[np.ndarray, " n"]:
        """Mask of the scenarios with a tag.

        Raises:
            AspEnvError: the tag is unknown.
        """
        if tag not in TAGS:
            raise unknown_name("scenario tag", tag, TAGS)
        return self.tags[:, TAGS.index(tag)]

    def counts(self) -> dict[str, int]:
        """Number of scenarios with each tag."""
        return dict(zip(TAGS, self.tags.sum(axis=0).tolist(), strict=True))

    def select(self, rows: Int[np.ndarray, " m"] | Bool[np.ndarray, " n"]) -> "ScenarioSet":
        """The scenarios at the given rows, in that order, or those of a mask."""
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

    def filtered(self, conditions: str | ScenarioFilter) -> "ScenarioSet":
        """The scenarios that match a filter, in their order and with their seeds.

        Args:
            conditions: a filter, as an object or as text, such as
                `left,!standing-start,length>=8,density>5`.

        Raises:
            AspEnvError: the text is not a filter, or no scenario matches.
        """
        if isinstance(conditions, str):
            conditions = ScenarioFilter.parse(conditions)
        mask = conditions.matches(self)
        if conditions.clauses and not mask.any():
            raise AspEnvError(
                f"scenarios {str(conditions)!r}: none of the {len(self)} of {self.source!r} fits "
                f"(each condition alone: {conditions.explain(self)}); use fewer conditions"
            )
        return self.select(mask)

    def tagged(self, tag: str) -> "ScenarioSet":
        """The scenarios with a tag, possibly none.

        Raises:
            AspEnvError: the tag is unknown.
        """
        return self.select(self.has(tag))

    def sorted_by(self, column: str, *, descending: bool = False) -> "ScenarioSet":
        """All scenarios sorted by a column; the sort is stable.

        Raises:
            AspEnvError: the column is unknown.
        """
        _, rank = np.unique(self.column(column), return_inverse=True)
        return self.select(np.argsort(-rank if descending else rank, kind="stable"))

    def sample(self, count: int, *, seed: int) -> "ScenarioSet":
        """At most `count` scenarios, sampled without replacement, in their order.

        Raises:
            AspEnvError: the count is less than 1.
        """
        _check_count(count)
        rng = np.random.default_rng(seed)
        drawn = rng.choice(len(self), size=min(count, len(self)), replace=False)
        return self.select(np.sort(drawn))

    def evenly_spaced(self, count: int) -> "ScenarioSet":
        """At most `count` scenarios at evenly spaced rows.

        Raises:
            AspEnvError: the count is less than 1.
        """
        _check_count(count)
        rows = np.linspace(0, len(self) - 1, min(count, len(self))).round()
        return self.select(rows.astype(np.int64))

    def by_name(self, name: str) -> Scenario:
        """The scenario with a name.

        Raises:
            AspEnvError: no scenario has this name; the message lists similar ones.
        """
        return self[self.index_of(name)]

    def index_of(self, name: str) -> int:
        """The row of the scenario with a name.

        Raises:
            AspEnvError: no scenario has this name; the message lists similar ones.
        """
        names = [each.name for each in self]
        if name in names:
            return names.index(name)
        near = difflib.get_close_matches(name, names, n=3, cutoff=0.0)
        raise AspEnvError(
            f"unknown scenario {name!r}: {len(self)} are known, such as {', '.join(near) or 'none'}"
        )


def find_scenarios(
    recordings: Sequence[Recording],
    *,
    source: str,
    dt_s: float,
    history: int,
    allowed: Sequence[Bool[np.ndarray, " _"]] | None = None,
) -> ScenarioSet:
    """Finds all scenarios.

    Each track of a predicted class that is not parked is cut into consecutive windows of at most
    15 s, from the first tick that has a full history. Windows of at least 4 s in which the vehicle
    drives at least 10 m become scenarios.

    If no recording lasts as long as the history and 4 s, the history is 0.6 s, windows last at
    least 2 s, and a warning says so.

    Args:
        recordings: the recordings.
        source: the data as the user named them.
        dt_s: seconds per tick.
        history: number of ticks of history before each start.
        allowed: of each recording, a mask of the ticks that scenarios and histories may use.

    Returns:
        The scenarios with their tags and columns, sorted by recording, track and start.
    """
    found, shortest_s = [], MIN_LENGTH_S
    if all_shorter(recordings, history * dt_s + MIN_LENGTH_S):
        history, shortest_s = short_history(history, dt_s), SHORT_LENGTH_S
    for number, recording in enumerate(recordings):
        stride = frames_per_tick(recording.frame_rate_hz, dt_s)
        ticks_allowed = None if allowed is None else allowed[number]
        for track in np.flatnonzero(recording.predicted).tolist():
            first, last = track_ticks(recording, track, stride)
            windows = _windows(first, last, history, (shortest_s, dt_s), ticks_allowed)
            found += [(number, track, start, length) for start, length in windows]
    rows = np.array(found, dtype=np.int64).reshape(-1, 4)
    scenarios = make_scenarios(recordings, rows, source=source, dt_s=dt_s, history=history)
    scenarios = scenarios.select(scenarios.column("distance_m") >= MIN_DISTANCE_M)
    if len(scenarios) and shortest_s < MIN_LENGTH_S:
        warnings.warn(
            f"data {source!r}: no recording lasts {MIN_LENGTH_S:g} s after the usual history, so "
            f"that scenarios last {shortest_s:g} s or more after {history * dt_s:g} s of history; "
            "constant velocity takes the place of forecasts that need a longer one",
            stacklevel=2,
        )
    return dataclasses.replace(scenarios, seed=np.arange(len(scenarios)))


def make_scenarios(
    recordings: Sequence[Recording],
    rows: Int[np.ndarray, "n 4"],
    *,
    source: str,
    dt_s: float,
    history: int,
    seeds: Int[np.ndarray, " n"] | None = None,
) -> ScenarioSet:
    """A table of given scenarios, with their tags and columns.

    Args:
        recordings: the recordings.
        rows: recording index, track index, start tick and length of each; all within the track.
        source: the data as the user named them.
        dt_s: seconds per tick.
        history: number of ticks of history before each start.
        seeds: seeds of the episodes, by default 0, 1, 2, …
    """
    tags = np.zeros((len(rows), len(TAGS)), dtype=bool)
    values = np.zeros((len(rows), len(COLUMNS)))
    ego_ids = np.zeros(len(rows), dtype=np.int64)
    for number in np.unique(rows[:, 0]).tolist():
        mask, recording = rows[:, 0] == number, recordings[number]
        stride = frames_per_tick(recording.frame_rate_hz, dt_s)
        tags[mask], values[mask] = describe(recording, *rows[mask, 1:].T, stride=stride)
        ego_ids[mask] = recording.track_ids[rows[mask, 1]]
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
    """The first and the last tick of a track.

    Args:
        recording: the recording.
        track: index of the track.
        stride: frames per tick.
    """
    first = -(-int(recording.first_frames[track]) // stride)
    return first, int(recording.last_frames[track]) // stride


def all_shorter(recordings: Sequence[Recording], least_s: float) -> bool:
    """Whether every recording is too short for a window of some seconds."""
    lasting = (each.num_frames - 1 >= least_s * each.frame_rate_hz - 1e-6 for each in recordings)
    return not any(lasting)


def short_history(history: int, dt_s: float) -> int:
    """The history of data whose recordings are all too short for the usual one, in ticks."""
    return min(history, round(SHORT_HISTORY_S / dt_s))


def _windows(
    first: int,
    last: int,
    history: int,
    durations_s: tuple[float, float],
    allowed: Bool[np.ndarray, " ticks"] | None,
) -> Iterator[tuple[int, int]]:
    """(start, length) of the windows within the allowed ones of the ticks first to last.

    The durations are that of the shortest window and that of a tick.
    """
    shortest_s, dt_s = durations_s
    longest, shortest = int(MAX_LENGTH_S / dt_s + 1e-6), math.ceil(shortest_s / dt_s - 1e-6)
    usable = np.ones(last - first + 1, dtype=bool) if allowed is None else allowed[first : last + 1]
    edges = np.flatnonzero(np.diff(usable, prepend=False, append=False)) + first
    for begin, end in edges.reshape(-1, 2).tolist():
        for start in range(begin + history, end - shortest, longest):
            yield start, min(longest, end - 1 - start)


def _check_count(count: int) -> None:
    if count < 1:
        raise AspEnvError(f"{count} scenarios: expected at least 1")


def _clause_text(clause: tuple[Condition, ...]) -> str:
    return "|".join(map(str, clause))


def _clause_matches(
    clause: tuple[Condition, ...], scenarios: ScenarioSet
) -> Bool[np.ndarray, " n"]:
    mask = np.zeros(len(scenarios), dtype=bool)
    for each in clause:
        if each.value is None:
            mask |= scenarios.has(each.name) == (each.operator == "=")
        else:
            mask |= _OPERATORS[each.operator](scenarios.column(each.name), each.value)
    return mask


def _condition(part: str, text: str) -> Condition:
    """Parses one condition of the filter `text`."""
    if part.startswith("!") or not set(part) & set("<>="):
        tag = part.removeprefix("!").strip()
        if not tag:
            raise AspEnvError(
                f"scenarios {text!r}: a condition is empty; expected tags and comparisons with "
                "commas between them, such as left,length>=8"
            )
        if tag not in TAGS:
            raise unknown_name("scenario tag", tag, TAGS)
        return Condition(name=tag, operator="!=" if part.startswith("!") else "=", value=None)
    match = _COMPARISON.fullmatch(part)
    if match is None:
        raise AspEnvError(
            f"scenarios {text!r}: {part!r} is not understood; expected a tag, !tag, or a column "
            "compared with a value, such as length>=8"
        )
    name, operator, value = (group.strip() for group in match.groups())
    name = _COLUMN_OF.get(name, name)
    if name in TEXT_COLUMNS:
        return _text_condition(name, operator, value)
    if name not in COLUMNS:
        raise unknown_name("scenario column", name, (*COLUMNS, *TEXT_COLUMNS))
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
