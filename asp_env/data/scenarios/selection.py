"""Selection of scenarios: by a filter, from a file, or of a given vehicle at a given tick.

A scenario file is JSON. It holds the time step, the history, the name and content hash of each
recording, and the recording, ego, start, length and seed of each scenario. Tags and columns are
computed when the file is read, so that they always follow the current rules.
"""

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Int

from asp_env.data.classes import PREDICTED, AgentClass
from asp_env.data.recording import Recording, frames_per_tick
from asp_env.data.scenarios.scenario import (
    MAX_LENGTH_S,
    MIN_LENGTH_S,
    Scenario,
    ScenarioFilter,
    ScenarioSet,
    all_shorter,
    find_scenarios,
    make_scenarios,
    short_history,
    track_ticks,
)
from asp_env.data.source import Recordings
from asp_env.errors import AspEnvError, DataError
from asp_env.files import atomic_file
from asp_env.stored import parse_json

SUFFIX = ".json"
"""Suffix of scenario files."""

FORMAT = 1
"""Version of the file format."""

_FIELDS = ("recording", "ego_id", "start_tick", "length", "seed")


def choose_scenarios(
    recordings: Recordings,
    selection: str,
    *,
    dt_s: float,
    history: int,
    allowed: Sequence[Bool[np.ndarray, " _"]] | None = None,
) -> ScenarioSet:
    """Selects scenarios by a filter or from a file, with their seeds.

    Args:
        recordings: the recordings.
        selection: a `ScenarioFilter` as text, or the path of a file written by `save_scenarios`,
            which ends in `.json`, or `FILE.json#NAME` for one scenario of a file; empty for
            everything that `find_scenarios` finds.
        dt_s: seconds per tick.
        history: number of ticks of history before each start.
        allowed: of each recording, a mask of the ticks that scenarios and histories may use.

    Raises:
        AspEnvError: the text is not a filter, no scenario matches, or scenarios of the file use
            other ticks than those allowed.
        DataError: the file cannot be read, or belongs to other recordings.
    """
    path, is_one, name = selection.strip().partition(SUFFIX + "#")
    path += SUFFIX if is_one else ""
    if path.endswith(SUFFIX):
        scenarios = load_scenarios(Path(path), recordings, dt_s=dt_s, history=history)
        if is_one:
            scenarios = scenarios.select(np.array([scenarios.index_of(name)]))
        if allowed is not None:
            _check_allowed(scenarios, allowed, selection)
        return scenarios
    conditions = ScenarioFilter.parse(selection)  # before the search, which takes longer
    found = find_scenarios(
        recordings, source=recordings.source, dt_s=dt_s, history=history, allowed=allowed
    )
    return found.filtered(conditions) if len(found) else found


