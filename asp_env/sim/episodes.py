"""The arrays of episodes that run side by side.

MERGED: The compiled inner loops of a replay world: writing a tick, and reading the last few.
MERGED: How episodes begin: what recordings hold of their scenarios.
"""

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import no_type_check

import numpy as np
from jaxtyping import Bool, Float, Int
from numba import njit

from asp_env.data.recording import Recording, frames_per_tick
from asp_env.data.scenarios.scenario import Scenario
from asp_env.data.scene import EGO
from asp_env.errors import AspEnvError
from asp_env.geometry import route_along, route_coordinates
from asp_env.metrics.boxes import ego_contacts, touching_trailers
from asp_env.metrics.drivable import log_off_road_m


@dataclass(slots=True, kw_only=True)
class Episodes:
    """The arrays of B episodes with A slots over K = history + 1 + longest episode ticks.

    Slots are sorted ego first, then by first appearance, then id. Time is the second axis, so
    that one tick of an episode lies together in memory.
    """

    states: Float[np.ndarray, "b k a 4"]
    """What happens here: the recorded past, then what the steps make of it."""
    valid: Bool[np.ndarray, "b k a"]
    actions: Float[np.ndarray, "b k a 2"]
    """The action inferred between each tick and the next, zero unless both are valid."""
    inferred: Int[np.ndarray, " b"]
    """How many ticks of `actions` are known; they are inferred when a scene shows them."""
    log_states: Float[np.ndarray, "b k a 4"]
    """What the recording holds."""
    log_valid: Bool[np.ndarray, "b k a"]
    gone: Bool[np.ndarray, "b a"]
    """Agents that have left for good."""
    sizes: Float[np.ndarray, "b a 2"]
    classes: Int[np.ndarray, "b a"]
    ids: Int[np.ndarray, "b a"]
    parked: Bool[np.ndarray, "b a"]
    tracks: Int[np.ndarray, "b a"]
    """Index of each agent's track in its recording."""
    route: Float[np.ndarray, "b p 2"]
    route_valid: Bool[np.ndarray, "b p"]
    log_off_road_m: Float[np.ndarray, "b p"]
    """How far off the road the logged ego itself is near each point of its route."""
    on_route: Float[np.ndarray, "b 3"]
    """The ego's arc length m, offset to the left m, and the route's heading rad there."""
    contacts: Int[np.ndarray, "b a"]
    """`Contact` of the ego with each agent; one that lasts keeps the class of its first tick."""
    own_trailer: Bool[np.ndarray, "b a"]
    """Trailers that touch the ego at the first tick: its own, with which it has no contact."""
    goal_m: Float[np.ndarray, " b"]
    recording: Int[np.ndarray, " b"]
    start_tick: Int[np.ndarray, " b"]
    elapsed: Int[np.ndarray, " b"]
    length: Int[np.ndarray, " b"]

    def copy(self) -> "Episodes":
        """A deep copy."""
        return Episodes(**{name: getattr(self, name).copy() for name in _NAMES})

    def clear(self, row: int) -> None:
        """Makes one episode all padding."""
        for name in _NAMES:
            getattr(self, name)[row] = _FILL.get(name, 0)

    def with_room(self, *, ticks: int, agents: int, points: int) -> "Episodes":
        """These episodes, or a larger copy where the given sizes ask for more."""
        have = self.valid.shape[1], self.valid.shape[2], self.route.shape[1]
        need = max(have[0], ticks), max(have[1], agents), max(have[2], points)
        if need == have:
            return self
        larger = no_episodes(len(self.length), ticks=need[0], agents=need[1], points=need[2])
        for name in _NAMES:
            value = getattr(self, name)
            getattr(larger, name)[tuple(map(slice, value.shape))] = value
        return larger


_NAMES = tuple(field.name for field in dataclasses.fields(Episodes))
_FILL = {"ids": -1, "tracks": -1}


def no_episodes(num_episodes: int, *, ticks: int, agents: int, points: int) -> Episodes:
    """Room for episodes that have not begun."""
    b, k, a, p = num_episodes, ticks, agents, points
    return Episodes(
        states=np.zeros((b, k, a, 4), dtype=np.float32),
        valid=np.zeros((b, k, a), dtype=bool),
        actions=np.zeros((b, k, a, 2), dtype=np.float32),
        inferred=np.zeros(b, dtype=np.int64),
        log_states=np.zeros((b, k, a, 4), dtype=np.float32),
        log_valid=np.zeros((b, k, a), dtype=bool),
        gone=np.zeros((b, a), dtype=bool),
        sizes=np.zeros((b, a, 2), dtype=np.float32),
        classes=np.zeros((b, a), dtype=np.int32),
        ids=np.full((b, a), -1, dtype=np.int64),
        parked=np.zeros((b, a), dtype=bool),
        tracks=np.full((b, a), -1, dtype=np.int64),
        route=np.zeros((b, p, 2), dtype=np.float32),
        route_valid=np.zeros((b, p), dtype=bool),
        log_off_road_m=np.zeros((b, p), dtype=np.float32),
        on_route=np.zeros((b, 3)),
        contacts=np.zeros((b, a), dtype=np.int8),
        own_trailer=np.zeros((b, a), dtype=bool),
        goal_m=np.zeros(b),
        recording=np.zeros(b, dtype=np.int64),
        start_tick=np.zeros(b, dtype=np.int64),
        elapsed=np.zeros(b, dtype=np.int64),
        length=np.zeros(b, dtype=np.int64),
    )


