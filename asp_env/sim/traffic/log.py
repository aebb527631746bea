"""Drivers without a model: of recorded traffic, of self-driving worlds, and of the caller's agents.

`log` and `own` leave all agents to the world, `log-actions` executes recorded actions, and `policy`
reserves its agents for the caller.
"""

from typing import no_type_check

import numpy as np
from jaxtyping import Bool

from asp_env.compiled import njit
from asp_env.dynamics import inverse
from asp_env.errors import AspEnvError
from asp_env.sim.traffic.driver import (
    BaseDriver,
    Control,
    controllable_agents,
    exit_bounds,
    no_control,
    outside_bounds,
    require_replay,
    resized,
)
from asp_env.sim.world import World


class LogDriver(BaseDriver):
    """All agents replay their recorded tracks."""

    name = "log"

    def reset(
        self,
        world: World,
        reset_mask: Bool[np.ndarray, " b"],
        agent_mask: Bool[np.ndarray, "b a"] | None = None,
    ) -> None:
        """Checks that the world replays tracks.

        Raises:
            AspEnvError: it does not.
        """
        del reset_mask, agent_mask
        require_replay(world, self.name)

    def control(self, world: World) -> Control:
        """No agent is controlled."""
        return no_control(world.episodes.ids.shape)


class OwnDriver(BaseDriver):
    """All agents are left to a world whose vehicles drive themselves."""

    name = "own"

    def reset(
        self,
        world: World,
        reset_mask: Bool[np.ndarray, " b"],
        agent_mask: Bool[np.ndarray, "b a"] | None = None,
    ) -> None:
        """Checks that the vehicles of the world drive themselves.

        Raises:
            AspEnvError: they do not.
        """
        del reset_mask, agent_mask
        if world.traffic != self.name:
            raise AspEnvError(
                f"traffic {self.name}: vehicles of recordings do not drive themselves; use "
                f"{world.traffic}, idm or predictor:NAME"
            )

    def control(self, world: World) -> Control:
        """No agent is controlled."""
        return no_control(world.episodes.ids.shape)


class LogActionsDriver(BaseDriver):
    """Vehicles execute the actions inferred from their tracks, regardless of where these lead.

    A vehicle leaves when its track ends.
    """

    name = "log-actions"

    def __init__(self) -> None:
        self._agent_mask = np.zeros((0, 0), dtype=bool)
        self._actions = np.zeros((0, 0, 0, 2), dtype=np.float32)
        """[acceleration m/s², steering rad] from each tick to the next: (B, ticks, A, 2)."""
        self._action_valid = np.zeros((0, 0, 0), dtype=bool)

    def reset(
        self,
        world: World,
        reset_mask: Bool[np.ndarray, " b"],
        agent_mask: Bool[np.ndarray, "b a"] | None = None,
    ) -> None:
        """Infers the actions of the new episodes' tracks."""
        self._agent_mask = controllable_agents(world) if agent_mask is None else agent_mask
        episodes = world.episodes
        states = episodes.log_states[reset_mask, world.history :]
        valid = episodes.log_valid[reset_mask][:, world.history :]
        shape = (len(world), valid.shape[1] - 1, valid.shape[2])
        self._action_valid = resized(self._action_valid, shape)
        self._actions = resized(self._actions, (*shape, 2))
        both = valid[:, :-1] & valid[:, 1:] & self._agent_mask[reset_mask][:, None]
        lengths = np.maximum(episodes.sizes[reset_mask, None, :, 0], 0.1)
        actions = inverse(states[:, :-1], states[:, 1:], lengths, world.dt_s)
        self._actions[reset_mask] = np.where(both[..., None], actions, 0)
        self._action_valid[reset_mask] = both

    def control(self, world: World) -> Control:
        """The recorded actions of this tick; a vehicle whose track has a gap leaves."""
        episodes = world.episodes
        control = no_control(episodes.ids.shape)
        _recorded_control(
            *(self._actions, self._action_valid, self._agent_mask),
            *(episodes.valid, world.now, episodes.elapsed),
            *(control.actions, control.controlled, control.leaving),
        )
        return control


@njit(cache=True)
@no_type_check
def _recorded_control(
    recorded, recorded_valid, agent_mask, valid, now, elapsed, actions, controlled, leaving
):
    """Fills in a control with the recorded actions of the present tick.

    Args:
        recorded: (B, T, A, 2) recorded actions [acceleration m/s², steering rad].
        recorded_valid: (B, T, A) mask of recorded actions.
        agent_mask: (B, A) mask of the driver's agents.
        valid: (B, K, A) mask of present agents.
        now: (B,) index of the present tick on the axis K.
        elapsed: (B,) index of the present tick on the axis T.
        actions: (B, A, 2), written.
        controlled: (B, A), written.
        leaving: (B, A), written.
    """
    for b in range(len(now)):
        step = min(elapsed[b], recorded_valid.shape[1] - 1)
        for a in range(agent_mask.shape[1]):
            if not agent_mask[b, a]:
                continue
            if recorded_valid[b, step, a]:
                controlled[b, a] = True
                actions[b, a, 0] = recorded[b, step, a, 0]
                actions[b, a, 1] = recorded[b, step, a, 1]
            elif valid[b, now[b], a]:
                leaving[b, a] = True


class PolicyDriver(BaseDriver):
    """Reserves its agents for the caller of `Simulation.step_agents`.

    An agent that the caller does not control at a tick continues without acceleration or steering.
    It leaves 10 m outside the area of all recorded positions.
    """

    name = "policy"

    def __init__(self) -> None:
        self._agent_mask = np.zeros((0, 0), dtype=bool)
        self._bounds = np.zeros((0, 4))

    def reset(
        self,
        world: World,
        reset_mask: Bool[np.ndarray, " b"],
        agent_mask: Bool[np.ndarray, "b a"] | None = None,
    ) -> None:
        """Stores the agents and the bounds of the new episodes."""
        self._agent_mask = controllable_agents(world) if agent_mask is None else agent_mask
        self._bounds = resized(self._bounds, (len(world), 4))
        self._bounds[reset_mask] = exit_bounds(world)[reset_mask]

    def control(self, world: World) -> Control:
        """Zero actions for all present agents."""
        episodes, rows = world.episodes, np.arange(len(world))
        present = self._agent_mask & episodes.valid[rows, world.now]
        leaving = present & outside_bounds(episodes.states[rows, world.now], self._bounds)
        actions = no_control(present.shape).actions
        return Control(actions=actions, controlled=present & ~leaving, leaving=leaving)
