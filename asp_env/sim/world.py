"""Worlds: a batch of episodes on arrays, and the recorded traffic as the simplest of them."""

import copy
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import Any, ClassVar

import numpy as np
from jaxtyping import Bool, Float, Int

from asp_env import registry
from asp_env.data.recording import Recording, frames_per_tick
from asp_env.data.road_map import RoadMap
from asp_env.data.scenarios.scenario import Scenario
from asp_env.data.scene import EGO, Scene, infer_actions
from asp_env.data.signals import SceneSignals
from asp_env.data.snippets import (
    Future,
    SnippetIndex,
    gather_signals,
    gather_ticks,
    gather_window,
)
from asp_env.data.source import scheme_of
from asp_env.dynamics import forward
from asp_env.geometry import route_coordinates
from asp_env.metrics.boxes import AT_FAULT, Contact, ego_contacts
from asp_env.metrics.drivable import beyond_log_m, drivable_field
from asp_env.sim.episodes import (
    empty_episodes,
    gather_controlled,
    initialize,
    last_ticks,
    write_inits,
    write_tick,
)

_AT_FAULT = np.array([kind in AT_FAULT for kind in Contact])
"""Whether the ego is at fault, by value of `Contact`."""

GOAL_TOLERANCE_M = 0.01
"""The goal counts as reached this far before it: allows for rounding."""


class Ending(IntEnum):
    """Why an episode is over."""

    RUNNING = 0
    COLLISION = 1
    OFF_ROAD = 2
    GOAL = 3
    OUT_OF_DATA = 4


@dataclass(frozen=True, slots=True, kw_only=True)
class Events:
    """The present situation of the ego in each of B episodes, for rewards and endings."""

    contacts: Int[np.ndarray, "b a"]
    """`Contact` of the ego with each agent; a contact keeps the class of its first tick.

    The ego's own trailer, which touches it at the first tick, is no contact.
    """
    off_road_m: Float[np.ndarray, " b"]
    """How far the ego's outermost corner is outside the drivable area.

    Where the logged ego is outside as well, that distance is subtracted: maps have gaps.
    """
    route_m: Float[np.ndarray, " b"]
    """The ego's arc length along its route, which starts at its first position."""
    route_offset_m: Float[np.ndarray, " b"]
    """The ego's distance from its route, left positive."""
    route_heading_rad: Float[np.ndarray, " b"]
    """Heading of the route at the ego."""
    goal_m: Float[np.ndarray, " b"]
    """Arc length that the logged ego reaches at the end of the scenario."""
    elapsed: Int[np.ndarray, " b"]
    """Ticks since the first observation."""
    length: Int[np.ndarray, " b"]
    """Ticks that the recording provides."""

    @property
    def reached_goal(self) -> Bool[np.ndarray, " b"]:
        """Whether the ego is at its goal or beyond."""
        return np.asarray(self.route_m >= self.goal_m - GOAL_TOLERANCE_M)

    @property
    def collision(self) -> Bool[np.ndarray, " b"]:
        """Whether the ego touches any agent."""
        return np.asarray((self.contacts > 0).any(axis=1))

    @property
    def at_fault(self) -> Bool[np.ndarray, " b"]:
        """Whether the ego touches an agent and is at fault."""
        return np.asarray(_AT_FAULT[self.contacts].any(axis=1))


