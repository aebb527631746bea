"""Who moves the agents that the caller does not: a table agent → driver, merged by mask."""

import math
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float

from asp_env.data.classes import PREDICTED, AgentClass
from asp_env.data.clock import frames_per_tick
from asp_env.data.geometry import route_along
from asp_env.data.scenario import STANDING_MPS
from asp_env.dynamics import inverse
from asp_env.errors import unknown_name
from asp_env.sim.beginning import BEYOND_M
from asp_env.sim.idm import IDM, follow_paths, speed_limits
from asp_env.sim.replay import ReplayWorld
from asp_env.sim.world import EGO

MIN_DESIRED_MPS = 3.0
"""Nobody wants to stand: a vehicle that the log shows waiting wants at least this speed."""

HALTED_M = 1.0
"""A vehicle that is to halt has done so within this distance of the place."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Control:
    """What a driver wants its agents to do in the coming tick."""

    actions: Float[np.ndarray, "b a 2"]
    driven: Bool[np.ndarray, "b a"]
    leaving: Bool[np.ndarray, "b a"]


@runtime_checkable
class Driver(Protocol):
    """Moves some agents of a world. It may keep arrays between ticks, made anew by `reset`."""

    def reset(self, world: ReplayWorld, where: Bool[np.ndarray, " b"]) -> None:
        """The episodes at `where` have just begun; sizes of the world's arrays may have grown."""
        ...

    def control(self, world: ReplayWorld) -> Control:
        """What its agents do from now to the next tick."""
        ...


def _vehicles(world: ReplayWorld) -> Bool[np.ndarray, "b a"]:
    kinds = [int(kind) for kind in PREDICTED | {AgentClass.BICYCLE}]
    episodes = world.episodes
    vehicles = np.isin(episodes.classes, kinds) & ~episodes.parked & (episodes.ids >= 0)
    vehicles[:, EGO] = False
    return vehicles


class LogDriver:
    """Everybody moves exactly as recorded."""

    def reset(self, world: ReplayWorld, where: Bool[np.ndarray, " b"]) -> None:
        """Nothing to prepare."""

    def control(self, world: ReplayWorld) -> Control:
        """Nobody is driven: the world replays."""
        shape = world.episodes.ids.shape
        nobody = np.zeros(shape, dtype=bool)
        return Control(
            actions=np.zeros((*shape, 2), dtype=np.float32), driven=nobody, leaving=nobody
        )


class LogActionsDriver:
    """Vehicles carry out the actions inferred from their log, whatever comes of it.

    Others replay. A vehicle leaves when its log ends.
    """

    def reset(self, world: ReplayWorld, where: Bool[np.ndarray, " b"]) -> None:
        """Nothing to prepare."""

    def control(self, world: ReplayWorld) -> Control:
        """The logged actions of this tick."""
        episodes = world.episodes
        rows, now = np.arange(len(world)), world.now
        after = np.minimum(now + 1, episodes.log_valid.shape[1] - 1)
        lasts = episodes.log_valid[rows, now] & episodes.log_valid[rows, after]
        vehicles = _vehicles(world)
        actions = inverse(
            episodes.log_states[rows, now],
            episodes.log_states[rows, after],
            np.maximum(episodes.sizes[..., 0], 0.1),
            world.dt_s,
        )
        return Control(
            actions=np.where(lasts[..., None], actions, 0).astype(np.float32),
            driven=vehicles & lasts,
            leaving=vehicles & ~lasts & episodes.valid[rows, now],
        )


