"""Snippets: the past and future around one tick of one track, stored as indices into recordings."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from asp_env.data.recording import Recording, frames_per_tick, ticks
from asp_env.data.scene import Scene, infer_actions
from asp_env.data.signals import SceneSignals, SignalState

HISTORY_S = 3.0
"""Default history of snippets and scenarios."""

SNIPPET_INTERVAL_S = 0.6
"""Time between consecutive snippets of a track."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SnippetIndex:
    """A table of snippets, each of which has its full history and future in its recording."""

    recording: Int[np.ndarray, " n"]
    """Index into the recordings from which the table was made."""
    track: Int[np.ndarray, " n"]
    """Index of the target's track."""
    tick: Int[np.ndarray, " n"]
    """The present tick. A snippet spans the ticks [tick - history, tick + horizon_ticks]."""
    dt_s: float
    """Seconds per tick."""
    history: int
    """Number of past ticks."""
    horizon_ticks: int
    """Number of future ticks."""

    def __len__(self) -> int:
        """Number of snippets."""
        return len(self.tick)

    def select(self, rows: Int[np.ndarray, " m"] | Bool[np.ndarray, " n"]) -> "SnippetIndex":
        """The snippets at the given rows, in that order, or those of a mask."""
        return SnippetIndex(
            recording=self.recording[rows],
            track=self.track[rows],
            tick=self.tick[rows],
            dt_s=self.dt_s,
            history=self.history,
            horizon_ticks=self.horizon_ticks,
        )

    def shifted(self, ticks: int) -> "SnippetIndex":
        """The same targets some ticks later, with a horizon shorter by as many ticks."""
        return SnippetIndex(
            recording=self.recording,
            track=self.track,
            tick=self.tick + ticks,
            dt_s=self.dt_s,
            history=self.history,
            horizon_ticks=self.horizon_ticks - ticks,
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class Future:
    """Recorded futures of a scene's targets, for labels and privileged predictors only."""

    states: Float[np.ndarray, "t steps 4"]
    """[x m, y m, heading rad, speed m/s]; step 0 is one tick after the scene."""
    valid: Bool[np.ndarray, "t steps"]


def find_snippets(
    recording: Recording,
    *,
    dt_s: float,
    history: int,
    horizon_ticks: int,
    interval_ticks: int,
    parked: bool = False,
) -> tuple[Int[np.ndarray, " n"], Int[np.ndarray, " n"]]:
    """All snippets of one recording, whose targets are of a predicted class.

    Args:
        recording: the recording.
        dt_s: seconds per tick.
        history: number of past ticks.
        horizon_ticks: number of future ticks.
        interval_ticks: snippets are at multiples of this tick.
        parked: whether parked agents are targets, too.

    Returns:
        Track index and tick of each snippet, sorted by tick, then track.
    """
    stride = frames_per_tick(recording.frame_rate_hz, dt_s)
    tracks, present_ticks = [], []
    targets = recording.of_predicted_class if parked else recording.predicted
    for track in np.flatnonzero(targets):
        first = -(-int(recording.first_frames[track]) // stride) + history
        last = int(recording.last_frames[track]) // stride - horizon_ticks
        found = np.arange(-(-first // interval_ticks) * interval_ticks, last + 1, interval_ticks)
        present_ticks.append(found)
        tracks.append(np.full(len(found), track))
    if not tracks:
        return np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64)
    track, tick = np.concatenate(tracks), np.concatenate(present_ticks)
    order = np.lexsort((track, tick))
    return track[order], tick[order]


def index_snippets(
    recordings: Sequence[Recording],
    *,
    dt_s: float,
    horizon_s: float,
    history_s: float = HISTORY_S,
    interval_s: float = SNIPPET_INTERVAL_S,
    parked: bool = False,
) -> SnippetIndex:
    """All snippets of all recordings, sorted by recording, tick and track.

    Args:
        recordings: the recordings.
        dt_s: seconds per tick.
        horizon_s: length of the future in seconds.
        history_s: length of the past in seconds.
        interval_s: time between consecutive snippets of a track.
        parked: whether parked agents are targets, too.

    Raises:
        AspEnvError: a duration is not a whole number of ticks, or a tick not one of frames.
    """
    history, horizon_ticks = ticks(history_s, dt_s), ticks(horizon_s, dt_s)
    interval_ticks = ticks(interval_s, dt_s)
    parts = [
        find_snippets(
            recording,
            dt_s=dt_s,
            history=history,
            horizon_ticks=horizon_ticks,
            interval_ticks=interval_ticks,
            parked=parked,
        )
        for recording in recordings
    ]
    counts = [len(tick) for _, tick in parts]
    empty = [np.zeros(0, dtype=np.int64)]
    return SnippetIndex(
        recording=np.repeat(np.arange(len(parts)), counts),
        track=np.concatenate(empty + [track for track, _ in parts]),
        tick=np.concatenate(empty + [tick for _, tick in parts]),
        dt_s=dt_s,
        history=history,
        horizon_ticks=horizon_ticks,
    )


def gather_window(
    recording: Recording,
    tracks: Int[np.ndarray, " a"],
    *,
    first_tick: int,
    num_ticks: int,
    stride: int,
) -> tuple[Float[np.ndarray, "a k 4"], Bool[np.ndarray, "a k"]]:
    """States of some tracks at consecutive ticks.

    Args:
        recording: the recording.
        tracks: indices of the tracks.
        first_tick: the first of the ticks.
        num_ticks: number of ticks.
        stride: frames per tick.

    Returns:
        States [x m, y m, heading rad, speed m/s], zero where absent, and the mask of presence.
    """
    frames = (first_tick + np.arange(num_ticks)) * stride
    first = recording.first_frames[tracks].astype(np.int64)[:, None]
    valid = (frames >= first) & (frames <= recording.last_frames[tracks][:, None])
    rows = np.where(valid, recording.starts[tracks][:, None] + frames - first, 0)
    states = recording.states[rows]
    states[~valid] = 0
    return states, valid


def gather_accelerations(
    recording: Recording,
    tracks: Int[np.ndarray, " a"],
    *,
    first_tick: int,
    num_ticks: int,
    stride: int,
) -> Float[np.ndarray, "a k"]:
    """Recorded accelerations of some tracks between consecutive ticks, m/s².

    Each is the mean over the frames from one tick to the next, both of which count half, so that it
    is the change of speed that the files state for this time.

    Args:
        recording: the recording, whose `accelerations` are known.
        tracks: indices of the tracks.
        first_tick: the first of the ticks.
        num_ticks: number of ticks, k + 1.
        stride: frames per tick.

    Returns:
        The accelerations, zero where the track is absent at either tick.
    """
    assert recording.accelerations is not None
    frames = first_tick * stride + np.arange((num_ticks - 1) * stride + 1)
    first = recording.first_frames[tracks].astype(np.int64)[:, None]
    present = (frames >= first) & (frames <= recording.last_frames[tracks][:, None])
    rows = np.where(present, recording.starts[tracks][:, None] + frames - first, 0)
    values = recording.accelerations[rows]
    halves = 0.5 * (values[:, :-1] + values[:, 1:])
    means = halves.reshape(len(tracks), num_ticks - 1, stride).mean(axis=-1)
    both = present[:, :-1:stride] & present[:, stride::stride]
    return np.where(both, means, 0).astype(np.float32)


def gather_scene(recordings: Sequence[Recording], index: SnippetIndex) -> Scene:
    """The scene of some snippets: one situation per distinct tick of a recording.

    Slot 0 of a situation is its first target in the order of `index`; the other agents follow by
    first frame, then id. The ego's route is empty, since here its path is what is to be forecast.
    Past actions are inferred from the states; their accelerations are the recorded ones where
    `Recording.shows_accelerations`.

    Returns:
        A scene whose targets are in the order of `index`.
    """
    keys = np.stack([index.recording, index.tick], axis=-1)
    _, first_rows, inverse = np.unique(keys, axis=0, return_index=True, return_inverse=True)
    situation = inverse.reshape(-1)
    agents = [_agents(recordings[int(index.recording[row])], index, int(row)) for row in first_rows]
    shape = (len(agents), max((len(tracks) for tracks in agents), default=1))
    states = np.zeros((*shape, index.history + 1, 4), dtype=np.float32)
    valid = np.zeros((*shape, index.history + 1), dtype=bool)
    sizes = np.zeros((*shape, 2), dtype=np.float32)
    classes = np.zeros(shape, dtype=np.int32)
    ids = np.full(shape, -1, dtype=np.int64)
    slots = np.full(len(index), -1)
    for number, (row, tracks) in enumerate(zip(first_rows, agents, strict=True)):
        recording = recordings[int(index.recording[row])]
        count = len(tracks)
        states[number, :count], valid[number, :count] = gather_window(
            recording,
            tracks,
            first_tick=int(index.tick[row]) - index.history,
            num_ticks=index.history + 1,
            stride=frames_per_tick(recording.frame_rate_hz, index.dt_s),
        )
        sizes[number, :count] = recording.sizes[tracks]
        classes[number, :count] = recording.classes[tracks]
        ids[number, :count] = recording.track_ids[tracks]
        rows = np.flatnonzero(situation == number)
        slots[rows] = (index.track[rows][:, None] == tracks[None]).argmax(axis=1)
    actions = infer_actions(states, valid, sizes[..., 0], index.dt_s)
    for number, (row, tracks) in enumerate(zip(first_rows, agents, strict=True)):
        recording = recordings[int(index.recording[row])]
        if recording.shows_accelerations:
            actions[number, : len(tracks), :, 0] = gather_accelerations(
                recording,
                tracks,
                first_tick=int(index.tick[row]) - index.history,
                num_ticks=index.history + 1,
                stride=frames_per_tick(recording.frame_rate_hz, index.dt_s),
            )
    maps, map_index = _maps([recordings[int(index.recording[row])] for row in first_rows])
    return Scene(
        states=states,
        actions=actions,
        valid=valid,
        sizes=sizes,
        classes=classes,
        ids=ids,
        tick=index.tick[first_rows],
        targets=np.stack([situation, slots], axis=-1),
        route=np.zeros((shape[0], 0, 2), dtype=np.float32),
        route_valid=np.zeros((shape[0], 0), dtype=bool),
        maps=maps,
        map_index=map_index,
        dt_s=index.dt_s,
        signals=gather_signals(
            [recordings[int(index.recording[row])] for row in first_rows],
            index.tick[first_rows],
            history=index.history,
            dt_s=index.dt_s,
        ),
    )


def gather_signals(
    recordings: Sequence[Recording], tick: Int[np.ndarray, " b"], *, history: int, dt_s: float
) -> SceneSignals | None:
    """The traffic signals of B situations, up to their present ticks.

    Args:
        recordings: the recording of each situation.
        tick: the present tick of each situation.
        history: number of past ticks.
        dt_s: seconds per tick.

    Returns:
        The signals whose stop lines are known, `UNKNOWN` at ticks outside a recording; None if no
        recording has any.
    """
    count = max(
        (int(r.signals.placed.sum()) for r in recordings if r.signals is not None), default=0
    )
    if not count:
        return None
    stop_lines = np.zeros((len(recordings), count, 2, 2))
    states = np.full((len(recordings), count, history + 1), SignalState.UNKNOWN, dtype=np.int8)
    for row, (recording, now) in enumerate(zip(recordings, tick.tolist(), strict=True)):
        if recording.signals is None:
            continue
        stride = frames_per_tick(recording.frame_rate_hz, dt_s)
        frames = (now + np.arange(-history, 1)) * stride
        known = (frames >= 0) & (frames < recording.num_frames)
        placed = recording.signals.placed
        signals = int(placed.sum())
        stop_lines[row, :signals] = recording.signals.stop_lines[placed]
        states[row, :signals, known] = recording.signals.states[placed][:, frames[known]].T
    return SceneSignals(stop_lines=stop_lines, states=states)


def gather_future(recordings: Sequence[Recording], index: SnippetIndex) -> Future:
    """The recorded futures of the targets of `gather_scene`."""
    states, valid = gather_ticks(recordings, index, 1 + np.arange(index.horizon_ticks))
    return Future(states=states, valid=valid)


def gather_present(
    recordings: Sequence[Recording], index: SnippetIndex
) -> tuple[Float[np.ndarray, "n 4"], Float[np.ndarray, " n"]]:
    """Present states and lengths (m) of the targets, as in `gather_scene` but without the scene."""
    states, _ = gather_ticks(recordings, index, np.zeros(1, dtype=np.int64))
    lengths_m = np.zeros(len(index), dtype=np.float32)
    for number in np.unique(index.recording):
        rows = index.recording == number
        lengths_m[rows] = recordings[int(number)].sizes[index.track[rows], 0]
    return states[:, 0], lengths_m


def gather_ticks(
    recordings: Sequence[Recording], index: SnippetIndex, offsets: Int[np.ndarray, " steps"]
) -> tuple[Float[np.ndarray, "n steps 4"], Bool[np.ndarray, "n steps"]]:
    """States of the targets at given offsets from the present tick.

    Args:
        recordings: the recordings from which `index` was made.
        index: the snippets.
        offsets: in ticks; negative ones lie in the past.

    Returns:
        States [x m, y m, heading rad, speed m/s], zero where absent, and the mask of presence.
    """
    states = np.zeros((len(index), len(offsets), 4), dtype=np.float32)
    valid = np.zeros((len(index), len(offsets)), dtype=bool)
    for number in np.unique(index.recording):
        rows = np.flatnonzero(index.recording == number)
        recording = recordings[int(number)]
        stride = frames_per_tick(recording.frame_rate_hz, index.dt_s)
        frames = (index.tick[rows][:, None] + offsets) * stride
        track = index.track[rows]
        first = recording.first_frames[track].astype(np.int64)[:, None]
        present = (frames >= first) & (frames <= recording.last_frames[track][:, None])
        table_rows = np.where(present, recording.starts[track][:, None] + frames - first, 0)
        states[rows] = np.where(present[..., None], recording.states[table_rows], 0)
        valid[rows] = present
    return states, valid


def _agents(recording: Recording, index: SnippetIndex, row: int) -> Int[np.ndarray, " a"]:
    """Tracks of one situation: its first target, then all others within the history."""
    stride = frames_per_tick(recording.frame_rate_hz, index.dt_s)
    now = int(index.tick[row])
    present = recording.tracks_between((now - index.history) * stride, now * stride)
    first = index.track[row]
    return np.concatenate([[first], present[present != first]])


def _maps(recordings: Sequence[Recording]) -> tuple[tuple, Int[np.ndarray, " b"]]:
    maps: list = []
    numbers: dict[int, int] = {}
    for recording in recordings:
        if id(recording.road_map) not in numbers:
            numbers[id(recording.road_map)] = len(maps)
            maps.append(recording.road_map)
    return tuple(maps), np.array([numbers[id(r.road_map)] for r in recordings], dtype=np.int64)