class World(ABC):
    """B episodes of scenarios that are stepped together on arrays: the socket for worlds.

    A step executes the actions of the *controlled* agents through the bicycle model; the world
    itself moves the *uncontrolled* ones. Worlds differ only in how uncontrolled agents move. A
    subclass sets `traffic` and implements `_move`; one with a state beyond `episodes` extends
    `reset`, `snapshot` and `restore` as well. Its constructor takes the arguments of this one. It
    is registered under the scheme of its DATA, in the entry point group `asp_env.worlds`.

    Every episode has its own random generator, which drivers draw from; the world draws nothing.
    """

    traffic: ClassVar[str]
    """Name of the driver that leaves all agents uncontrolled, such as `log`."""

    def __init__(
        self, recordings: Sequence[Recording], *, num_episodes: int, dt_s: float, history: int
    ) -> None:
        """Creates a world without episodes; `reset` starts them.

        Args:
            recordings: the recordings that scenarios refer to by index.
            num_episodes: B.
            dt_s: length of a tick.
            history: past ticks that scenes show.
        """
        self.recordings = recordings
        self.dt_s = dt_s
        self.history = history
        self.rngs: list[np.random.Generator] = [np.random.default_rng(0)] * num_episodes
        self.scenarios: list[Scenario | None] = [None] * num_episodes
        self.episodes = empty_episodes(num_episodes, ticks=history + 2, agents=1, points=2)
        self._maps: tuple[RoadMap, ...] = ()
        self._map_index = np.zeros(num_episodes, dtype=np.int64)
        self._any_signals = False
        self._rows = np.arange(num_episodes)
        self._euler: Bool[np.ndarray, "b a"] | None = None
        """Mask of agents that move by Euler's method in the step that is under way."""

    def __len__(self) -> int:
        """The number of episodes."""
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
        """Starts episodes.

        Args:
            scenarios: the scenario of each episode; entries outside `reset_mask` are not read.
            rngs: the random generator of each episode, likewise.
            reset_mask: mask of the episodes to start, all by default.

        Raises:
            AspEnvError: a scenario does not fit its recording.
        """
        started = np.flatnonzero(
            np.ones(len(self), dtype=bool) if reset_mask is None else reset_mask
        )
        if not len(started):
            return
        inits = [
            initialize(
                self.recordings[scenarios[b].recording],
                scenarios[b],
                dt_s=self.dt_s,
                history=self.history,
            )
            for b in started.tolist()
        ]
        self.episodes = self.episodes.with_room(
            ticks=max(init.ticks for init in inits),
            agents=max(len(init.tracks) for init in inits),
            points=max(len(init.route) for init in inits),
        )
        write_inits(self.episodes, started, inits, self.history)
        for b in started.tolist():
            self.scenarios[b], self.rngs[b] = scenarios[b], rngs[b]
        self._find_maps()

    def _find_maps(self) -> None:
        used, index = np.unique(self.episodes.recording, return_inverse=True)
        self._maps = tuple(self.recordings[int(i)].road_map for i in used)
        self._map_index = index.reshape(-1)
        self._any_signals = any(self.recordings[int(i)].signals is not None for i in used)

    def step(
        self,
        actions: Float[np.ndarray, "b a 2"],
        controlled: Bool[np.ndarray, "b a"],
        leaving: Bool[np.ndarray, "b a"] | None = None,
        euler: Bool[np.ndarray, "b a"] | None = None,
    ) -> None:
        """Advances all episodes by one tick; an episode at the end of its scenario stays unchanged.

        Args:
            actions: [acceleration m/s², steering rad] of all agents; only those of controlled
                agents are read.
            controlled: mask of the agents that execute their action. The others are moved by the
                world. An agent that is controlled before it appears stays absent.
            leaving: mask of the agents that leave the episode, none by default.
            euler: mask of the controlled agents whose action is integrated by Euler's method, as
                that of `Control`; Heun's method by default.
        """
        episodes, self._euler = self.episodes, euler
        rows = np.flatnonzero(episodes.elapsed < episodes.length)
        now = self.now[rows]
        if leaving is not None:
            episodes.departed[rows] |= leaving[rows]
        controlled = controlled[rows]
        acting = controlled & episodes.valid[rows, now]
        self._move(rows, now, actions, controlled, acting)
        episodes.elapsed[rows] += 1
        # a negative arc length would make the search global
        near = np.maximum(episodes.on_route[:, 0], 0.0)
        on_route = route_coordinates(episodes.route, episodes.route_valid, self.ego_states(), near)
        episodes.on_route[rows] = on_route[rows]
        self._update_contacts()

    @abstractmethod
    def _move(
        self,
        rows: Int[np.ndarray, " r"],
        now: Int[np.ndarray, " r"],
        actions: Float[np.ndarray, "b a 2"],
        controlled: Bool[np.ndarray, "r a"],
        acting: Bool[np.ndarray, "r a"],
    ) -> None:
        """Writes `states` and `valid` of `episodes` at tick `now + 1`.

        Agents that have `departed` must not be valid. `_drive` moves the acting agents.

        Args:
            rows: indices of the R episodes that are not over.
            now: present tick of each of these episodes.
            actions: [acceleration m/s², steering rad] for all B episodes.
            controlled: mask of agents that the world must not move.
            acting: mask of controlled agents that are present: they execute their action.
        """

    def _drive(
        self,
        states: Float[np.ndarray, "n 4"],
        actions: Float[np.ndarray, "n 2"],
        lengths: Float[np.ndarray, " n"],
        after_s: float,
        rows: Int[np.ndarray, " r"],
        acting: Bool[np.ndarray, "r a"],
    ) -> Float[np.ndarray, "n 4"]:
        """The states of the N acting agents some time after the present tick.

        Args:
            states: their present states, as `gather_controlled` returns them.
            actions: their actions.
            lengths: their lengths, m.
            after_s: the time, at most one tick.
            rows: as in `_move`.
            acting: as in `_move`.
        """
        after = forward(states, actions, lengths, after_s)
        if self._euler is not None and (euler := self._euler[rows][acting]).any():
            after[euler] = forward(
                states[euler], actions[euler], lengths[euler], after_s, integrator="euler"
            )
        return after

    def _update_contacts(self) -> None:
        episodes, now = self.episodes, self.now
        states, valid = episodes.states[self._rows, now], episodes.valid[self._rows, now]
        episodes.contacts = ego_contacts(
            states, episodes.sizes, valid & ~episodes.own_trailer, episodes.contacts
        )

    def scene(
        self,
        rows: Int[np.ndarray, " r"] | None = None,
        targets: Int[np.ndarray, "t 2"] | None = None,
        history: int | None = None,
    ) -> Scene:
        """All that may be known now, in fresh arrays.

        Args:
            rows: indices of the R episodes that are its situations, in their order; all by default.
            targets: (situation, slot) of the targets; by default all present agents but the egos.
            history: number of past ticks; that of the world by default.
        """
        episodes = self.episodes
        history = self.history if history is None else history
        every_row = rows is None
        rows = self._rows if rows is None else rows
        if history:
            self._infer_actions(rows)
        states, valid = last_ticks(episodes, self.now, rows, history)
        past = self.now[rows, None] + np.arange(-history, 0)
        actions = np.ascontiguousarray(episodes.actions[rows[:, None], past].swapaxes(1, 2))
        if targets is None:
            present = valid[..., -1].copy()
            present[:, EGO] = False
            targets = np.argwhere(present)
        seen = np.asarray(valid.any(axis=-1))  # agents that appear later are not known yet
        sizes, classes, ids, route, route_valid = (
            column.copy() if every_row else column[rows]
            for column in (
                episodes.sizes,
                episodes.classes,
                episodes.ids,
                episodes.route,
                episodes.route_valid,
            )
        )
        return Scene(
            states=states,
            actions=actions,
            valid=valid,
            sizes=np.where(seen[..., None], sizes, 0).astype(np.float32),
            classes=np.where(seen, classes, 0).astype(np.int32),
            ids=np.where(seen, ids, -1),
            tick=episodes.start_tick[rows] + episodes.elapsed[rows],
            targets=targets,
            route=route,
            route_valid=route_valid,
            maps=self._maps,
            map_index=self._map_index if every_row else self._map_index[rows],
            dt_s=self.dt_s,
            signals=self.signals(rows, history),
        )

    def signals(
        self, rows: Int[np.ndarray, " r"], history: int | None = None
    ) -> SceneSignals | None:
        """The traffic signals up to now; None if no recording of the episodes has any.

        Args:
            rows: indices of R episodes, which are the situations of the result.
            history: number of past ticks; that of the world by default.
        """
        if not self._any_signals:
            return None
        episodes = self.episodes
        return gather_signals(
            [self.recordings[int(number)] for number in episodes.recording[rows]],
            episodes.start_tick[rows] + episodes.elapsed[rows],
            history=self.history if history is None else history,
            dt_s=self.dt_s,
        )

    def _infer_actions(self, wanted: Int[np.ndarray, " r"]) -> None:
        """Brings `episodes.actions` of some episodes up to date."""
        episodes = self.episodes
        behind = self.now[wanted] - episodes.num_actions[wanted]
        for missing in np.unique(behind[behind > 0]).tolist():
            rows = wanted[behind == missing]
            ticks = episodes.num_actions[rows, None] + np.arange(missing + 1)
            states = episodes.states[rows[:, None], ticks].swapaxes(1, 2)
            valid = episodes.valid[rows[:, None], ticks].swapaxes(1, 2)
            actions = infer_actions(states, valid, episodes.sizes[rows, :, 0], self.dt_s)
            episodes.actions[rows[:, None], ticks[:, :-1]] = actions.swapaxes(1, 2)
            episodes.num_actions[rows] += missing

    def maps(self) -> tuple[tuple[RoadMap, ...], Int[np.ndarray, " b"]]:
        """The maps of the episodes' recordings, and the index of each episode's map in them."""
        return self._maps, self._map_index

    def ego_states(self) -> Float[np.ndarray, "b 4"]:
        """The egos' present states [x m, y m, heading rad, speed m/s]."""
        return self.episodes.states[self._rows, self.now, EGO]

    def events(self) -> Events:
        """The egos' present situation, in fresh arrays."""
        episodes = self.episodes
        return Events(
            contacts=episodes.contacts.copy(),
            off_road_m=self._off_road_m(),
            route_m=episodes.on_route[:, 0].copy(),
            route_offset_m=episodes.on_route[:, 1].copy(),
            route_heading_rad=episodes.on_route[:, 2].copy(),
            goal_m=episodes.goal_m.copy(),
            elapsed=episodes.elapsed.copy(),
            length=episodes.length.copy(),
        )

    def _off_road_m(self) -> Float[np.ndarray, " b"]:
        egos, sizes = self.ego_states(), self.episodes.sizes[:, EGO]
        off_road_m = np.zeros(len(egos), dtype=np.float32)
        for index, road_map in enumerate(self._maps):
            drivable_field(road_map).corners_m(egos, sizes, self._map_index == index, off_road_m)
        return beyond_log_m(off_road_m, self.episodes.on_route, self.episodes.log_off_road_m)

    def set_lengths(self, lengths: Int[np.ndarray, " b"]) -> None:
        """Lets episodes end at other ticks than their scenarios do.

        Beyond the end of a scenario, uncontrolled agents replay their tracks, as before it. Agents
        that are recorded only after that end do not appear.

        Args:
            lengths: number of ticks of each episode, counted from its start.
        """
        later = np.flatnonzero(lengths > self.episodes.length).tolist()
        last = self.history + self.episodes.length
        self.episodes = episodes = self.episodes.with_room(
            ticks=self.history + 1 + int(lengths.max()), agents=0, points=0
        )
        for b in later:
            recording, agents = self.recordings[int(episodes.recording[b])], episodes.ids[b] >= 0
            added = slice(last[b] + 1, self.history + 1 + lengths[b])
            states, valid = gather_window(
                recording,
                episodes.tracks[b, agents],
                first_tick=int(episodes.start_tick[b] + episodes.length[b]) + 1,
                num_ticks=int(lengths[b] - episodes.length[b]),
                stride=frames_per_tick(recording.frame_rate_hz, self.dt_s),
            )
            episodes.log_states[b, added][:, agents] = states.swapaxes(0, 1)
            episodes.log_valid[b, added][:, agents] = valid.T
        episodes.length[:] = lengths

    def snapshot(self) -> Any:
        """A copy of the whole state, for `restore`."""
        return self.episodes.copy(), list(self.scenarios), copy.deepcopy(self.rngs)

    def restore(self, snapshot: Any) -> None:
        """Returns to the state of a snapshot, bit for bit."""
        episodes, scenarios, rngs = snapshot
        self.episodes, self.scenarios = episodes.copy(), list(scenarios)
        self.rngs = copy.deepcopy(rngs)
        self._find_maps()


