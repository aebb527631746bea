"""Vehicles that follow their logged path and react to whoever is on it."""

import math

import numpy as np
from jaxtyping import Bool

from asp_env.data.clock import frames_per_tick
from asp_env.data.geometry import route_along
from asp_env.data.scenario import STANDING_MPS
from asp_env.sim.beginning import BEYOND_M
from asp_env.sim.drivers.driver import Control, refuse_argument, vehicles
from asp_env.sim.idm import IDM, follow_paths, speed_limits
from asp_env.sim.replay import ReplayWorld

MIN_DESIRED_MPS = 3.0
"""Nobody wants to stand: a vehicle that the log shows waiting wants at least this speed."""

HALTED_M = 1.0
"""A vehicle that is to halt has done so within this distance of the place."""


class IDMDriver:
    """Vehicles follow their logged path and react to whoever is on it; others replay.

    A vehicle wants the highest speed that it had in its log. It leaves behind the path's end; one
    whose log ends with it standing comes to stand there, and leaves when the log has ended.
    """

    def __init__(self, idm: IDM | None = None) -> None:
        """A driver with the given parameters, or the default ones."""
        self.idm = idm or IDM()
        self._mine = np.zeros((0, 0), dtype=bool)
        self._paths = np.zeros((0, 0, 0, 2), dtype=np.float32)
        self._limits = np.zeros((0, 0, 0), dtype=np.float32)
        self._counts = np.zeros((0, 0), dtype=np.int64)
        self._halts = np.zeros((0, 0), dtype=bool)
        self._ends = np.zeros((0, 0), dtype=np.float64)
        self._arcs = np.zeros((0, 0), dtype=np.float64)

    @classmethod
    def from_name(cls, argument: str, *, dt_s: float) -> "IDMDriver":
        """The driver; it takes no argument.

        Raises:
            AspEnvError: there is one.
        """
        del dt_s
        refuse_argument("idm", argument)
        return cls()

    def reset(
        self,
        world: ReplayWorld,
        where: Bool[np.ndarray, " b"],
        mine: Bool[np.ndarray, "b a"] | None = None,
    ) -> None:
        """Takes the paths of the new episodes' vehicles from their recordings."""
        found: dict[tuple[int, int], tuple[np.ndarray, float, bool]] = {}
        self._mine = vehicles(world) if mine is None else mine
        for b, a in np.argwhere(self._mine & where[:, None]).tolist():
            found[b, a] = self._path(world, b, a)
        points = max([self._paths.shape[2], *(len(path) for path, _, _ in found.values())])
        self._grow(*self._mine.shape, points)
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
        driven = self._mine & valid
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
