"""Which scenarios are meant, in words: `left,!standing-start,length>=8,density>5`.

MERGED: Scenarios that somebody asks for: of any vehicle at any tick, in words, or in a file.
MERGED: Scenario sets in files, so that others can drive the very same ones.

A file is JSON: the tick, the history, of each recording its name and the hash of its content, and
of each scenario its recording, ego, start, length and seed. Tags and columns are worked out anew
when it is read, so that they are never those of older rules.
"""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool

from asp_env.data.classes import PREDICTED, AgentClass
from asp_env.data.recording import Recording, frames_per_tick
from asp_env.data.scenarios.scenario import (
    MAX_LENGTH_S,
    Scenario,
    ScenarioFilter,
    ScenarioSet,
    find_scenarios,
    make_scenarios,
    track_ticks,
)
from asp_env.data.source import Recordings
from asp_env.errors import AspEnvError, DataError
from asp_env.files import atomic_file


def choose_scenarios(
    recordings: Recordings,
    words: str,
    *,
    dt_s: float,
    history: int,
    allowed: Sequence[Bool[np.ndarray, " _"]] | None = None,
) -> ScenarioSet:
    """The scenarios that somebody asks for, each with the seed that it has among all.

    Args:
        recordings: where to look.
        words: those of a `ScenarioFilter`, or the path of a file that `save_scenarios` wrote,
            which ends in `.json`; empty for all that `find_scenarios` finds.
        dt_s: seconds per tick.
        history: ticks of history before each start.
        allowed: of each recording, the ticks that scenarios and their histories may use.

    Raises:
        AspEnvError: the words are not understood, or nothing fits.
        DataError: the file cannot be read, or is of other recordings.
    """
    if words.strip().endswith(SUFFIX):
        chosen = load_scenarios(Path(words.strip()), recordings, dt_s=dt_s, history=history)
        if allowed is not None:
            _check_allowed(chosen, allowed, words)
        return chosen
    wanted = ScenarioFilter.parse(words)  # before the search, which takes longer
    found = find_scenarios(
        recordings, source=recordings.source, dt_s=dt_s, history=history, allowed=allowed
    )
    return found.filtered(wanted) if len(found) else found


def _check_allowed(
    chosen: ScenarioSet, allowed: Sequence[Bool[np.ndarray, " _"]], path: str
) -> None:
    outside = sum(
        not allowed[each.recording][
            each.start_tick - chosen.history : each.start_tick + each.length + 1
        ].all()
        for each in chosen
    )
    if outside:
        raise AspEnvError(
            f"{path}: {outside} of its {len(chosen)} scenarios lie outside the part that is judged "
            "on; say --part all, or choose among what is left with a filter"
        )


def scenario_of(
    recordings: Sequence[Recording],
    *,
    source: str,
    recording: int,
    ego_id: int,
    dt_s: float,
    history: int,
    start_tick: int | None = None,
    length: int | None = None,
    seed: int = 0,
) -> Scenario:
    """The scenario of any vehicle that drives, at any tick; its tags are those of the rules.

    Args:
        recordings: where it is.
        source: DATA as the user named it.
        recording: index into the recordings.
        ego_id: the track id of a vehicle.
        dt_s: seconds per tick.
        history: ticks of history before the start.
        start_tick: the tick of the first observation; the first one possible by default.
        length: in ticks; by default as long as the track lasts, at most 15 s.
        seed: of the episode.

    Raises:
        AspEnvError: there is no such recording or track, it cannot be driven, or the track does
            not span the history and the length.
    """
    if not 0 <= recording < len(recordings):
        raise AspEnvError(f"recording {recording}: expected 0 to {len(recordings) - 1}")
    table = recordings[recording]
    stride = frames_per_tick(table.frame_rate_hz, dt_s)
    track = _drivable_track(table, ego_id)
    first, last = track_ticks(table, track, stride)
    earliest, latest = first + history, last - 1
    who = f"ego {ego_id} of recording {table.name}"
    if earliest > latest:
        raise AspEnvError(
            f"{who}: is seen from tick {first} to {last} only; {history} ticks of history and one "
            "to drive are needed"
        )
    start = earliest if start_tick is None else start_tick
    if not earliest <= start <= latest:
        raise AspEnvError(
            f"start tick {start}: {who} can start at ticks {earliest} to {latest}, since it is "
            f"seen from {first} to {last} and needs {history} ticks of history"
        )
    longest = last - start
    if length is not None and not 1 <= length <= longest:
        raise AspEnvError(f"length {length}: {who} can drive 1 to {longest} ticks from {start} on")
    ticks = min(int(MAX_LENGTH_S / dt_s + 1e-6), longest) if length is None else length
    row = np.array([[recording, track, start, ticks]], dtype=np.int64)
    (scenario,) = make_scenarios(
        recordings, row, source=source, dt_s=dt_s, history=history, seeds=np.array([seed])
    )
    return scenario


