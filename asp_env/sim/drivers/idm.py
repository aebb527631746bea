"""Vehicles that follow their logged path, give way, and react to whoever is on it."""

import numpy as np
from jaxtyping import Bool

from asp_env.data.clock import frames_per_tick
from asp_env.sim.drivers.arrivals import barred
from asp_env.sim.drivers.conflicts import Ahead, Conflicts
from asp_env.sim.drivers.driver import Control, Plain, idle, resized, vehicles
from asp_env.sim.drivers.paths import Paths
from asp_env.sim.drivers.yielding import follow_and_yield
from asp_env.sim.idm import IDM
from asp_env.sim.scenario_world import ScenarioWorld

HALTED_M = 1.0
"""A vehicle that is to halt has done so within this distance of the place."""


class IDMDriver(Plain):
    """Vehicles follow their logged path, give way, and react to whoever is on it; others replay.

    A vehicle wants the highest speed that it had in its log. It leaves behind the path's end; one
    whose log ends with it standing comes to stand there, and leaves when the log has ended.
    """

    name = "idm"

    def __init__(self, idm: IDM | None = None) -> None:
        """A driver with the given parameters, or the default ones."""
        self.idm = idm or IDM()
        self._paths = Paths(self.idm)
        self.conflicts = Conflicts(self._paths)
        self.ahead = Ahead()
        self._mine = np.zeros((0, 0), dtype=bool)
        self._numbers = np.zeros((0, 0), dtype=np.int64)
        """Of the agents' paths; -1 for those without."""
        self._rows = np.zeros((0, 0), dtype=np.int64)
        """Of each track's recorded frames, the one at the first tick."""
        self._strides = np.zeros(0, dtype=np.int64)
        self._arcs = np.zeros((0, 0))
        """How far along its path each agent is; negative where that is to be looked up."""

    def reset(
        self,
        world: ScenarioWorld,
        where: Bool[np.ndarray, " b"],
        mine: Bool[np.ndarray, "b a"] | None = None,
    ) -> None:
        """Takes the paths of the new episodes' agents from their recordings."""
        self._mine = vehicles(world) if mine is None else mine
        self._fit()
        episodes, paths = world.episodes, self._paths
        for number in np.unique(episodes.recording[where]).tolist():
            recording = world.recordings[number]
            here = where & (episodes.recording == number)
            base = paths.base(world.recordings, number)
            moves = (episodes.ids[here] >= 0) & ~episodes.parked[here]
            self._numbers[here] = np.where(moves, base + episodes.tracks[here], -1)
            self._strides[here] = frames_per_tick(recording.frame_rate_hz, world.dt_s)
        numbers = self._numbers[where]
        frames = (episodes.start_tick[where] * self._strides[where])[:, None]
        self._rows[where] = frames - paths.first_frames[numbers]
        at = paths.rows[numbers] + np.maximum(self._rows[where], 0)
        self._arcs[where] = paths.arcs[np.minimum(at, paths.rows[numbers + 1] - 1)]
        self.conflicts.deal(self._numbers, self._mine, self._arcs, where, self.ahead)
        self._arcs[where] = -1.0

    def control(self, world: ScenarioWorld) -> Control:
        """What the law says for the present states."""
        control = self.drive(world, self._mine)
        stays_away = barred(world, self._mine)
        return Control(
            actions=control.actions, driven=control.driven, leaving=control.leaving | stays_away
        )

    def drive(self, world: ScenarioWorld, some: Bool[np.ndarray, "b a"]) -> Control:
        """The same for some of its agents, while the others are moved by somebody else."""
        episodes, paths, ahead = world.episodes, self._paths, self.ahead
        rows, now = np.arange(len(world)), world.now
        out = idle(self._mine.shape)
        driven = some & episodes.valid[rows, now]
        follow_and_yield(
            episodes.states, episodes.valid, episodes.sizes, now,
            episodes.elapsed < episodes.length, driven, self._numbers, self._rows, self._strides,
            episodes.elapsed, self._arcs, paths.points, paths.limits, paths.firsts, paths.arcs,
            paths.rows, self.conflicts.zones, ahead.zones, ahead.others, ahead.counts,
            self.idm.as_row(), world.dt_s, out.actions,
        )  # fmt: skip
        ends = np.where(self._numbers >= 0, paths.ends[self._numbers], np.inf)
        halts = paths.halts[self._numbers]
        waits = halts & episodes.log_valid[rows, now]
        leaving = driven & (self._arcs >= ends - HALTED_M * halts) & ~waits
        return Control(actions=out.actions, driven=driven & ~leaving, leaving=leaving)

    def _fit(self) -> None:
        shape = self._mine.shape
        self._strides = resized(self._strides, shape[:1])
        for name in ("_numbers", "_rows", "_arcs"):
            setattr(self, name, resized(getattr(self, name), shape))
