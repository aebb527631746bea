"""Worlds that replay recordings: logged agents move as recorded, driven ones by the bicycle."""

import copy
import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from asp_env.data.clock import frames_per_tick
from asp_env.data.geometry import path_length, route_along
from asp_env.data.recording import Recording
from asp_env.data.road_map import RoadMap
from asp_env.data.scenario import Scenario
from asp_env.data.scene import Scene, infer_actions
from asp_env.data.snippets import gather_window
from asp_env.dynamics import forward
from asp_env.errors import AspEnvError
from asp_env.metrics.boxes import ego_contacts, touching_trailers
from asp_env.metrics.route import route_coordinates
from asp_env.sim.events import Events, outside_now_m
from asp_env.sim.world import EGO

BEYOND_M = 60.0
"""How far a route goes on straight behind the last recorded position."""


@dataclass(slots=True, kw_only=True)
class Episodes:
    """The arrays of B episodes with A slots over K = history + 1 + longest episode ticks.

    Slots are sorted ego first, then by first appearance, then id. Time is the second axis, so
    that one tick of an episode lies together in memory.
    """

    states: Float[np.ndarray, "b k a 4"]
    """What happens here: the recorded past, then what the steps make of it."""
    valid: Bool[np.ndarray, "b k a"]
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
        fields = dataclasses.fields(self)
        return Episodes(**{field.name: getattr(self, field.name).copy() for field in fields})


Snapshot = tuple[Episodes, list[Scenario | None], list[np.random.Generator]]

_FILL = {"ids": -1, "tracks": -1}