@njit(cache=True)
@no_type_check
def _gather_controlled(states, sizes, actions, rows, now, obeys, out):
    at = 0
    for i in range(len(rows)):
        b, k = rows[i], now[i]
        for a in range(obeys.shape[1]):
            if obeys[i, a]:
                for field in range(4):
                    out[field, at] = states[b, k, a, field]
                out[4, at], out[5, at] = actions[b, a, 0], actions[b, a, 1]
                out[6, at] = max(sizes[b, a, 0], 0.1)
                at += 1


def gather_controlled(
    data: Episodes,
    rows: Int[np.ndarray, " r"],
    now: Int[np.ndarray, " r"],
    actions: Float[np.ndarray, "b a 2"],
    obeys: Bool[np.ndarray, "r a"],
) -> tuple[
    Float[np.ndarray, "n 4"],
    Float[np.ndarray, "n 2"],
    Float[np.ndarray, " n"],
]:
    """States, actions and lengths of those who obey, row by row.

    Each field lies together in memory, which halves the time of what is computed of them.
    """
    fields = np.empty((7, np.count_nonzero(obeys)), dtype=np.float32)
    _gather_controlled(data.states, data.sizes, actions, rows, now, obeys, fields)
    return fields[:4].T, fields[4:6].T, fields[6]


@njit(cache=True)
@no_type_check
def _write_tick(states, valid, log_states, log_valid, gone, rows, now, driven, obeys, moved):
    at = -1
    for i in range(len(rows)):
        b, k = rows[i], now[i] + 1
        for a in range(valid.shape[2]):
            mine = obeys[i, a]
            at += mine
            there = mine or (log_valid[b, k, a] and not driven[i, a])
            if gone[b, a] or not there:
                valid[b, k, a] = False
                states[b, k, a, :] = 0.0
                continue
            valid[b, k, a] = True
            if mine:
                for field in range(4):
                    states[b, k, a, field] = moved[at, field]
            else:
                for field in range(4):
                    states[b, k, a, field] = log_states[b, k, a, field]


def write_tick(
    data: Episodes,
    rows: Int[np.ndarray, " r"],
    now: Int[np.ndarray, " r"],
    driven: Bool[np.ndarray, "r a"],
    obeys: Bool[np.ndarray, "r a"],
    moved: Float[np.ndarray, "n 4"],
) -> None:
    """Writes the tick after `now` of some episodes.

    Args:
        data: the episodes.
        rows: which of them.
        now: the present tick of each.
        driven: who is not replayed.
        obeys: which of those are there to be moved.
        moved: where to, row by row.
    """
    _write_tick(
        *(data.states, data.valid, data.log_states, data.log_valid, data.gone),
        *(rows, now, driven, obeys, moved),
    )


@njit(cache=True)
@no_type_check
def _last_ticks(states, valid, now, rows, out_states, out_valid):
    """Copies the ticks up to now of some episodes, time by agent to agent by time."""
    agents, ticks = out_valid.shape[1:]
    for i in range(len(rows)):
        b = rows[i]
        first = now[b] + 1 - ticks
        for k in range(ticks):
            for a in range(agents):
                there = valid[b, first + k, a]
                out_valid[i, a, k] = there
                for field in range(4):
                    out_states[i, a, k, field] = states[b, first + k, a, field] if there else 0.0


def last_ticks(
    data: Episodes, now: Int[np.ndarray, " b"], rows: Int[np.ndarray, " r"], history: int
) -> tuple[Float[np.ndarray, "r a ticks 4"], Bool[np.ndarray, "r a ticks"]]:
    """States and presence in some episodes at the last `history` ticks and now, agent by agent."""
    shape = (len(rows), data.ids.shape[1], history + 1)
    states, valid = np.empty((*shape, 4), dtype=np.float32), np.empty(shape, dtype=bool)
    _last_ticks(data.states, data.valid, now, rows, states, valid)
    return states, valid


BEYOND_M = 60.0
"""How far a route goes on straight behind the last recorded position."""


@dataclass(frozen=True, slots=True, kw_only=True)
class EpisodeInit:
    """Who takes part in an episode, where and when."""

    scenario: Scenario
    recording: Recording
    tracks: Int[np.ndarray, " a"]
    """The ego's first, the others' by first appearance, then id."""
    first_frame: int
    """Of the history."""
    stride: int
    """Frames in a tick."""
    ticks: int
    """Of the history, the present, and the scenario."""
    route: Float[np.ndarray, "p 2"]
    log_off_road_m: Float[np.ndarray, " p"]
    """How far off the road the logged ego itself is near each point of its route."""


