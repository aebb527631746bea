"""The arrays of a batch of episodes: how they start, and how a tick is written and read.

`initialize` looks a scenario up in its recording, `write_inits` writes it into the arrays of
`Episodes`; `gather_controlled` and `write_tick` are the inner loops of a step, `last_ticks` reads
the history.
"""

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import no_type_check

import numpy as np
from jaxtyping import Bool, Float, Int

from asp_env.compiled import njit
from asp_env.data.recording import Recording, frames_per_tick
from asp_env.data.scenarios.scenario import Scenario, short_history
from asp_env.data.scene import EGO
from asp_env.errors import AspEnvError
from asp_env.geometry import route_along, route_coordinates
from asp_env.metrics.boxes import ego_contacts, touching_trailers
from asp_env.metrics.drivable import log_off_road_m

ROUTE_EXTENSION_M = 60.0
"""A route continues straight for this distance after the last recorded position. Chosen by
hand."""


@dataclass(slots=True, kw_only=True)
class Episodes:
    """The arrays of B episodes of up to A agents over K = history + 1 + longest episode ticks.

    Slot 0 is the ego; the other agents follow by first appearance, then id. The time axis comes
    before the agents, so that one tick of an episode is contiguous in memory. Slots without an
    agent have id -1 and zeros elsewhere.
    """

    states: Float[np.ndarray, "b k a 4"]
    """[x m, y m, heading rad, speed m/s]: recorded up to the start, simulated from there on; zero
    where not valid."""
    valid: Bool[np.ndarray, "b k a"]
    """Mask of agents that are present."""
    actions: Float[np.ndarray, "b k a 2"]
    """[acceleration m/s², steering rad] inferred between each tick and the next; zero unless both
    are valid."""
    num_actions: Int[np.ndarray, " b"]
    """Number of ticks of `actions` that are up to date; the rest is inferred on demand."""
    log_states: Float[np.ndarray, "b k a 4"]
    """The recorded states, also after the start."""
    log_valid: Bool[np.ndarray, "b k a"]
    departed: Bool[np.ndarray, "b a"]
    """Mask of agents that have left or will never appear."""
    sizes: Float[np.ndarray, "b a 2"]
    """Length and width, m."""
    classes: Int[np.ndarray, "b a"]
    """`AgentClass` of each agent."""
    ids: Int[np.ndarray, "b a"]
    """Track ids."""
    parked: Bool[np.ndarray, "b a"]
    tracks: Int[np.ndarray, "b a"]
    """Index of each agent's track in its recording."""
    route: Float[np.ndarray, "b p 2"]
    """The ego's route: x m, y m of points 1 m apart."""
    route_valid: Bool[np.ndarray, "b p"]
    log_off_road_m: Float[np.ndarray, "b p"]
    """How far the logged ego is outside the drivable area near each point of its route."""
    on_route: Float[np.ndarray, "b 3"]
    """The ego's arc length m, its offset to the left m, and the heading rad of the route there."""
    contacts: Int[np.ndarray, "b a"]
    """`Contact` of the ego with each agent; a contact keeps the class of its first tick."""
    own_trailer: Bool[np.ndarray, "b a"]
    """Mask of trailers that touch the ego at the start: they belong to it and are no contact."""
    goal_m: Float[np.ndarray, " b"]
    """Arc length that the logged ego reaches at the end of the scenario."""
    recording: Int[np.ndarray, " b"]
    """Index of each episode's recording."""
    start_tick: Int[np.ndarray, " b"]
    """Tick of the recording at which the episode starts."""
    elapsed: Int[np.ndarray, " b"]
    """Ticks since the start."""
    length: Int[np.ndarray, " b"]
    """Ticks of the scenario."""

    def copy(self) -> "Episodes":
        """A deep copy."""
        return Episodes(**{name: getattr(self, name).copy() for name in _NAMES})

    def clear(self, row: int) -> None:
        """Resets one episode to padding."""
        for name in _NAMES:
            getattr(self, name)[row] = _FILL.get(name, 0)

    def with_room(self, *, ticks: int, agents: int, points: int) -> "Episodes":
        """These episodes, or a larger copy if an axis is shorter than required."""
        present = self.valid.shape[1], self.valid.shape[2], self.route.shape[1]
        needed = max(present[0], ticks), max(present[1], agents), max(present[2], points)
        if needed == present:
            return self
        larger = empty_episodes(
            len(self.length), ticks=needed[0], agents=needed[1], points=needed[2]
        )
        for name in _NAMES:
            value = getattr(self, name)
            getattr(larger, name)[tuple(map(slice, value.shape))] = value
        return larger