def _check_allowed(
    scenarios: ScenarioSet, allowed: Sequence[Bool[np.ndarray, " _"]], path: str
) -> None:
    outside = sum(
        not allowed[each.recording][
            each.start_tick - scenarios.history : each.start_tick + each.length + 1
        ].all()
        for each in scenarios
    )
    if outside:
        raise AspEnvError(
            f"{path}: {outside} of its {len(scenarios)} scenarios lie outside the evaluated part "
            "of the data; use --part all, or a filter instead of the file"
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
    """The scenario of a given vehicle, at any tick of its track.

    Args:
        recordings: the recordings.
        source: the data as the user named them.
        recording: index into the recordings.
        ego_id: track id of the vehicle.
        dt_s: seconds per tick.
        history: number of ticks of history before the start.
        start_tick: the tick of the first observation, by default the first possible one.
        length: in ticks, by default up to the end of the track, but at most 15 s.
        seed: of the episode.

    Raises:
        AspEnvError: there is no such recording or track, the track cannot be driven, or it does
            not span the history and the length.
    """
    if not 0 <= recording < len(recordings):
        raise AspEnvError(f"recording {recording}: expected 0 to {len(recordings) - 1}")
    table = recordings[recording]
    stride = frames_per_tick(table.frame_rate_hz, dt_s)
    track = _drivable_track(table, ego_id)
    first, last = track_ticks(table, track, stride)
    earliest, latest = first + history, last - 1
    ego = f"ego {ego_id} of recording {table.name}"
    if earliest > latest:
        raise AspEnvError(
            f"{ego}: is present from tick {first} to {last} only; {history} ticks of history and "
            "one to drive are needed"
        )
    start = earliest if start_tick is None else start_tick
    if not earliest <= start <= latest:
        raise AspEnvError(
            f"start tick {start}: {ego} can start at ticks {earliest} to {latest}, since it is "
            f"present from {first} to {last} and needs {history} ticks of history"
        )
    longest = last - start
    if length is not None and not 1 <= length <= longest:
        raise AspEnvError(f"length {length}: {ego} can drive 1 to {longest} ticks from {start} on")
    ticks = min(int(MAX_LENGTH_S / dt_s + 1e-6), longest) if length is None else length
    row = np.array([[recording, track, start, ticks]], dtype=np.int64)
    (scenario,) = make_scenarios(
        recordings, row, source=source, dt_s=dt_s, history=history, seeds=np.array([seed])
    )
    return scenario


def _drivable_track(table: Recording, ego_id: int) -> int:
    """Index of a track that can be driven."""
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
        raise AspEnvError(f"ego {ego_id}: is parked and has no route; choose another")
    return track


def save_scenarios(path: Path, scenarios: ScenarioSet, recordings: Recordings) -> None:
    """Writes a scenario file, atomically.

    Args:
        path: path of the file.
        scenarios: the scenarios.
        recordings: the recordings to which they belong.

    Raises:
        DataError: the path does not end in `.json`.
        OSError: the file cannot be written.
    """
    if path.suffix != SUFFIX:
        raise DataError(f"{path}: expected a name that ends in {SUFFIX}")
    used = np.unique(scenarios.recording)
    hashes = recordings.subset(used.tolist()).hashes()
    columns = [np.searchsorted(used, scenarios.recording)]
    columns += [getattr(scenarios, name) for name in _FIELDS[1:]]
    head = {
        "format": FORMAT,
        "dt_s": scenarios.dt_s,
        "history": scenarios.history,
        "recordings": [
            [scenarios.recordings[number], content]
            for number, content in zip(used.tolist(), hashes, strict=True)
        ],
        "columns": _FIELDS,
    }
    rows = [json.dumps(row) for row in np.stack(columns, axis=-1).tolist()]
    text = json.dumps(head)[:-1] + ', "scenarios": [\n' + ",\n".join(rows) + "\n]}\n"
    with atomic_file(path) as partial:
        partial.write_text(text)


def load_scenarios(path: Path, recordings: Recordings, *, dt_s: float, history: int) -> ScenarioSet:
    """Reads a scenario file; its recordings are identified by their content.

    Args:
        path: the file.
        recordings: recordings that include those of the file.
        dt_s: seconds per tick, which must be the file's.
        history: number of ticks of history before each start, at most the file's unless all
            recordings are too short for it.

    Raises:
        DataError: the file is missing or damaged, has another time step, or belongs to recordings
            with other content.
    """
    try:
        head = parse_json(path.read_bytes())
        table = np.array(head["scenarios"], dtype=np.int64).reshape(-1, len(_FIELDS))
        contents = [(str(name), str(content)) for name, content in head["recordings"]]
        version, file_dt_s, file_history = (
            int(head["format"]), float(head["dt_s"]), int(head["history"])
        )  # fmt: skip
        if not ((table[:, 0] >= 0) & (table[:, 0] < len(contents))).all():
            raise DataError(f"{path}: names a recording that it does not list")
        if (table[:, _FIELDS.index("seed")] < 0).any():
            raise DataError(f"{path}: has a negative seed, expected 0 or more")
    except OSError as error:
        raise DataError(f"{path}: cannot be read: {error.strerror}") from error
    except (ValueError, KeyError, TypeError, OverflowError) as error:
        if isinstance(error, DataError):
            raise
        raise DataError(
            f"{path}: is not a scenario file; expected one written by asp-env"
        ) from error
    if version != FORMAT:
        raise DataError(f"{path}: scenarios of format {version}, expected {FORMAT}")
    wrong_ticks = DataError(
        f"{path}: made for ticks of {file_dt_s:g} s with {file_history} of history, expected "
        f"{dt_s:g} s and {history}"
    )
    if abs(file_dt_s - dt_s) > 1e-9 or file_history < short_history(history, dt_s):
        raise wrong_ticks
    indices = _recording_indices(path, contents, recordings)
    if all_shorter(recordings, history * dt_s + MIN_LENGTH_S):
        history = min(history, file_history)
    elif file_history < history:
        raise wrong_ticks
    rows = _table_rows(path, table, indices, recordings, dt_s=dt_s, history=history)
    return make_scenarios(
        recordings, rows, source=recordings.source, dt_s=dt_s, history=history, seeds=table[:, 4]
    )


def _recording_indices(
    path: Path, contents: list[tuple[str, str]], recordings: Recordings
) -> list[int]:
    """Indices of the recordings with the given (name, content hash)."""
    index_of = {content: index for index, content in enumerate(recordings.hashes())}
    for name, content in contents:
        if content not in index_of:
            fault = "has other content" if name in recordings.names else "is not among these"
            raise DataError(
                f"{path}: recording {name} {fault} ({recordings.source!r}); use the recordings "
                "from which the file was made"
            )
    return [index_of[content] for _, content in contents]


def _table_rows(
    path: Path,
    table: Int[np.ndarray, "n fields"],
    indices: list[int],
    recordings: Recordings,
    *,
    dt_s: float,
    history: int,
) -> Int[np.ndarray, "n 4"]:
    """Rows for `make_scenarios` of the scenarios in a file."""
    rows = np.zeros((len(table), 4), dtype=np.int64)
    for row, (number, ego_id, start, length, _) in enumerate(table.tolist()):
        recording = recordings[indices[number]]
        tracks = np.flatnonzero(recording.track_ids == ego_id)
        stride = frames_per_tick(recording.frame_rate_hz, dt_s)
        first, last = track_ticks(recording, int(tracks[0]), stride) if len(tracks) else (0, -1)
        if length < 1 or start - history < first or start + length > last:
            raise DataError(
                f"{path}: scenario {recording.name}-{ego_id}-{start} does not fit its recording"
            )
        rows[row] = indices[number], tracks[0], start, length
    return rows