def _drivable_track(table: Recording, ego_id: int) -> int:
    """Index of the track of a vehicle that drives."""
    found = np.flatnonzero(table.track_ids == ego_id)
    if not len(found):
        ids = table.track_ids
        span = f"{ids.min()} to {ids.max()}" if len(ids) else "none"
        raise AspEnvError(
            f"ego {ego_id}: recording {table.name} has no such track; expected one of its "
            f"{len(table)}, which have the ids {span}"
        )
    track = int(found[0])
    kind = AgentClass(int(table.classes[track]))
    if kind not in PREDICTED:
        able = ", ".join(each.name.lower() for each in sorted(PREDICTED))
        raise AspEnvError(
            f"ego {ego_id}: is of class {kind.name.lower()}, which cannot be driven; expected one "
            f"of {able}"
        )
    if table.parked[track]:
        raise AspEnvError(f"ego {ego_id}: is parked and has no way to drive; choose another")
    return track


SUFFIX = ".json"
FORMAT = 1

_COLUMNS = ("recording", "ego_id", "start_tick", "length", "seed")


def save_scenarios(path: Path, scenarios: ScenarioSet, recordings: Recordings) -> None:
    """Writes a set of scenarios of some recordings, aside first, then renamed.

    Raises:
        DataError: the path does not end in `.json`.
        OSError: it cannot be written.
    """
    if path.suffix != SUFFIX:
        raise DataError(f"{path}: expected a name that ends in {SUFFIX}")
    used = np.unique(scenarios.recording)
    hashes = recordings.subset(used.tolist()).hashes()
    columns = [np.searchsorted(used, scenarios.recording)]
    columns += [getattr(scenarios, name) for name in _COLUMNS[1:]]
    head = {
        "format": FORMAT,
        "dt_s": scenarios.dt_s,
        "history": scenarios.history,
        "recordings": [
            [scenarios.recordings[number], content]
            for number, content in zip(used.tolist(), hashes, strict=True)
        ],
        "columns": _COLUMNS,
    }
    rows = [json.dumps(row) for row in np.stack(columns, axis=-1).tolist()]
    text = json.dumps(head)[:-1] + ', "scenarios": [\n' + ",\n".join(rows) + "\n]}\n"
    with atomic_file(path) as partial:
        partial.write_text(text)


def load_scenarios(path: Path, recordings: Recordings, *, dt_s: float, history: int) -> ScenarioSet:
    """Reads what `save_scenarios` wrote; recordings are found by their content.

    Args:
        path: the file.
        recordings: where its recordings are, among others perhaps.
        dt_s: seconds per tick; it must be the file's.
        history: ticks of history before each start; no more than the file's.

    Raises:
        DataError: the file is missing or damaged, was made with another tick, or is of recordings
            with other content than these.
    """
    try:
        head = json.loads(path.read_text())
        given = np.array(head["scenarios"], dtype=np.int64).reshape(-1, len(_COLUMNS))
        made_of = [(str(name), str(content)) for name, content in head["recordings"]]
        facts = int(head["format"]), float(head["dt_s"]), int(head["history"])
        if not ((given[:, 0] >= 0) & (given[:, 0] < len(made_of))).all():
            raise DataError(f"{path}: names a recording that it does not list")
    except OSError as error:
        raise DataError(f"{path}: cannot be read: {error.strerror}") from error
    except (ValueError, KeyError, TypeError, OverflowError) as error:
        if isinstance(error, DataError):
            raise
        raise DataError(f"{path}: is no file of scenarios; expected one of asp-env") from error
    if facts[0] != FORMAT:
        raise DataError(f"{path}: scenarios of format {facts[0]}, expected {FORMAT}")
    if abs(facts[1] - dt_s) > 1e-9 or facts[2] < history:
        raise DataError(
            f"{path}: made for ticks of {facts[1]:g} s with {facts[2]} of history, asked for "
            f"{dt_s:g} s and {history}"
        )
    numbers = _find(path, made_of, recordings)
    rows = _rows(path, given, numbers, recordings, dt_s=dt_s, history=history)
    return make_scenarios(
        recordings, rows, source=recordings.source, dt_s=dt_s, history=history, seeds=given[:, 4]
    )


def _find(path: Path, made_of: list[tuple[str, str]], recordings: Recordings) -> list[int]:
    """Which of the recordings have the content that a file was made of."""
    known = {content: number for number, content in enumerate(recordings.hashes())}
    for name, content in made_of:
        if content not in known:
            why = "has other content" if name in recordings.names else "is not among these"
            raise DataError(
                f"{path}: recording {name} {why} ({recordings.source!r}); use the recordings that "
                "the file was made of"
            )
    return [known[content] for _, content in made_of]


def _rows(
    path: Path, given: Any, numbers: list[int], recordings: Recordings, *, dt_s: float, history: int
) -> Any:
    """(recording, track, start, length) of what a file names, if the recordings have it."""
    rows = np.zeros((len(given), 4), dtype=np.int64)
    for row, (number, ego_id, start, length, _) in enumerate(given.tolist()):
        recording = recordings[numbers[number]]
        found = np.flatnonzero(recording.track_ids == ego_id)
        stride = frames_per_tick(recording.frame_rate_hz, dt_s)
        first, last = track_ticks(recording, int(found[0]), stride) if len(found) else (0, -1)
        if length < 1 or start - history < first or start + length > last:
            raise DataError(
                f"{path}: scenario {recording.name}-{ego_id}-{start} does not fit its recording"
            )
        rows[row] = numbers[number], found[0], start, length
    return rows
