"""What was recorded around snippets: all that forecasts are judged by."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from asp_env.data.clock import frames_per_tick
from asp_env.data.recording import Recording
from asp_env.data.road_map import RoadMap
from asp_env.data.snippets import Future, SnippetIndex, gather_ticks, gather_window


@dataclass(frozen=True, slots=True, kw_only=True)
class Recorded:
    """N targets before and after now, and everybody around them afterwards.

    Situations are the distinct ticks of the recordings that the targets are from.
    """

    states: Float[np.ndarray, "n ticks 4"]
    """Of the targets: past, present, future."""
    valid: Bool[np.ndarray, "n ticks"]
    now: int
    """The tick of the present."""
    sizes: Float[np.ndarray, "n 2"]
    classes: Int[np.ndarray, " n"]
    maps: tuple[RoadMap, ...]
    map_index: Int[np.ndarray, " n"]
    situation: Int[np.ndarray, " n"]
    slot: Int[np.ndarray, " n"]
    """The target's own, in its situation; -1 if it is not there after now."""
    others: Float[np.ndarray, "b a steps 4"]
    """Everybody's states after now, whenever they came into view."""
    others_valid: Bool[np.ndarray, "b a steps"]
    others_sizes: Float[np.ndarray, "b a 2"]

    @property
    def present(self) -> Float[np.ndarray, "n 4"]:
        """The targets' states now."""
        return self.states[:, self.now]

    @property
    def future(self) -> Future:
        """What the targets went on to do."""
        return Future(states=self.states[:, self.now + 1 :], valid=self.valid[:, self.now + 1 :])


def gather_recorded(recordings: Sequence[Any], index: SnippetIndex) -> Recorded:
    """What the recordings hold of some snippets, targets in the index's order."""
    keys = np.stack([index.recording, index.tick], axis=-1)
    found, inverse = np.unique(keys, axis=0, return_inverse=True)
    situation = inverse.reshape(-1)
    offsets = np.arange(-index.history, index.horizon + 1)
    states, valid = gather_ticks(recordings, index, offsets)
    sizes = np.zeros((len(index), 2), dtype=np.float32)
    classes = np.zeros(len(index), dtype=np.int64)
    slot = np.full(len(index), -1)
    map_index = np.zeros(len(index), dtype=np.int64)
    maps: list[RoadMap] = []
    around: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []
    for number in np.unique(index.recording):
        recording = recordings[int(number)]
        mine = np.flatnonzero(index.recording == number)
        track = index.track[mine]
        sizes[mine], classes[mine] = recording.sizes[track], recording.classes[track]
        map_index[mine] = _place(maps, recording.road_map)
        for tick in found[found[:, 0] == number, 1]:
            tracks, others, there = _after(recording, int(tick), index)
            rows = mine[index.tick[mine] == tick]
            same = index.track[rows][:, None] == tracks
            slot[rows] = np.where(same.any(axis=1), same.argmax(axis=1), -1)
            around.append((recording.sizes[tracks], others, there))
    shape = (len(found), max((len(each[0]) for each in around), default=0))
    others_sizes = np.zeros((*shape, 2), dtype=np.float32)
    others = np.zeros((*shape, index.horizon, 4), dtype=np.float32)
    others_valid = np.zeros((*shape, index.horizon), dtype=bool)
    for number, each in enumerate(around):
        count = len(each[0])
        others_sizes[number, :count], others[number, :count], others_valid[number, :count] = each
    return Recorded(
        states=states,
        valid=valid,
        now=index.history,
        sizes=sizes,
        classes=classes,
        maps=tuple(maps),
        map_index=map_index,
        situation=situation,
        slot=slot,
        others=others,
        others_valid=others_valid,
        others_sizes=others_sizes,
    )


def _after(
    recording: Recording, tick: int, index: SnippetIndex
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(tracks, states, presence) of everybody seen after a tick."""
    stride = frames_per_tick(recording.frame_rate_hz, index.dt_s)
    tracks = recording.tracks_between((tick + 1) * stride, (tick + index.horizon) * stride)
    window = gather_window(
        recording, tracks, first_tick=tick + 1, num_ticks=index.horizon, stride=stride
    )
    return (tracks, *window)


def _place(maps: list[RoadMap], road_map: RoadMap) -> int:
    for number, known in enumerate(maps):
        if known is road_map:
            return number
    maps.append(road_map)
    return len(maps) - 1