class IDMDriver:
    """Vehicles follow their logged path and react to whoever is on it; others replay.

    A vehicle wants the highest speed that it had in its log. It leaves behind the path's end; one
    whose log ends with it standing comes to stand there, and leaves when the log has ended.
    """

    def __init__(self, idm: IDM | None = None) -> None:
        """A driver with the given parameters, or the default ones."""
        self.idm = idm or IDM()
        self._paths = np.zeros((0, 0, 0, 2), dtype=np.float32)
        self._limits = np.zeros((0, 0, 0), dtype=np.float32)
        self._counts = np.zeros((0, 0), dtype=np.int64)
        self._halts = np.zeros((0, 0), dtype=bool)
        self._ends = np.zeros((0, 0), dtype=np.float64)
        self._arcs = np.zeros((0, 0), dtype=np.float64)

    def reset(self, world: ReplayWorld, where: Bool[np.ndarray, " b"]) -> None:
        """Takes the paths of the new episodes' vehicles from their recordings."""
        found: dict[tuple[int, int], tuple[np.ndarray, float, bool]] = {}
        vehicles = _vehicles(world)
        for b, a in np.argwhere(vehicles & where[:, None]).tolist():
            found[b, a] = self._path(world, b, a)
        points = max([self._paths.shape[2], *(len(path) for path, _, _ in found.values())])
        self._grow(vehicles.shape[0], vehicles.shape[1], points)
        self._counts[where] = 0
        self._arcs[where] = 0.0
        for (b, a), (path, desired_mps, halts) in found.items():
            end = len(path) - 1 - BEYOND_M
            stop = end if halts else math.inf
            limits = speed_limits(path, desired_mps, self.idm, stop_m=stop)
            self._paths[b, a, : len(path)], self._limits[b, a, : len(path)] = path, limits
            self._counts[b, a], self._halts[b, a] = len(path), halts
            self._ends[b, a] = end - HALTED_M if halts else end

    def control(self, world: ReplayWorld) -> Control:
        """What the law says for the present states."""
        episodes = world.episodes
        rows = np.arange(len(world))
        states = np.ascontiguousarray(episodes.states[rows, world.now])
        valid = np.ascontiguousarray(episodes.valid[rows, world.now])
        driven = _vehicles(world) & valid
        actions = follow_paths(
            states,
            episodes.sizes,
            valid,
            driven,
            self._paths,
            self._counts,
            self._limits,
            self._arcs,
            self.idm,
        )
        waits = self._halts & episodes.log_valid[rows, world.now]
        leaving = driven & (self._arcs >= self._ends) & ~waits
        return Control(actions=actions, driven=driven & ~leaving, leaving=leaving)

    def _path(self, world: ReplayWorld, b: int, a: int) -> tuple[np.ndarray, float, bool]:
        """(path, desired speed m/s, whether the log ends with the vehicle standing)."""
        episodes = world.episodes
        recording = world.recordings[int(episodes.recording[b])]
        track = int(episodes.tracks[b, a])
        stride = frames_per_tick(recording.frame_rate_hz, world.dt_s)
        begin = int(episodes.start_tick[b]) * stride - int(recording.first_frames[track])
        states = recording.track(track)[max(begin, 0) :: stride]
        if not len(states):
            states = recording.track(track)[-1:]
        fastest = float(np.abs(recording.track(track)[:, 3]).max())
        halts = bool(abs(states[-1, 3]) < STANDING_MPS)
        return route_along(states, beyond_m=BEYOND_M), max(fastest, MIN_DESIRED_MPS), halts

    def _grow(self, episodes: int, agents: int, points: int) -> None:
        if (episodes, agents, points) == self._limits.shape:
            return
        for name in ("_paths", "_limits", "_counts", "_halts", "_ends", "_arcs"):
            old = getattr(self, name)
            new = np.zeros((episodes, agents, points, 2)[: old.ndim], dtype=old.dtype)
            new[tuple(map(slice, old.shape))] = old
            setattr(self, name, new)


DRIVERS: dict[str, type[LogDriver] | type[LogActionsDriver] | type[IDMDriver]] = {
    "log": LogDriver,
    "log-actions": LogActionsDriver,
    "idm": IDMDriver,
}
"""Drivers of the traffic around the ego, by name."""


def make_driver(name: str) -> Driver:
    """The driver of a name.

    Raises:
        AspEnvError: the name is unknown.
    """
    if name not in DRIVERS:
        raise unknown_name("traffic", name, DRIVERS)
    return DRIVERS[name]()
