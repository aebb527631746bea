"""Scenarios that somebody asks for: of any vehicle at any tick, in words, or in a file."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Bool

from asp_env.data.classes import PREDICTED, AgentClass
from asp_env.data.clock import frames_per_tick
from asp_env.data.recording import Recording
from asp_env.data.scenario import (
    MAX_LENGTH_S,
    Scenario,
    ScenarioSet,
    find_scenarios,
    make_scenarios,
    track_ticks,
)
from asp_env.data.scenario_file import SUFFIX, load_scenarios
from asp_env.data.scenario_filter import ScenarioFilter
from asp_env.data.source import Recordings
from asp_env.errors import AspEnvError


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
