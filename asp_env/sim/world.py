"""What holds at one tick of B episodes, and how it is found.

MERGED: The socket for worlds: B episodes at once, on arrays.
MERGED: What a world's recordings hold of the time to come, for privileged predictors alone.
MERGED: What worlds whose episodes are scenarios of recordings have in common.
MERGED: Worlds that replay recordings: logged agents move as recorded, driven ones by the bicycle.
MERGED: Which world DATA is driven in.
"""

import copy
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import Any, ClassVar

import numpy as np
from jaxtyping import Bool, Float, Int

from asp_env import registry
from asp_env.data.recording import Recording
from asp_env.data.road_map import RoadMap
from asp_env.data.scenarios.scenario import Scenario
from asp_env.data.scene import EGO, Scene, infer_actions
from asp_env.data.snippets import Future, SnippetIndex, gather_ticks
from asp_env.data.source import scheme_of
from asp_env.dynamics import forward
from asp_env.geometry import route_coordinates
from asp_env.metrics.boxes import AT_FAULT, Contact, ego_contacts
from asp_env.metrics.drivable import beyond_log_m, drivable_field
from asp_env.sim.episodes import (
    gather_controlled,
    initialize,
    last_ticks,
    no_episodes,
    place,
    write_tick,
)

_AT_FAULT = np.array([kind in AT_FAULT for kind in Contact])
"""By the number of the contact."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Events:
    """What holds now in each of B episodes."""

    contacts: Int[np.ndarray, "b a"]
    """`Contact` of the ego with each agent; one that lasts keeps the class of its first tick.

    With a trailer that touches the ego at the first tick, its own, there is none.
    """
    off_road_m: Float[np.ndarray, " b"]
    """How far the ego's outermost corner lies outside the drivable area.

    Less what the logged ego lies outside there, if it is off the road itself: maps have gaps.
    """
    route_m: Float[np.ndarray, " b"]
    """The ego's arc length along its route, which starts at its first position."""
    route_offset_m: Float[np.ndarray, " b"]
    """How far left of its route the ego is."""
    route_heading_rad: Float[np.ndarray, " b"]
    """The route's heading there."""
    goal_m: Float[np.ndarray, " b"]
    """The arc length that the logged ego reached at the end of the scenario."""
    elapsed: Int[np.ndarray, " b"]
    """Ticks since the first observation."""
    length: Int[np.ndarray, " b"]
    """Ticks that the recording provides."""

    @property
    def collision(self) -> Bool[np.ndarray, " b"]:
        """Whether the ego touches anybody."""
        return np.asarray((self.contacts > 0).any(axis=1))

    @property
    def at_fault(self) -> Bool[np.ndarray, " b"]:
        """Whether the ego touches somebody in a way that it answers for."""
        return np.asarray(_AT_FAULT[self.contacts].any(axis=1))


def outside_now_m(
    maps: Sequence[RoadMap],
    map_index: Int[np.ndarray, " b"],
    egos: Float[np.ndarray, "b 4"],
    sizes: Float[np.ndarray, "b 2"],
    on_route: Float[np.ndarray, "b 3"],
    log_off_road_m: Float[np.ndarray, "b p"],
) -> Float[np.ndarray, " b"]:
    """How far each ego's outermost corner lies outside its map's drivable area, beyond its log."""
    outside = np.zeros(len(egos), dtype=np.float32)
    for number, road_map in enumerate(maps):
        drivable_field(road_map).corners_m(egos, sizes, map_index == number, outside)
    return beyond_log_m(outside, on_route, log_off_road_m)


class Ending(IntEnum):
    """Why an episode is over."""

    RUNNING = 0
    COLLISION = 1
    OFF_ROAD = 2
    GOAL = 3
    OUT_OF_DATA = 4


