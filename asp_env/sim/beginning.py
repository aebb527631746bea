"""How episodes begin: what recordings hold of their scenarios."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import no_type_check

import numpy as np
from jaxtyping import Float, Int
from numba import njit

from asp_env.data.clock import frames_per_tick
from asp_env.data.geometry import route_along
from asp_env.data.recording import Recording
from asp_env.data.scenario import Scenario
from asp_env.errors import AspEnvError
from asp_env.metrics.boxes import ego_contacts, touching_trailers
from asp_env.metrics.drivable import log_off_road_m
from asp_env.metrics.route import route_coordinates
from asp_env.sim.episodes import Episodes
from asp_env.sim.world import EGO

BEYOND_M = 60.0
"""How far a route goes on straight behind the last recorded position."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Cast:
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


def cast(recording: Recording, scenario: Scenario, *, dt_s: float, history: int) -> Cast:
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
    return Cast(
        scenario=scenario,
        recording=recording,
        tracks=np.concatenate([[ego], seen[seen != ego]]),
        first_frame=first_tick * stride,
        stride=stride,
        ticks=history + 1 + scenario.length,
        route=route,
        log_off_road_m=log_off_road_m(recording.road_map, ahead, recording.sizes[ego], route),
    )


def place(data: Episodes, rows: Int[np.ndarray, " n"], casts: Sequence[Cast], history: int) -> None:
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


def _place(data: Episodes, b: int, cast: Cast, history: int) -> float:
    """Writes one episode; returns how far the logged ego drives, metres."""
    data.clear(b)
    recording, tracks = cast.recording, cast.tracks
    agents, points = len(tracks), len(cast.route)
    data.sizes[b, :agents] = recording.sizes[tracks]
    data.classes[b, :agents] = recording.classes[tracks]
    data.ids[b, :agents] = recording.track_ids[tracks]
    data.parked[b, :agents] = recording.parked[tracks]
    data.tracks[b, :agents] = tracks
    data.route[b, :points] = cast.route
    data.route_valid[b, :points] = True
    data.log_off_road_m[b, :points] = cast.log_off_road_m
    data.recording[b] = cast.scenario.recording
    data.start_tick[b], data.length[b] = cast.scenario.start_tick, cast.scenario.length
    return _copy_tracks(
        recording.states,
        recording.starts[tracks],
        recording.first_frames[tracks].astype(np.int64),
        recording.last_frames[tracks].astype(np.int64),
        *(cast.first_frame, cast.stride, cast.ticks, history),
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