class ReplayWorld:
    """B episodes in recordings. One generator per episode is the drivers', not the world's."""

    def __init__(
        self, recordings: Sequence[Recording], *, num_episodes: int, dt_s: float, history: int
    ) -> None:
        """A world without episodes yet; `reset` starts them."""
        self.recordings = recordings
        self.dt_s = dt_s
        self.history = history
        self.rngs: list[np.random.Generator] = [np.random.default_rng(0)] * num_episodes
        self.scenarios: list[Scenario | None] = [None] * num_episodes
        self.episodes = _allocate(num_episodes, agents=1, ticks=history + 2, points=2)

    def __len__(self) -> int:
        """How many episodes run side by side."""
        return len(self.scenarios)

    @property
    def now(self) -> Int[np.ndarray, " b"]:
        """Index of the present tick on the time axis of `episodes`."""
        return self.episodes.elapsed + self.history

    def reset(
        self,
        scenarios: Sequence[Scenario],
        rngs: Sequence[np.random.Generator],
        where: Bool[np.ndarray, " b"] | None = None,
    ) -> None:
        """Starts the episodes at `where` (all by default); the others' entries are not read.

        Raises:
            AspEnvError: a scenario does not fit its recording.
        """
        chosen = np.flatnonzero(np.ones(len(self), dtype=bool) if where is None else where)
        rows = {b: self._gather(scenarios[b]) for b in chosen.tolist()}
        for b, row in rows.items():
            self.scenarios[b], self.rngs[b] = scenarios[b], rngs[b]
            self._make_room(row)
            _put(self.episodes, b, row)

    def _gather(self, scenario: Scenario) -> Episodes:
        recording = self.recordings[scenario.recording]
        found = np.flatnonzero(recording.track_ids == scenario.ego_id)
        if not len(found):
            raise AspEnvError(
                f"scenario {scenario.name}: recording {recording.name} has no track "
                f"{scenario.ego_id}"
            )
        ego = int(found[0])
        stride = frames_per_tick(recording.frame_rate_hz, self.dt_s)
        first_tick, last_tick = (
            scenario.start_tick - self.history,
            scenario.start_tick + scenario.length,
        )
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
        tracks = np.concatenate([[ego], seen[seen != ego]])
        states, valid = gather_window(
            recording,
            tracks,
            first_tick=first_tick,
            num_ticks=self.history + 1 + scenario.length,
            stride=stride,
        )
        states, valid = states.swapaxes(0, 1)[None], valid.swapaxes(0, 1)[None]
        now = self.history
        ahead = recording.track(ego)[
            scenario.start_tick * stride - recording.first_frames[ego] :: stride
        ]
        route = route_along(ahead, beyond_m=BEYOND_M)[None]
        route_valid = np.ones(route.shape[:2], dtype=bool)
        start = states[:, now], recording.sizes[tracks][None]
        classes = recording.classes[tracks][None].astype(np.int32)
        own_trailer = touching_trailers(*start, classes, valid[:, now])
        driven_m = np.full(1, path_length(states[0, now:, EGO, :2]))
        goal = route_coordinates(route, route_valid, states[:, -1, EGO], driven_m)[:, 0]
        simulated, present = states.copy(), valid.copy()
        simulated[:, now + 1 :], present[:, now + 1 :] = 0, False
        return Episodes(
            states=simulated,
            valid=present,
            log_states=states,
            log_valid=valid,
            gone=np.zeros((1, len(tracks)), dtype=bool),
            sizes=recording.sizes[tracks][None],
            classes=classes,
            ids=recording.track_ids[tracks][None].astype(np.int64),
            parked=recording.parked[tracks][None],
            tracks=tracks[None],
            route=route,
            route_valid=route_valid,
            on_route=route_coordinates(route, route_valid, states[:, now, EGO], np.zeros(1)),
            contacts=ego_contacts(*start, valid[:, now] & ~own_trailer),
            own_trailer=own_trailer,
            goal_m=goal,
            recording=np.full(1, scenario.recording),
            start_tick=np.full(1, scenario.start_tick),
            elapsed=np.zeros(1, dtype=np.int64),
            length=np.full(1, scenario.length),
        )

    def _make_room(self, row: Episodes) -> None:
        have = self.episodes
        agents = max(have.ids.shape[1], row.ids.shape[1])
        ticks = max(have.valid.shape[1], row.valid.shape[1])
        points = max(have.route.shape[1], row.route.shape[1])
        if (agents, ticks, points) == (have.ids.shape[1], have.valid.shape[1], have.route.shape[1]):
            return
        self.episodes = _allocate(len(self), agents=agents, ticks=ticks, points=points)
        for b in range(len(self)):
            _put(self.episodes, b, have, b)

    def step(
        self,
        actions: Float[np.ndarray, "b a 2"],
        driven: Bool[np.ndarray, "b a"],
        leaving: Bool[np.ndarray, "b a"] | None = None,
    ) -> None:
        """One tick: `driven` agents obey their actions, `leaving` ones vanish, the rest replay.

        Only agents that are present can be driven. An episode whose scenario has run its length
        stays as it is, whatever the others do.
        """
        data = self.episodes
        rows = np.flatnonzero(data.elapsed < data.length)
        now = self.now[rows]
        if leaving is not None:
            data.gone[rows] |= leaving[rows]
        states, valid = data.states[rows, now], data.valid[rows, now]
        obeys = driven[rows] & valid
        lengths = np.maximum(data.sizes[rows, :, 0], 0.1)
        moved = forward(states, actions[rows].astype(np.float32), lengths, self.dt_s)
        logged, there = data.log_states[rows, now + 1], data.log_valid[rows, now + 1]
        present = np.where(obeys, True, there & ~driven[rows]) & ~data.gone[rows]
        states = np.where(obeys[..., None], moved, logged) * present[..., None]
        data.states[rows, now + 1] = states.astype(np.float32)
        data.valid[rows, now + 1] = present
        data.elapsed[rows] += 1
        # a negative arc length would make the search begin anew everywhere
        near = np.maximum(data.on_route[:, 0], 0.0)
        on_route = route_coordinates(data.route, data.route_valid, self.ego_states(), near)
        data.on_route[rows] = on_route[rows]
        self._judge_contacts()

    def _judge_contacts(self) -> None:
        """Brings contacts up to now."""
        data, rows = self.episodes, np.arange(len(self))
        states = np.ascontiguousarray(data.states[rows, self.now])
        valid = np.ascontiguousarray(data.valid[rows, self.now])
        data.contacts = ego_contacts(states, data.sizes, valid & ~data.own_trailer, data.contacts)

    def scene(self) -> Scene:
        """All that may be known now; targets are all present agents but the ego."""
        data = self.episodes
        ticks = self.now[:, None] + np.arange(-self.history, 1)
        rows = np.arange(len(self))[:, None]
        states = np.ascontiguousarray(data.states[rows, ticks].swapaxes(1, 2))
        valid = np.ascontiguousarray(data.valid[rows, ticks].swapaxes(1, 2))
        others = valid[..., -1].copy()
        others[:, EGO] = False
        seen = np.asarray(valid.any(axis=-1))  # of who comes later, nothing is known yet
        maps, map_index = self.maps()
        return Scene(
            states=states,
            actions=infer_actions(states, valid, data.sizes[..., 0], self.dt_s),
            valid=valid,
            sizes=np.where(seen[..., None], data.sizes, 0).astype(np.float32),
            classes=np.where(seen, data.classes, 0).astype(np.int32),
            ids=np.where(seen, data.ids, -1),
            tick=data.start_tick + data.elapsed,
            targets=np.argwhere(others),
            route=data.route.copy(),
            route_valid=data.route_valid.copy(),
            maps=maps,
            map_index=map_index,
            dt_s=self.dt_s,
        )

    def maps(self) -> tuple[tuple[RoadMap, ...], Int[np.ndarray, " b"]]:
        """The maps of the episodes' recordings, and which of them each episode lies on."""
        used, index = np.unique(self.episodes.recording, return_inverse=True)
        return tuple(self.recordings[int(i)].road_map for i in used), index.reshape(-1)

    def ego_states(self) -> Float[np.ndarray, "b 4"]:
        """The egos' states now."""
        return self.episodes.states[np.arange(len(self)), self.now, EGO]

    def events(self) -> Events:
        """What holds now."""
        data = self.episodes
        return Events(
            contacts=data.contacts.copy(),
            off_road_m=outside_now_m(*self.maps(), self.ego_states(), data.sizes[:, EGO]),
            route_m=data.on_route[:, 0].copy(),
            route_offset_m=data.on_route[:, 1].copy(),
            route_heading_rad=data.on_route[:, 2].copy(),
            goal_m=data.goal_m.copy(),
            elapsed=data.elapsed.copy(),
            length=data.length.copy(),
        )

    def snapshot(self) -> Snapshot:
        """The whole state, to be handed to `restore`."""
        return self.episodes.copy(), list(self.scenarios), copy.deepcopy(self.rngs)

    def restore(self, snapshot: Snapshot) -> None:
        """Goes back to a snapshot, bit for bit."""
        episodes, scenarios, rngs = snapshot
        self.episodes, self.scenarios = episodes.copy(), list(scenarios)
        self.rngs = copy.deepcopy(rngs)


def _allocate(num_episodes: int, *, agents: int, ticks: int, points: int) -> Episodes:
    b, k, a, p = num_episodes, ticks, agents, points
    return Episodes(
        states=np.zeros((b, k, a, 4), dtype=np.float32),
        valid=np.zeros((b, k, a), dtype=bool),
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
        on_route=np.zeros((b, 3)),
        contacts=np.zeros((b, a), dtype=np.int8),
        own_trailer=np.zeros((b, a), dtype=bool),
        goal_m=np.zeros(b),
        recording=np.zeros(b, dtype=np.int64),
        start_tick=np.zeros(b, dtype=np.int64),
        elapsed=np.zeros(b, dtype=np.int64),
        length=np.zeros(b, dtype=np.int64),
    )


def _put(into: Episodes, row: int, source: Episodes, source_row: int = 0) -> None:
    """Copies one episode; what its arrays lack of the row's size is filled with padding."""
    for field in dataclasses.fields(into):
        target = getattr(into, field.name)
        value = getattr(source, field.name)[source_row]
        target[row] = _FILL.get(field.name, 0)
        target[(row, *map(slice, value.shape))] = value
