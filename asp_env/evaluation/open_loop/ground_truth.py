"""Ground truth of snippets: the recorded past and future of targets and of the agents around."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from asp_env.data.recording import Recording, frames_per_tick
from asp_env.data.road_map import RoadMap
from asp_env.data.snippets import Future, SnippetIndex, gather_ticks, gather_window


@dataclass(frozen=True, slots=True, kw_only=True)
class GroundTruth:
    """Recorded states of N targets in B situations, and of all agents there after the present.

    A situation is a tick of a recording; several targets may be of the same situation. States are
    [x, y, heading, speed] in m, m, rad and m/s.
    """

    states: Float[np.ndarray, "n ticks 4"]
    """States of the targets: past, present, future."""
    valid: Bool[np.ndarray, "n ticks"]
    now: int
    """Index of the present among the ticks."""
    sizes: Float[np.ndarray, "n 2"]
    """Length and width of the targets in metres."""
    classes: Int[np.ndarray, " n"]
    """`AgentClass` of the targets."""
    maps: tuple[RoadMap, ...]
    map_index: Int[np.ndarray, " n"]
    """Index of each target's map in `maps`."""
    situation: Int[np.ndarray, " n"]
    """Index of each target's situation."""
    slot: Int[np.ndarray, " n"]
    """Index of the target among the agents of its situation; -1 if it has no later state."""
    agents: Float[np.ndarray, "b a steps 4"]
    """States after the present of all agents, including those that appear later."""
    agents_valid: Bool[np.ndarray, "b a steps"]
    agents_sizes: Float[np.ndarray, "b a 2"]

    @property
    def present(self) -> Float[np.ndarray, "n 4"]:
        """Present states of the targets."""
        return self.states[:, self.now]

    @property
    def future(self) -> Future:
        """Future states of the targets."""
        return Future(states=self.states[:, self.now + 1 :], valid=self.valid[:, self.now + 1 :])


def gather_ground_truth(recordings: Sequence[Any], index: SnippetIndex) -> GroundTruth:
    """The ground truth of snippets.

    Args:
        recordings: the recordings that the index refers to.
        index: N snippets; the targets are in the same order.
    """
    keys = np.stack([index.recording, index.tick], axis=-1)
    situations, inverse = np.unique(keys, axis=0, return_inverse=True)
    offsets = np.arange(-index.history, index.horizon_ticks + 1)
    states, valid = gather_ticks(recordings, index, offsets)
    sizes = np.zeros((len(index), 2), dtype=np.float32)
    classes = np.zeros(len(index), dtype=np.int64)
    slot = np.full(len(index), -1)
    map_index = np.zeros(len(index), dtype=np.int64)
    maps: list[RoadMap] = []
    around: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []
    for number in np.unique(index.recording):
        recording = recordings[int(number)]
        rows = np.flatnonzero(index.recording == number)
        track = index.track[rows]
        sizes[rows], classes[rows] = recording.sizes[track], recording.classes[track]
        map_index[rows] = _map_number(maps, recording.road_map)
        for tick in situations[situations[:, 0] == number, 1]:
            tracks, agents, present = _agents_after(recording, int(tick), index)
            targets = rows[index.tick[rows] == tick]
            same = index.track[targets][:, None] == tracks
            slot[targets] = np.where(same.any(axis=1), same.argmax(axis=1), -1)
            around.append((recording.sizes[tracks], agents, present))
    shape = (len(situations), max((len(each[0]) for each in around), default=0))
    agents_sizes = np.zeros((*shape, 2), dtype=np.float32)
    agents = np.zeros((*shape, index.horizon_ticks, 4), dtype=np.float32)
    agents_valid = np.zeros((*shape, index.horizon_ticks), dtype=bool)
    for number, each in enumerate(around):
        count = len(each[0])
        agents_sizes[number, :count], agents[number, :count], agents_valid[number, :count] = each
    return GroundTruth(
        states=states,
        valid=valid,
        now=index.history,
        sizes=sizes,
        classes=classes,
        maps=tuple(maps),
        map_index=map_index,
        situation=inverse.reshape(-1),
        slot=slot,
        agents=agents,
        agents_valid=agents_valid,
        agents_sizes=agents_sizes,
    )


def _agents_after(
    recording: Recording, tick: int, index: SnippetIndex
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Tracks (a), states (a, steps, 4) and presence (a, steps) of all agents after a tick."""
    stride = frames_per_tick(recording.frame_rate_hz, index.dt_s)
    tracks = recording.tracks_between((tick + 1) * stride, (tick + index.horizon_ticks) * stride)
    window = gather_window(
        recording, tracks, first_tick=tick + 1, num_ticks=index.horizon_ticks, stride=stride
    )
    return (tracks, *window)


def _map_number(maps: list[RoadMap], road_map: RoadMap) -> int:
    """Index of a map in the list, to which it is appended if it is new."""
    for number, other in enumerate(maps):
        if other is road_map:
            return number
    maps.append(road_map)
    return len(maps) - 1