def initialize(
    recording: Recording, scenario: Scenario, *, dt_s: float, history: int
) -> EpisodeInit:
    """Everybody seen in a scenario or its history.

    Raises:
        AspEnvError: the scenario does not fit the recording.
    """
    stride = frames_per_tick(recording.frame_rate_hz, dt_s)
    found = np.flatnonzero(recording.track_ids == scenario.ego_id)
    if not len(found):
        raise AspEnvError(
            f"scenario {scenario.name}: recording {recording.name} has no track {scenario.ego_id}"
        )
    ego = int(found[0])
    first_tick = scenario.start_tick - history
    last_tick = scenario.start_tick + scenario.length
    if (
        scenario.length < 1
        or first_tick * stride < recording.first_frames[ego]
        or last_tick * stride > recording.last_frames[ego]
    ):
        raise AspEnvError(
            f"scenario {scenario.name}: ticks {first_tick} to {last_tick} are needed, the "
            f"track of the ego spans {-(-int(recording.first_frames[ego]) // stride)} to "
            f"{int(recording.last_frames[ego]) // stride}"
        )
    seen = recording.tracks_between(first_tick * stride, last_tick * stride)
    start = scenario.start_tick * stride - recording.first_frames[ego]
    ahead = recording.track(ego)[start::stride]
    route = route_along(ahead, beyond_m=BEYOND_M)
    return EpisodeInit(
        scenario=scenario,
        recording=recording,
        tracks=np.concatenate([[ego], seen[seen != ego]]),
        first_frame=first_tick * stride,
        stride=stride,
        ticks=history + 1 + scenario.length,
        route=route,
        log_off_road_m=log_off_road_m(recording.road_map, ahead, recording.sizes[ego], route),
    )


def place(
    data: Episodes, rows: Int[np.ndarray, " n"], casts: Sequence[EpisodeInit], history: int
) -> None:
    """Writes episodes at their first tick into arrays that have room for them."""
    driven_m = np.array(
        [_place(data, b, each, history) for b, each in zip(rows.tolist(), casts, strict=True)]
    )
    first, there = data.states[rows, history], data.valid[rows, history]
    last = data.log_states[rows, history + data.length[rows], EGO]
    sizes, route, route_valid = data.sizes[rows], data.route[rows], data.route_valid[rows]
    own_trailer = touching_trailers(first, sizes, data.classes[rows], there)
    data.own_trailer[rows] = own_trailer
    data.contacts[rows] = ego_contacts(first, sizes, there & ~own_trailer)
    start = np.zeros(len(rows))
    data.on_route[rows] = route_coordinates(route, route_valid, first[:, EGO], start)
    data.goal_m[rows] = route_coordinates(route, route_valid, last, driven_m)[:, 0]


def _place(data: Episodes, b: int, init: EpisodeInit, history: int) -> float:
    """Writes one episode; returns how far the logged ego drives, metres."""
    data.clear(b)
    recording, tracks = init.recording, init.tracks
    agents, points = len(tracks), len(init.route)
    data.sizes[b, :agents] = recording.sizes[tracks]
    data.classes[b, :agents] = recording.classes[tracks]
    data.ids[b, :agents] = recording.track_ids[tracks]
    data.parked[b, :agents] = recording.parked[tracks]
    data.tracks[b, :agents] = tracks
    data.route[b, :points] = init.route
    data.route_valid[b, :points] = True
    data.log_off_road_m[b, :points] = init.log_off_road_m
    data.recording[b] = init.scenario.recording
    data.start_tick[b], data.length[b] = init.scenario.start_tick, init.scenario.length
    return _copy_tracks(
        recording.states,
        recording.starts[tracks],
        recording.first_frames[tracks].astype(np.int64),
        recording.last_frames[tracks].astype(np.int64),
        *(init.first_frame, init.stride, init.ticks, history),
        *(data.log_states[b], data.log_valid[b], data.states[b], data.valid[b]),
    )


@njit(cache=True)
@no_type_check
def _copy_tracks(
    rows, starts, first, last, first_frame, stride, ticks, history,
    log_states, log_valid, states, valid,
):  # fmt: skip
    """Copies tracks into cleared arrays, time by time; the length of the ego's way after now."""
    for a in range(len(starts)):
        for k in range(ticks):
            frame = first_frame + k * stride
            if not first[a] <= frame <= last[a]:
                continue
            row = starts[a] + frame - first[a]
            log_valid[k, a] = True
            for field in range(4):
                log_states[k, a, field] = rows[row, field]
            if k <= history:
                valid[k, a] = True
                for field in range(4):
                    states[k, a, field] = rows[row, field]
    way = 0.0
    for k in range(history, ticks - 1):
        way += math.hypot(
            log_states[k + 1, 0, 0] - log_states[k, 0, 0],
            log_states[k + 1, 0, 1] - log_states[k, 0, 1],
        )
    return way