class World(ABC):
    """B episodes in recordings. One generator per episode is the drivers', not the world's.

    Worlds differ in what moves those whom nobody drives.
    """

    traffic: ClassVar[str]
    """The name of the driver that leaves everybody to the world."""

    def __init__(
        self, recordings: Sequence[Recording], *, num_episodes: int, dt_s: float, history: int
    ) -> None:
        """A world without episodes yet; `reset` starts them."""
        self.recordings = recordings
        self.dt_s = dt_s
        self.history = history
        self.rngs: list[np.random.Generator] = [np.random.default_rng(0)] * num_episodes
        self.scenarios: list[Scenario | None] = [None] * num_episodes
        self.episodes = no_episodes(num_episodes, ticks=history + 2, agents=1, points=2)
        self._maps: tuple[RoadMap, ...] = ()
        self._map_index = np.zeros(num_episodes, dtype=np.int64)
        self._rows = np.arange(num_episodes)

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
        reset_mask: Bool[np.ndarray, " b"] | None = None,
    ) -> None:
        """Starts the episodes at `reset_mask` (all by default); the others' entries are not read.

        Raises:
            AspEnvError: a scenario does not fit its recording.
        """
        chosen = np.flatnonzero(
            np.ones(len(self), dtype=bool) if reset_mask is None else reset_mask
        )
        if not len(chosen):
            return
        casts = [
            initialize(
                self.recordings[scenarios[b].recording],
                scenarios[b],
                dt_s=self.dt_s,
                history=self.history,
            )
            for b in chosen.tolist()
        ]
        self.episodes = self.episodes.with_room(
            ticks=max(each.ticks for each in casts),
            agents=max(len(each.tracks) for each in casts),
            points=max(len(each.route) for each in casts),
        )
        place(self.episodes, chosen, casts, self.history)
        for b in chosen.tolist():
            self.scenarios[b], self.rngs[b] = scenarios[b], rngs[b]
        self._find_maps()

    def _find_maps(self) -> None:
        used, index = np.unique(self.episodes.recording, return_inverse=True)
        self._maps = tuple(self.recordings[int(i)].road_map for i in used)
        self._map_index = index.reshape(-1)

    def step(
        self,
        actions: Float[np.ndarray, "b a 2"],
        driven: Bool[np.ndarray, "b a"],
        leaving: Bool[np.ndarray, "b a"] | None = None,
    ) -> None:
        """One tick: `driven` agents obey, `leaving` ones vanish, the rest is the world's.

        Only agents that are present can be driven. An episode whose scenario has run its length
        stays as it is, whatever the others do.
        """
        data = self.episodes
        rows = np.flatnonzero(data.elapsed < data.length)
        now = self.now[rows]
        if leaving is not None:
            data.gone[rows] |= leaving[rows]
        driven = driven[rows]
        obeys = driven & data.valid[rows, now]
        self._move(rows, now, actions, driven, obeys)
        data.elapsed[rows] += 1
        # a negative arc length would make the search begin anew everywhere
        near = np.maximum(data.on_route[:, 0], 0.0)
        on_route = route_coordinates(data.route, data.route_valid, self.ego_states(), near)
        data.on_route[rows] = on_route[rows]
        self._judge_contacts()

    @abstractmethod
    def _move(
        self,
        rows: Int[np.ndarray, " r"],
        now: Int[np.ndarray, " r"],
        actions: Float[np.ndarray, "b a 2"],
        driven: Bool[np.ndarray, "r a"],
        obeys: Bool[np.ndarray, "r a"],
    ) -> None:
        """Writes the tick after `now` of the episodes `rows`.

        Args:
            rows: which episodes.
            now: the present tick of each.
            actions: of all episodes.
            driven: who is not moved by the world.
            obeys: which of those are there to be moved.
        """

    def _judge_contacts(self) -> None:
        """Brings contacts up to now."""
        data, now = self.episodes, self.now
        states, valid = data.states[self._rows, now], data.valid[self._rows, now]
        data.contacts = ego_contacts(states, data.sizes, valid & ~data.own_trailer, data.contacts)

    def scene(self) -> Scene:
        """All that may be known now; targets are all present agents but the ego."""
        data = self.episodes
        self._infer_actions()
        states, valid = last_ticks(data, self.now, self._rows, self.history)
        past = self.now[:, None] + np.arange(-self.history, 0)
        actions = np.ascontiguousarray(data.actions[self._rows[:, None], past].swapaxes(1, 2))
        others = valid[..., -1].copy()
        others[:, EGO] = False
        seen = np.asarray(valid.any(axis=-1))  # of who comes later, nothing is known yet
        return Scene(
            states=states,
            actions=actions,
            valid=valid,
            sizes=np.where(seen[..., None], data.sizes, 0).astype(np.float32),
            classes=np.where(seen, data.classes, 0).astype(np.int32),
            ids=np.where(seen, data.ids, -1),
            tick=data.start_tick + data.elapsed,
            targets=np.argwhere(others),
            route=data.route.copy(),
            route_valid=data.route_valid.copy(),
            maps=self._maps,
            map_index=self._map_index,
            dt_s=self.dt_s,
        )

    def _infer_actions(self) -> None:
        """Brings the inferred actions up to now."""
        data = self.episodes
        behind = self.now - data.inferred
        for missing in np.unique(behind[behind > 0]).tolist():
            rows = np.flatnonzero(behind == missing)
            at = data.inferred[rows, None] + np.arange(missing + 1)
            states = data.states[rows[:, None], at].swapaxes(1, 2)
            valid = data.valid[rows[:, None], at].swapaxes(1, 2)
            found = infer_actions(states, valid, data.sizes[rows, :, 0], self.dt_s)
            data.actions[rows[:, None], at[:, :-1]] = found.swapaxes(1, 2)
            data.inferred[rows] += missing

    def maps(self) -> tuple[tuple[RoadMap, ...], Int[np.ndarray, " b"]]:
        """The maps of the episodes' recordings, and which of them each episode lies on."""
        return self._maps, self._map_index

    def ego_states(self) -> Float[np.ndarray, "b 4"]:
        """The egos' states now."""
        return self.episodes.states[self._rows, self.now, EGO]

    def events(self) -> Events:
        """What holds now."""
        data = self.episodes
        return Events(
            contacts=data.contacts.copy(),
            off_road_m=outside_now_m(
                *self.maps(),
                self.ego_states(),
                data.sizes[:, EGO],
                data.on_route,
                data.log_off_road_m,
            ),
            route_m=data.on_route[:, 0].copy(),
            route_offset_m=data.on_route[:, 1].copy(),
            route_heading_rad=data.on_route[:, 2].copy(),
            goal_m=data.goal_m.copy(),
            elapsed=data.elapsed.copy(),
            length=data.length.copy(),
        )

    def snapshot(self) -> Any:
        """The whole state, to be handed to `restore`."""
        return self.episodes.copy(), list(self.scenarios), copy.deepcopy(self.rngs)

    def restore(self, snapshot: Any) -> None:
        """Goes back to a snapshot, bit for bit."""
        episodes, scenarios, rngs = snapshot
        self.episodes, self.scenarios = episodes.copy(), list(scenarios)
        self.rngs = copy.deepcopy(rngs)
        self._find_maps()