class ReplayWorld(World):
    """A world of recordings: uncontrolled agents replay their recorded tracks."""

    traffic = "log"

    def _move(
        self,
        rows: Int[np.ndarray, " r"],
        now: Int[np.ndarray, " r"],
        actions: Float[np.ndarray, "b a 2"],
        controlled: Bool[np.ndarray, "r a"],
        acting: Bool[np.ndarray, "r a"],
    ) -> None:
        states, held, lengths = gather_controlled(self.episodes, rows, now, actions, acting)
        next_states = self._drive(states, held, lengths, self.dt_s, rows, acting)
        write_tick(self.episodes, rows, now, controlled, acting, next_states)


def world_class(source: str) -> type[World]:
    """The world for DATA: the one registered for its scheme, else `ReplayWorld`.

    Args:
        source: DATA as given on the command line: a folder or `scheme:argument`.

    Raises:
        AspEnvError: a package that the registered world needs is missing.
    """
    scheme = scheme_of(source)
    if scheme is None or scheme not in registry.names("worlds"):
        return ReplayWorld
    return registry.find("worlds", scheme)


def recorded_future(
    world: World, scene: Scene, horizon: int, rows: Int[np.ndarray, " r"] | None = None
) -> Future:
    """The recorded states of a scene's targets, for privileged predictors only.

    Args:
        world: the world that the scene was taken from.
        scene: the present scene, with N targets.
        horizon: number of ticks.
        rows: indices of the episodes that are the situations of the scene; all by default.

    Returns:
        States (N, horizon, 4) from the next tick on, however the targets really move.
    """
    episodes, situation, slot = world.episodes, scene.targets[:, 0], scene.targets[:, 1]
    b = situation if rows is None else rows[situation]
    index = SnippetIndex(
        recording=episodes.recording[b],
        track=episodes.tracks[b, slot],
        tick=scene.tick[situation],
        dt_s=world.dt_s,
        history=0,
        horizon_ticks=horizon,
    )
    states, valid = gather_ticks(world.recordings, index, 1 + np.arange(horizon))
    return Future(states=states, valid=valid)