_NAMES = tuple(field.name for field in dataclasses.fields(Episodes))
_FILL = {"ids": -1, "tracks": -1}


def empty_episodes(num_episodes: int, *, ticks: int, agents: int, points: int) -> Episodes:
    """Arrays for episodes that have not started: all padding.

    Args:
        num_episodes: B.
        ticks: K, the length of the time axis.
        agents: A, the number of slots.
        points: P, the number of route points.
    """
    b, k, a, p = num_episodes, ticks, agents, points
    return Episodes(
        states=np.zeros((b, k, a, 4), dtype=np.float32),
        valid=np.zeros((b, k, a), dtype=bool),
        actions=np.zeros((b, k, a, 2), dtype=np.float32),
        num_actions=np.zeros(b, dtype=np.int64),
        log_states=np.zeros((b, k, a, 4), dtype=np.float32),
        log_valid=np.zeros((b, k, a), dtype=bool),
        departed=np.zeros((b, a), dtype=bool),
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


@dataclass(frozen=True, slots=True, kw_only=True)
class EpisodeInit:
    """What an episode starts from: its agents, its frames in the recording, and the ego's route."""

    scenario: Scenario
    recording: Recording
    tracks: Int[np.ndarray, " a"]
    """Indices of the agents' tracks: the ego's, then the others by first appearance, then id."""
    first_frame: int
    """Frame of the first tick of the history."""
    stride: int
    """Frames per tick."""
    ticks: int
    """Ticks of the history, the present and the scenario."""
    route: Float[np.ndarray, "p 2"]
    """x m, y m of points 1 m apart."""
    log_off_road_m: Float[np.ndarray, " p"]
    """How far the logged ego is outside the drivable area near each point of its route."""


def initialize(
    recording: Recording, scenario: Scenario, *, dt_s: float, history: int
) -> EpisodeInit:
    """Looks up what an episode starts from: all agents seen in the scenario or its history.

    The ego must be present in the scenario and in the last 0.6 s of the history, so that a longer
    history suits the same scenarios, and short recordings can be driven.

    Args:
        recording: the scenario's recording.
        scenario: where and when the episode starts, and which track is the ego.
        dt_s: length of a tick.
        history: past ticks that are recorded before the start.

    Raises:
        AspEnvError: the recording lacks the ego's track, or it does not span all ticks.
    """
    stride = frames_per_tick(recording.frame_rate_hz, dt_s)
    matches = np.flatnonzero(recording.track_ids == scenario.ego_id)
    if not len(matches):
        raise AspEnvError(
            f"scenario {scenario.name}: recording {recording.name} has no track {scenario.ego_id}"
        )
    ego = int(matches[0])
    first_tick = scenario.start_tick - history
    needed_tick = scenario.start_tick - short_history(history, dt_s)
    last_tick = scenario.start_tick + scenario.length
    if (
        scenario.length < 1
        or needed_tick * stride < recording.first_frames[ego]
        or last_tick * stride > recording.last_frames[ego]
    ):
        raise AspEnvError(
            f"scenario {scenario.name}: ticks {needed_tick} to {last_tick} are needed, the "
            f"track of the ego spans {-(-int(recording.first_frames[ego]) // stride)} to "
            f"{int(recording.last_frames[ego]) // stride}"
        )
    present = recording.tracks_between(first_tick * stride, last_tick * stride)
    start = scenario.start_tick * stride - recording.first_frames[ego]
    future = recording.track(ego)[start::stride]
    route = route_along(future, beyond_m=ROUTE_EXTENSION_M)
    return EpisodeInit(
        scenario=scenario,
        recording=recording,
        tracks=np.concatenate([[ego], present[present != ego]]),
        first_frame=first_tick * stride,
        stride=stride,
        ticks=history + 1 + scenario.length,
        route=route,
        log_off_road_m=log_off_road_m(recording.road_map, future, recording.sizes[ego], route),
    )


def write_inits(
    episodes: Episodes,
    rows: Int[np.ndarray, " n"],
    inits: Sequence[EpisodeInit],
    history: int,
) -> None:
    """Writes episodes at their first tick.

    Args:
        episodes: arrays that are large enough (`Episodes.with_room`).
        rows: indices of the episodes that start.
        inits: what each of them starts from.
        history: past ticks.
    """
    pairs = zip(rows.tolist(), inits, strict=True)
    distances_m = np.array([_write_init(episodes, b, init, history) for b, init in pairs])
    first, present = episodes.states[rows, history], episodes.valid[rows, history]
    last = episodes.log_states[rows, history + episodes.length[rows], EGO]
    sizes, classes = episodes.sizes[rows], episodes.classes[rows]
    route, route_valid = episodes.route[rows], episodes.route_valid[rows]
    own_trailer = touching_trailers(first, sizes, classes, present)
    episodes.own_trailer[rows] = own_trailer
    episodes.contacts[rows] = ego_contacts(first, sizes, present & ~own_trailer)
    start = np.zeros(len(rows))
    episodes.on_route[rows] = route_coordinates(route, route_valid, first[:, EGO], start)
    episodes.goal_m[rows] = route_coordinates(route, route_valid, last, distances_m)[:, 0]


def _write_init(episodes: Episodes, b: int, init: EpisodeInit, history: int) -> float:
    """Writes one episode and returns the distance that the logged ego drives from the start, m."""
    episodes.clear(b)
    recording, tracks = init.recording, init.tracks
    agents, points = len(tracks), len(init.route)
    episodes.sizes[b, :agents] = recording.sizes[tracks]
    episodes.classes[b, :agents] = recording.classes[tracks]
    episodes.ids[b, :agents] = recording.track_ids[tracks]
    episodes.parked[b, :agents] = recording.parked[tracks]
    episodes.tracks[b, :agents] = tracks
    episodes.route[b, :points] = init.route
    episodes.route_valid[b, :points] = True
    episodes.log_off_road_m[b, :points] = init.log_off_road_m
    episodes.recording[b] = init.scenario.recording
    episodes.start_tick[b], episodes.length[b] = init.scenario.start_tick, init.scenario.length
    return _copy_tracks(
        recording.states,
        recording.starts[tracks],
        recording.first_frames[tracks].astype(np.int64),
        recording.last_frames[tracks].astype(np.int64),
        *(init.first_frame, init.stride, init.ticks, history),
        *(episodes.log_states[b], episodes.log_valid[b], episodes.states[b], episodes.valid[b]),
    )


@njit(cache=True)
@no_type_check
def _copy_tracks(
    rows, starts, first_frames, last_frames, first_frame, stride, ticks, history,
    log_states, log_valid, states, valid,
):  # fmt: skip
    """Copies the tracks of one episode into its cleared arrays.

    Args:
        rows: (R, 4) states of the recording's track table.
        starts: (A,) first row of each track.
        first_frames: (A,) first frame of each track.
        last_frames: (A,) last frame of each track.
        first_frame: frame of tick 0.
        stride: frames per tick.
        ticks: ticks to copy into the log.
        history: index of the present tick; later ticks are copied into the log only.
        log_states: (K, A, 4), written.
        log_valid: (K, A), written.
        states: (K, A, 4), written.
        valid: (K, A), written.

    Returns:
        The distance that the ego (slot 0) drives from the present tick to the last, m.
    """
    for a in range(len(starts)):
        for k in range(ticks):
            frame = first_frame + k * stride
            if not first_frames[a] <= frame <= last_frames[a]:
                continue
            row = starts[a] + frame - first_frames[a]
            log_valid[k, a] = True
            for field in range(4):
                log_states[k, a, field] = rows[row, field]
            if k <= history:
                valid[k, a] = True
                for field in range(4):
                    states[k, a, field] = rows[row, field]
    distance = 0.0
    for k in range(history, ticks - 1):
        distance += math.hypot(
            log_states[k + 1, 0, 0] - log_states[k, 0, 0],
            log_states[k + 1, 0, 1] - log_states[k, 0, 1],
        )
    return distance


@njit(cache=True)
@no_type_check
def _gather_controlled(states, sizes, actions, rows, now, acting, out):
    n = 0
    for i in range(len(rows)):
        b, k = rows[i], now[i]
        for a in range(acting.shape[1]):
            if acting[i, a]:
                for field in range(4):
                    out[field, n] = states[b, k, a, field]
                out[4, n], out[5, n] = actions[b, a, 0], actions[b, a, 1]
                out[6, n] = max(sizes[b, a, 0], 0.1)
                n += 1


def gather_controlled(
    episodes: Episodes,
    rows: Int[np.ndarray, " r"],
    now: Int[np.ndarray, " r"],
    actions: Float[np.ndarray, "b a 2"],
    acting: Bool[np.ndarray, "r a"],
) -> tuple[
    Float[np.ndarray, "n 4"],
    Float[np.ndarray, "n 2"],
    Float[np.ndarray, " n"],
]:
    """States, actions and lengths of the agents that act, in the order of rows and slots.

    The returned arrays are transposed views: each field is contiguous, which halves the time of
    the bicycle model.

    Args:
        episodes: all episodes.
        rows: indices of the episodes to read.
        now: present tick of each of these episodes.
        actions: [acceleration m/s², steering rad] for all episodes.
        acting: mask of the agents that execute their action in each of these episodes.

    Returns:
        States [x m, y m, heading rad, speed m/s], actions and lengths (m, at least 0.1) of the N
        acting agents.
    """
    fields = np.empty((7, np.count_nonzero(acting)), dtype=np.float32)
    _gather_controlled(episodes.states, episodes.sizes, actions, rows, now, acting, fields)
    return fields[:4].T, fields[4:6].T, fields[6]


@njit(cache=True)
@no_type_check
def _write_tick(
    states, valid, log_states, log_valid, departed, rows, now, controlled, acting, next_states
):
    n = -1
    for i in range(len(rows)):
        b, k = rows[i], now[i] + 1
        for a in range(valid.shape[2]):
            acts = acting[i, a]
            n += acts
            present = acts or (log_valid[b, k, a] and not controlled[i, a])
            if departed[b, a] or not present:
                valid[b, k, a] = False
                states[b, k, a, :] = 0.0
                continue
            valid[b, k, a] = True
            if acts:
                for field in range(4):
                    states[b, k, a, field] = next_states[n, field]
            else:
                for field in range(4):
                    states[b, k, a, field] = log_states[b, k, a, field]


def write_tick(
    episodes: Episodes,
    rows: Int[np.ndarray, " r"],
    now: Int[np.ndarray, " r"],
    controlled: Bool[np.ndarray, "r a"],
    acting: Bool[np.ndarray, "r a"],
    next_states: Float[np.ndarray, "n 4"],
) -> None:
    """Writes the tick after `now`: acting agents get their next state, uncontrolled ones their log.

    Args:
        episodes: all episodes; `states` and `valid` are written.
        rows: indices of the episodes to write.
        now: present tick of each of these episodes.
        controlled: mask of agents that are not replayed.
        acting: mask of controlled agents that are present.
        next_states: states of the N acting agents, in the order of `gather_controlled`.
    """
    _write_tick(
        *(episodes.states, episodes.valid, episodes.log_states, episodes.log_valid),
        *(episodes.departed, rows, now, controlled, acting, next_states),
    )


@njit(cache=True)
@no_type_check
def _last_ticks(states, valid, now, rows, out_states, out_valid):
    agents, ticks = out_valid.shape[1:]
    for i in range(len(rows)):
        b = rows[i]
        first = now[b] + 1 - ticks
        for k in range(ticks):
            for a in range(agents):
                present = valid[b, first + k, a]
                out_valid[i, a, k] = present
                for field in range(4):
                    out_states[i, a, k, field] = states[b, first + k, a, field] if present else 0.0


def last_ticks(
    episodes: Episodes, now: Int[np.ndarray, " b"], rows: Int[np.ndarray, " r"], history: int
) -> tuple[Float[np.ndarray, "r a ticks 4"], Bool[np.ndarray, "r a ticks"]]:
    """States and validity at the last `history` ticks and now, with the agents before the ticks.

    Args:
        episodes: all episodes.
        now: present tick of all episodes.
        rows: indices of the episodes to read.
        history: number of past ticks.

    Returns:
        States [x m, y m, heading rad, speed m/s], zero where not valid, and their mask.
    """
    shape = (len(rows), episodes.ids.shape[1], history + 1)
    states, valid = np.empty((*shape, 4), dtype=np.float32), np.empty(shape, dtype=bool)
    _last_ticks(episodes.states, episodes.valid, now, rows, states, valid)
    return states, valid
