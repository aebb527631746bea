"""Vehicles that replay their log until that would lead them into the ego."""

import math
from typing import no_type_check

import numpy as np
from jaxtyping import Bool
from numba import njit

from asp_env.data.scene import EGO
from asp_env.dynamics import MAX_ACCELERATION_MPS2
from asp_env.geometry import overlaps, point_on_route, wrap_scalar
from asp_env.sim.traffic.driver import BaseDriver, Control, check_replayed, resized, vehicles
from asp_env.sim.traffic.idm import IDMDriver
from asp_env.sim.world import World

HORIZON_S = 2.0
"""So far ahead a vehicle looks along its log."""

AS_LOGGED_M, AS_LOGGED_MPS = 0.5, 0.5
"""An ego so near to its logged place and speed is taken to go on as logged."""

OFF_ROUTE_M, OFF_ROUTE_RAD = 2.0, math.pi / 4
"""An ego further from its route, or turned further from it, is taken to go straight on."""


@njit(cache=True)
@no_type_check
def _expect(states, now, a, route, count, on_route, dt, ways):
    """Fills in where somebody will be at the coming ticks at its present speed."""
    x, y, heading, speed = states[now, a]
    turned = wrap_scalar(heading - on_route[2])
    follows = a == EGO and abs(on_route[1]) < OFF_ROUTE_M and abs(turned) < OFF_ROUTE_RAD
    for h in range(len(ways)):
        way = speed * dt * (h + 1)
        if follows:
            ways[h, 0], ways[h, 1], dx, dy = point_on_route(
                route, count, on_route[0] + way, on_route[1]
            )
            ways[h, 2] = math.atan2(dy, dx)
        else:
            ways[h, 0] = x + way * math.cos(heading)
            ways[h, 1] = y + way * math.sin(heading)
            ways[h, 2] = heading


@njit(cache=True)
@no_type_check
def _far(state, size, other, size_o):
    """Whether two cannot meet within the horizon, even if both speed up by 5 m/s²."""
    way = (abs(state[3]) + abs(other[3])) * HORIZON_S + MAX_ACCELERATION_MPS2 * HORIZON_S**2
    reach = way + size[0] + size[1] + size_o[0] + size_o[1]
    return (state[0] - other[0]) ** 2 + (state[1] - other[1]) ** 2 > reach * reach


@njit(cache=True)
@no_type_check
def _meets(log_states, log_valid, now, a, sizes, o, ways):
    for h in range(min(len(ways), len(log_valid) - 1 - now)):
        if not log_valid[now + h + 1, a]:
            return False
        x, y, heading, _ = log_states[now + h + 1, a]
        if overlaps(
            x, y, heading, sizes[a, 0], sizes[a, 1],
            ways[h, 0], ways[h, 1], ways[h, 2], sizes[o, 0], sizes[o, 1],
        ):  # fmt: skip
            return True
    return False


@njit(cache=True)
@no_type_check
def _turn(
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
    turned,
):
    ways = np.zeros((round(HORIZON_S / dt), 3))
    for b in range(len(now)):
        t = now[b]
        log = log_states[b, t, EGO]
        away = math.hypot(states[b, t, EGO, 0] - log[0], states[b, t, EGO, 1] - log[1])
        as_logged = away < AS_LOGGED_M and abs(states[b, t, EGO, 3] - log[3]) < AS_LOGGED_MPS
        before = turned[b].copy()
        for o in range(agent_mask.shape[1]):
            threat = before[o] or (o == EGO and not as_logged)
            if not (threat and valid[b, t, o]):
                continue
            _expect(states[b], t, o, routes[b], counts[b], on_route[b], dt, ways)
            for a in range(agent_mask.shape[1]):
                replays = agent_mask[b, a] and valid[b, t, a] and not turned[b, a]
                if replays and not _far(states[b, t, a], sizes[b, a], states[b, t, o], sizes[b, o]):
                    turned[b, a] = _meets(log_states[b], log_valid[b], t, a, sizes[b], o, ways)


class HybridDriver(BaseDriver):
    """Vehicles replay their log until it would lead them into the ego, from then on they are `idm`.

    At every tick each looks 2 s ahead: if at a coming tick its logged box overlaps the ego's, which
    is expected further along its route at its present speed and offset, it turns, from the state it
    is in and for the rest of its episode. An ego within 0.5 m and 0.5 m/s of its own log is
    expected to go on as logged and turns nobody. Vehicles that have turned turn others in the same
    way, so that nobody drives through them.
    """

    name = "hybrid"

    def __init__(self) -> None:
        """A driver without agents; `reset` gives it some."""
        self._idm = IDMDriver()
        self._agent_mask = np.zeros((0, 0), dtype=bool)
        self._turned = np.zeros((0, 0), dtype=bool)

    def reset(
        self,
        world: World,
        reset_mask: Bool[np.ndarray, " b"],
        agent_mask: Bool[np.ndarray, "b a"] | None = None,
    ) -> None:
        """In the new episodes nobody has turned.

        Raises:
            AspEnvError: the world replays nobody.
        """
        check_replayed(world, self.name)
        self._agent_mask = vehicles(world) if agent_mask is None else agent_mask
        self._turned = resized(self._turned, self._agent_mask.shape)
        self._turned[reset_mask] = False
        self._idm.reset(world, reset_mask, self._agent_mask)

    def control(self, world: World) -> Control:
        """What the law says for those who have turned; the others replay."""
        episodes = world.episodes
        _turn(
            episodes.states, episodes.valid, episodes.log_states, episodes.log_valid,
            episodes.sizes, world.now, self._agent_mask, episodes.route, episodes.route_valid.sum(axis=1),
            episodes.on_route, world.dt_s, self._turned,
        )  # fmt: skip
        return self._idm.drive(world, self._turned)
