"""Scenario sets in files, so that others can drive the very same ones.

A file is JSON: the tick, the history, of each recording its name and the hash of its content, and
of each scenario its recording, ego, start, length and seed. Tags and columns are worked out anew
when it is read, so that they are never those of older rules.
"""

import json
import os
from pathlib import Path
from typing import Any

import numpy as np

from asp_env.data.clock import frames_per_tick
from asp_env.data.scenario import ScenarioSet, make_scenarios, track_ticks
from asp_env.data.source import Recordings
from asp_env.errors import DataError

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
    aside = path.with_name(f".{path.name}.{os.getpid()}.partial")
    try:
        aside.write_text(text)
        aside.replace(path)
    finally:
        aside.unlink(missing_ok=True)


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
