"""Snippets: a past and a future around one tick of one track, kept as integers, never as copies."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from asp_env.data.recording import Recording, frames_per_tick, ticks
from asp_env.data.scene import Scene, infer_actions

HISTORY_S = 3.0
EVERY_S = 0.6


@dataclass(frozen=True, slots=True, kw_only=True)
class SnippetIndex:
    """Which target at which tick of which recording; every snippet has its full past and future."""

    recording: Int[np.ndarray, " n"]
    """Index into the recordings it was made from."""
    track: Int[np.ndarray, " n"]
    """Index of the target's track."""
    tick: Int[np.ndarray, " n"]
    """Now. The snippet spans the ticks [tick - history, tick + horizon]."""
    dt_s: float
    history: int
    horizon: int

    def __len__(self) -> int:
        """How many there are."""
        return len(self.tick)

    def select(self, rows: Int[np.ndarray, " m"] | Bool[np.ndarray, " n"]) -> "SnippetIndex":
        """The snippets at some rows, in their order."""
        return SnippetIndex(
            recording=self.recording[rows],
            track=self.track[rows],
            tick=self.tick[rows],
            dt_s=self.dt_s,
            history=self.history,
            horizon=self.horizon,
        )

    def shifted(self, ticks: int) -> "SnippetIndex":
        """The same targets some ticks later, of whose future so much less is known."""
        return SnippetIndex(
            recording=self.recording,
            track=self.track,
            tick=self.tick + ticks,
            dt_s=self.dt_s,
            history=self.history,
            horizon=self.horizon - ticks,
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class Future:
    """What the targets of a scene went on to do: for labels, and for privileged plugs alone."""

    states: Float[np.ndarray, "t steps 4"]
    valid: Bool[np.ndarray, "t steps"]


def find_snippets(
    recording: Recording, *, dt_s: float, history: int, horizon: int, every: int
) -> tuple[Int[np.ndarray, " n"], Int[np.ndarray, " n"]]:
    """(track, tick) of all snippets of one recording, ordered by tick, then track.

    Targets are tracks of a predicted class that are not parked; ticks are multiples of `every`.
    """
    stride = frames_per_tick(recording.frame_rate_hz, dt_s)
    tracks, at = [], []
    for track in np.flatnonzero(recording.predicted):
        first = -(-int(recording.first_frames[track]) // stride) + history
        last = int(recording.last_frames[track]) // stride - horizon
        found = np.arange(-(-first // every) * every, last + 1, every)
        at.append(found)
        tracks.append(np.full(len(found), track))
    if not at:
        return np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64)
    track, tick = np.concatenate(tracks), np.concatenate(at)
    order = np.lexsort((track, tick))
    return track[order], tick[order]


def index_snippets(
    recordings: Sequence[Recording],
    *,
    dt_s: float,
    horizon_s: float,
    history_s: float = HISTORY_S,
    every_s: float = EVERY_S,
) -> SnippetIndex:
    """All snippets of all recordings, ordered by recording, tick, track."""
    history, horizon = ticks(history_s, dt_s), ticks(horizon_s, dt_s)
    every = ticks(every_s, dt_s)
    parts = [
        find_snippets(recording, dt_s=dt_s, history=history, horizon=horizon, every=every)
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
        horizon=horizon,
    )


def gather_window(
    recording: Recording,
    tracks: Int[np.ndarray, " a"],
    *,
    first_tick: int,
    num_ticks: int,
    stride: int,
) -> tuple[Float[np.ndarray, "a k 4"], Bool[np.ndarray, "a k"]]:
    """States and presence of some tracks at consecutive ticks; zeros where absent."""
    frames = (first_tick + np.arange(num_ticks)) * stride
    first = recording.first_frames[tracks].astype(np.int64)[:, None]
    valid = (frames >= first) & (frames <= recording.last_frames[tracks][:, None])
    rows = np.where(valid, recording.starts[tracks][:, None] + frames - first, 0)
    states = recording.states[rows]
    states[~valid] = 0
    return states, valid


def gather_scene(recordings: Sequence[Recording], index: SnippetIndex) -> Scene:
    """The scene of some snippets: one situation per distinct tick, targets in the index's order.

    In each situation slot 0 is its first target, the rest follow by first appearance, then id.
    The ego's route is left empty, since here the ego's way is what is to be forecast.
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
        mine = np.flatnonzero(situation == number)
        slots[mine] = (index.track[mine][:, None] == tracks[None]).argmax(axis=1)
    maps, map_index = _maps([recordings[int(index.recording[row])] for row in first_rows])
    return Scene(
        states=states,
        actions=infer_actions(states, valid, sizes[..., 0], index.dt_s),
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
    )


def gather_future(recordings: Sequence[Recording], index: SnippetIndex) -> Future:
    """What the targets of `gather_scene` went on to do."""
    states, valid = gather_ticks(recordings, index, 1 + np.arange(index.horizon))
    return Future(states=states, valid=valid)


def gather_present(
    recordings: Sequence[Recording], index: SnippetIndex
) -> tuple[Float[np.ndarray, "n 4"], Float[np.ndarray, " n"]]:
    """The targets' states and lengths now: what `gather_scene` says of them, without the scene."""
    states, _ = gather_ticks(recordings, index, np.zeros(1, dtype=np.int64))
    lengths = np.zeros(len(index), dtype=np.float32)
    for number in np.unique(index.recording):
        mine = index.recording == number
        lengths[mine] = recordings[int(number)].sizes[index.track[mine], 0]
    return states[:, 0], lengths


def gather_ticks(
    recordings: Sequence[Recording], index: SnippetIndex, offsets: Int[np.ndarray, " steps"]
) -> tuple[Float[np.ndarray, "n steps 4"], Bool[np.ndarray, "n steps"]]:
    """The targets' states some ticks from now, and whether they were there; zeros where not.

    Args:
        recordings: what the snippets are of.
        index: the snippets.
        offsets: in ticks, negative ones before now.
    """
    states = np.zeros((len(index), len(offsets), 4), dtype=np.float32)
    valid = np.zeros((len(index), len(offsets)), dtype=bool)
    for number in np.unique(index.recording):
        mine = np.flatnonzero(index.recording == number)
        recording = recordings[int(number)]
        stride = frames_per_tick(recording.frame_rate_hz, index.dt_s)
        frames = (index.tick[mine][:, None] + offsets) * stride
        track = index.track[mine]
        first = recording.first_frames[track].astype(np.int64)[:, None]
        there = (frames >= first) & (frames <= recording.last_frames[track][:, None])
        rows = np.where(there, recording.starts[track][:, None] + frames - first, 0)
        states[mine] = np.where(there[..., None], recording.states[rows], 0)
        valid[mine] = there
    return states, valid


def _agents(recording: Recording, index: SnippetIndex, row: int) -> Int[np.ndarray, " a"]:
    stride = frames_per_tick(recording.frame_rate_hz, index.dt_s)
    now = int(index.tick[row])
    seen = recording.tracks_between((now - index.history) * stride, now * stride)
    first = index.track[row]
    return np.concatenate([[first], seen[seen != first]])


def _maps(recordings: Sequence[Recording]) -> tuple[tuple, Int[np.ndarray, " b"]]:
    maps: list = []
    numbers: dict[int, int] = {}
    for recording in recordings:
        if id(recording.road_map) not in numbers:
            numbers[id(recording.road_map)] = len(maps)
            maps.append(recording.road_map)
    return tuple(maps), np.array([numbers[id(r.road_map)] for r in recordings], dtype=np.int64)