class ReplayWorld(World):
    """Whom nobody drives moves as recorded."""

    traffic = "log"

    def _move(
        self,
        rows: Int[np.ndarray, " r"],
        now: Int[np.ndarray, " r"],
        actions: Float[np.ndarray, "b a 2"],
        driven: Bool[np.ndarray, "r a"],
        obeys: Bool[np.ndarray, "r a"],
    ) -> None:
        moved = forward(*gather_controlled(self.episodes, rows, now, actions, obeys), self.dt_s)
        write_tick(self.episodes, rows, now, driven, obeys, moved)


def world_of(source: str) -> type[World]:
    """The world that a package registers for the scheme of DATA; else recordings are replayed.

    Raises:
        AspEnvError: a package that this world needs is missing.
    """
    scheme = scheme_of(source)
    if scheme is None or scheme not in registry.names("worlds"):
        return ReplayWorld
    return registry.find("worlds", scheme)


def recorded_future(world: World, scene: Scene, horizon: int) -> Future:
    """What the recordings say of the coming ticks of the scene's targets, whatever drives them."""
    episodes, b, a = world.episodes, scene.targets[:, 0], scene.targets[:, 1]
    index = SnippetIndex(
        recording=episodes.recording[b],
        track=episodes.tracks[b, a],
        tick=scene.tick[b],
        dt_s=world.dt_s,
        history=0,
        horizon_ticks=horizon,
    )
    states, valid = gather_ticks(world.recordings, index, 1 + np.arange(horizon))
    return Future(states=states, valid=valid)
