"""The driver `hybrid`: vehicles replay their tracks until these conflict with the ego."""

import math
from typing import no_type_check

import numpy as np
from jaxtyping import Bool

from asp_env.compiled import njit
from asp_env.data.scene import EGO
from asp_env.dynamics import MAX_ACCELERATION_MPS2
from asp_env.geometry import overlaps, point_on_route, wrap_scalar
from asp_env.sim.traffic.driver import (
    BaseDriver,
    Control,
    controllable_agents,
    require_replay,
    resized,
)
from asp_env.sim.traffic.idm import IDMDriver
from asp_env.sim.world import World

HORIZON_S = 2.0
"""How far ahead a vehicle checks its recorded track for conflicts. Chosen by hand."""

AS_LOGGED_M, AS_LOGGED_MPS = 0.5, 0.5
"""An ego this close to its recorded position and speed is expected to continue as recorded. Chosen
by hand."""

OFF_ROUTE_M, OFF_ROUTE_RAD = 2.0, math.pi / 4
"""An ego farther from its route, or at a larger angle to it, is expected to continue straight.
Chosen by hand."""


class HybridDriver(BaseDriver):
    """Vehicles replay their tracks until these conflict with the ego, then they are `idm`.

    At every tick each vehicle looks 2 s ahead: if its recorded box at a coming tick overlaps the
    box where the ego is expected then, it switches to `idm` for the rest of its episode, from its
    present state. The ego is expected to continue along its route at its present speed and offset;
    an ego within 0.5 m and 0.5 m/s of its own track is expected to continue as recorded and
    switches no vehicle. Vehicles that have switched make others switch in the same way, so that
    none drives through them.
    """

    name = "hybrid"

    def __init__(self) -> None:
        self._idm = IDMDriver()
        self._agent_mask = np.zeros((0, 0), dtype=bool)
        self._switched = np.zeros((0, 0), dtype=bool)
        """Mask of vehicles that have switched to `idm`."""

    def reset(
        self,
        world: World,
        reset_mask: Bool[np.ndarray, " b"],
        agent_mask: Bool[np.ndarray, "b a"] | None = None,
    ) -> None:
        """Lets all vehicles of the new episodes replay.

        Raises:
            AspEnvError: the world replays no tracks.
        """
        require_replay(world, self.name)
        self._agent_mask = controllable_agents(world) if agent_mask is None else agent_mask
        self._switched = resized(self._switched, self._agent_mask.shape)
        self._switched[reset_mask] = False
        self._idm.reset(world, reset_mask, self._agent_mask)

    def control(self, world: World) -> Control:
        """The control of `idm` for vehicles that have switched; the others are uncontrolled."""
        episodes = world.episodes
        _switch(
            *(episodes.states, episodes.valid, episodes.log_states, episodes.log_valid),
            *(episodes.sizes, world.now, self._agent_mask),
            *(episodes.route, episodes.route_valid.sum(axis=1), episodes.on_route),
            *(world.dt_s, self._switched),
        )
        return self._idm.control_some(world, self._switched)


@njit(cache=True)
@no_type_check
def _expect(states, now, a, route, count, on_route, dt, expected):
    """Writes the poses (H, 3) that agent `a` of states (K, A, 4) takes at its present speed."""
    x, y, heading, speed = states[now, a]
    turned = wrap_scalar(heading - on_route[2])
    follows = a == EGO and abs(on_route[1]) < OFF_ROUTE_M and abs(turned) < OFF_ROUTE_RAD
    for h in range(len(expected)):
        distance = speed * dt * (h + 1)
        if follows:
            expected[h, 0], expected[h, 1], dx, dy = point_on_route(
                route, count, on_route[0] + distance, on_route[1]
            )
            expected[h, 2] = math.atan2(dy, dx)
        else:
            expected[h, 0] = x + distance * math.cos(heading)
            expected[h, 1] = y + distance * math.sin(heading)
            expected[h, 2] = heading


@njit(cache=True)
@no_type_check
def _out_of_reach(state, size, state_o, size_o):
    """Whether two agents cannot meet within the horizon even if both accelerate by 5 m/s²."""
    distance = (abs(state[3]) + abs(state_o[3])) * HORIZON_S + MAX_ACCELERATION_MPS2 * HORIZON_S**2
    reach = distance + size[0] + size[1] + size_o[0] + size_o[1]
    return (state[0] - state_o[0]) ** 2 + (state[1] - state_o[1]) ** 2 > reach * reach


@njit(cache=True)
@no_type_check
def _log_overlaps(log_states, log_valid, now, a, sizes, o, expected):
    """Whether the track of agent `a` overlaps the expected poses (H, 3) of agent `o`."""
    for h in range(min(len(expected), len(log_valid) - 1 - now)):
        if not log_valid[now + h + 1, a]:
            return False
        x, y, heading, _ = log_states[now + h + 1, a]
        if overlaps(
            x, y, heading, sizes[a, 0], sizes[a, 1],
            expected[h, 0], expected[h, 1], expected[h, 2], sizes[o, 0], sizes[o, 1],
        ):  # fmt: skip
            return True
    return False


@njit(cache=True)
@no_type_check
def _switch(
    states,
    valid,
    log_states,
    log_valid,
    sizes,
    now,
    agent_mask,
    routes,
    counts,
    on_route,
    dt,
    switched,
):
    """Updates the mask of vehicles that have switched to `idm`.

    Args:
        states: (B, K, A, 4) simulated states [x m, y m, heading rad, speed m/s].
        valid: (B, K, A) mask of present agents.
        log_states: (B, K, A, 4) recorded states.
        log_valid: (B, K, A) mask of recorded agents.
        sizes: (B, A, 2) lengths and widths, m.
        now: (B,) index of the present tick.
        agent_mask: (B, A) mask of the driver's agents.
        routes: (B, P, 2) the egos' routes, points 1 m apart.
        counts: (B,) number of valid points of each route.
        on_route: (B, 3) the egos' arc length m, offset m and the route's heading rad.
        dt: length of a tick, s.
        switched: (B, A), read and written.
    """
    expected = np.zeros((round(HORIZON_S / dt), 3))
    for b in range(len(now)):
        t = now[b]
        log = log_states[b, t, EGO]
        away = math.hypot(states[b, t, EGO, 0] - log[0], states[b, t, EGO, 1] - log[1])
        as_logged = away < AS_LOGGED_M and abs(states[b, t, EGO, 3] - log[3]) < AS_LOGGED_MPS
        before = switched[b].copy()
        for o in range(agent_mask.shape[1]):
            deviates = before[o] or (o == EGO and not as_logged)
            if not (deviates and valid[b, t, o]):
                continue
            _expect(states[b], t, o, routes[b], counts[b], on_route[b], dt, expected)
            for a in range(agent_mask.shape[1]):
                replays = agent_mask[b, a] and valid[b, t, a] and not switched[b, a]
                if replays and not _out_of_reach(
                    states[b, t, a], sizes[b, a], states[b, t, o], sizes[b, o]
                ):
                    switched[b, a] = _log_overlaps(
                        log_states[b], log_valid[b], t, a, sizes[b], o, expected
                    )
