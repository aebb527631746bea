"""Agents that move as recorded: position by position, or by the actions of their log.

MERGED: Agents that the world itself drives.
MERGED: Agents of the caller.
"""

from typing import no_type_check

import numpy as np
from jaxtyping import Bool
from numba import njit

from asp_env.dynamics import inverse
from asp_env.errors import AspEnvError
from asp_env.sim.traffic.driver import (
    BaseDriver,
    Control,
    areas,
    check_replayed,
    no_control,
    outside,
    resized,
    vehicles,
)
from asp_env.sim.world import World


class LogDriver(BaseDriver):
    """Everybody moves exactly as recorded."""

    name = "log"

    def reset(
        self,
        world: World,
        reset_mask: Bool[np.ndarray, " b"],
        agent_mask: Bool[np.ndarray, "b a"] | None = None,
    ) -> None:
        """Nothing to prepare.

        Raises:
            AspEnvError: the world replays nobody.
        """
        del reset_mask, agent_mask
        check_replayed(world, self.name)

    def control(self, world: World) -> Control:
        """Nobody is driven: the world replays."""
        return no_control(world.episodes.ids.shape)


@njit(cache=True)
@no_type_check
def _logged(wanted, lasts, agent_mask, valid, now, elapsed, actions, driven, leaving):
    for b in range(len(now)):
        step = min(elapsed[b], lasts.shape[1] - 1)
        for a in range(agent_mask.shape[1]):
            if not agent_mask[b, a]:
                continue
            if lasts[b, step, a]:
                driven[b, a] = True
                actions[b, a, 0], actions[b, a, 1] = wanted[b, step, a, 0], wanted[b, step, a, 1]
            elif valid[b, now[b], a]:
                leaving[b, a] = True


class LogActionsDriver(BaseDriver):
    """Vehicles carry out the actions inferred from their log, whatever comes of it.

    A vehicle leaves when its log ends.
    """

    name = "log-actions"

    def __init__(self) -> None:
        """A driver without agents; `reset` gives it some."""
        self._agent_mask = np.zeros((0, 0), dtype=bool)
        self._actions = np.zeros((0, 0, 0, 2), dtype=np.float32)
        self._lasts = np.zeros((0, 0, 0), dtype=bool)

    def reset(
        self,
        world: World,
        reset_mask: Bool[np.ndarray, " b"],
        agent_mask: Bool[np.ndarray, "b a"] | None = None,
    ) -> None:
        """Infers the actions of the new episodes' logs."""
        self._agent_mask = vehicles(world) if agent_mask is None else agent_mask
        episodes = world.episodes
        states, valid = (
            episodes.log_states[reset_mask, world.history :],
            episodes.log_valid[reset_mask],
        )
        valid = valid[:, world.history :]
        shape = (len(world), valid.shape[1] - 1, valid.shape[2])
        self._lasts = resized(self._lasts, shape)
        self._actions = resized(self._actions, (*shape, 2))
        lasts = valid[:, :-1] & valid[:, 1:] & self._agent_mask[reset_mask][:, None]
        lengths = np.maximum(episodes.sizes[reset_mask, None, :, 0], 0.1)
        actions = inverse(states[:, :-1], states[:, 1:], lengths, world.dt_s)
        self._actions[reset_mask], self._lasts[reset_mask] = (
            np.where(lasts[..., None], actions, 0),
            lasts,
        )

    def control(self, world: World) -> Control:
        """The logged actions of this tick; somebody who leaves a gap in its log is gone."""
        episodes = world.episodes
        out = no_control(episodes.ids.shape)
        _logged(
            self._actions, self._lasts, self._agent_mask, episodes.valid, world.now, episodes.elapsed,
            out.actions, out.driven, out.leaving,
        )  # fmt: skip
        return out


class OwnDriver(BaseDriver):
    """Everybody is left to a world whose vehicles drive themselves."""

    name = "own"

    def reset(
        self,
        world: World,
        reset_mask: Bool[np.ndarray, " b"],
        agent_mask: Bool[np.ndarray, "b a"] | None = None,
    ) -> None:
        """Nothing to prepare.

        Raises:
            AspEnvError: the world has no drivers of its own.
        """
        del reset_mask, agent_mask
        if world.traffic != self.name:
            raise AspEnvError(
                f"traffic {self.name}: vehicles of recordings do not drive themselves; use "
                f"{world.traffic}, idm or predictor:NAME"
            )

    def control(self, world: World) -> Control:
        """Nobody is driven by anybody else."""
        return no_control(world.episodes.ids.shape)


class PolicyDriver(BaseDriver):
    """The caller moves its agents by `Simulation.step_agents`.

    At a tick at which the caller does not, an agent goes on as it is: no acceleration, no steering.
    One that comes 10 m beyond all recorded positions then leaves.
    """

    name = "policy"

    def __init__(self) -> None:
        """A driver without agents; `reset` gives it some."""
        self._agent_mask = np.zeros((0, 0), dtype=bool)
        self._areas = np.zeros((0, 4))

    def reset(
        self,
        world: World,
        reset_mask: Bool[np.ndarray, " b"],
        agent_mask: Bool[np.ndarray, "b a"] | None = None,
    ) -> None:
        """Remembers whose the agents are."""
        self._agent_mask = vehicles(world) if agent_mask is None else agent_mask
        self._areas = resized(self._areas, (len(world), 4))
        self._areas[reset_mask] = areas(world)[reset_mask]

    def control(self, world: World) -> Control:
        """Straight on, for those whom the caller leaves alone."""
        episodes, rows = world.episodes, np.arange(len(world))
        driven = self._agent_mask & episodes.valid[rows, world.now]
        leaving = driven & outside(episodes.states[rows, world.now], self._areas)
        nothing = no_control(driven.shape)
        return Control(actions=nothing.actions, driven=driven & ~leaving, leaving=leaving)
