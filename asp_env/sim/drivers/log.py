"""Agents that move as recorded: position by position, or by the actions of their log."""

from typing import no_type_check

import numpy as np
from jaxtyping import Bool
from numba import njit

from asp_env.dynamics import inverse
from asp_env.sim.drivers.driver import (
    Control,
    Plain,
    check_replayed,
    idle,
    resized,
    vehicles,
)
from asp_env.sim.scenario_world import ScenarioWorld


class LogDriver(Plain):
    """Everybody moves exactly as recorded."""

    name = "log"

    def reset(
        self,
        world: ScenarioWorld,
        where: Bool[np.ndarray, " b"],
        mine: Bool[np.ndarray, "b a"] | None = None,
    ) -> None:
        """Nothing to prepare.

        Raises:
            AspEnvError: the world replays nobody.
        """
        del where, mine
        check_replayed(world, self.name)

    def control(self, world: ScenarioWorld) -> Control:
        """Nobody is driven: the world replays."""
        return idle(world.episodes.ids.shape)


@njit(cache=True)
@no_type_check
def _logged(wanted, lasts, mine, valid, now, elapsed, actions, driven, leaving):
    for b in range(len(now)):
        step = min(elapsed[b], lasts.shape[1] - 1)
        for a in range(mine.shape[1]):
            if not mine[b, a]:
                continue
            if lasts[b, step, a]:
                driven[b, a] = True
                actions[b, a, 0], actions[b, a, 1] = wanted[b, step, a, 0], wanted[b, step, a, 1]
            elif valid[b, now[b], a]:
                leaving[b, a] = True


class LogActionsDriver(Plain):
    """Vehicles carry out the actions inferred from their log, whatever comes of it.

    A vehicle leaves when its log ends.
    """

    name = "log-actions"

    def __init__(self) -> None:
        """A driver without agents; `reset` gives it some."""
        self._mine = np.zeros((0, 0), dtype=bool)
        self._actions = np.zeros((0, 0, 0, 2), dtype=np.float32)
        self._lasts = np.zeros((0, 0, 0), dtype=bool)

    def reset(
        self,
        world: ScenarioWorld,
        where: Bool[np.ndarray, " b"],
        mine: Bool[np.ndarray, "b a"] | None = None,
    ) -> None:
        """Infers the actions of the new episodes' logs."""
        self._mine = vehicles(world) if mine is None else mine
        episodes = world.episodes
        states, valid = episodes.log_states[where, world.history :], episodes.log_valid[where]
        valid = valid[:, world.history :]
        shape = (len(world), valid.shape[1] - 1, valid.shape[2])
        self._lasts = resized(self._lasts, shape)
        self._actions = resized(self._actions, (*shape, 2))
        lasts = valid[:, :-1] & valid[:, 1:] & self._mine[where][:, None]
        lengths = np.maximum(episodes.sizes[where, None, :, 0], 0.1)
        actions = inverse(states[:, :-1], states[:, 1:], lengths, world.dt_s)
        self._actions[where], self._lasts[where] = np.where(lasts[..., None], actions, 0), lasts

    def control(self, world: ScenarioWorld) -> Control:
        """The logged actions of this tick; somebody who leaves a gap in its log is gone."""
        episodes = world.episodes
        out = idle(episodes.ids.shape)
        _logged(
            self._actions, self._lasts, self._mine, episodes.valid, world.now, episodes.elapsed,
            out.actions, out.driven, out.leaving,
        )  # fmt: skip
        return out
