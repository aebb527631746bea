"""What the egos of a world see now: its last ticks, without what an observation does not need."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from asp_env.data.road_map import RoadMap
from asp_env.sim.kernels import last_ticks
from asp_env.sim.scenario_world import ScenarioWorld
from asp_env.sim.world import EGO


@dataclass(frozen=True, slots=True, kw_only=True)
class Sight:
    """B situations, each seen by its targets: a `Scene` without actions, whose fields views read.

    Of agents that were not there at any tick, sizes, classes and ids mean nothing.
    """

    states: Float[np.ndarray, "b a ticks 4"]
    """Zeros where not valid."""
    valid: Bool[np.ndarray, "b a ticks"]
    sizes: Float[np.ndarray, "b a 2"]
    classes: Int[np.ndarray, "b a"]
    ids: Int[np.ndarray, "b a"]
    targets: Int[np.ndarray, "t 2"]
    """(situation, slot) of those who see."""
    routes: Float[np.ndarray, "t p 2"]
    """The way of each target, points 1 m apart."""
    route_valid: Bool[np.ndarray, "t p"]
    maps: tuple[RoadMap, ...]
    map_index: Int[np.ndarray, " b"]
    dt_s: float

    @property
    def history(self) -> int:
        """Past ticks."""
        return self.states.shape[2] - 1


def ego_sight(world: ScenarioWorld, rows: Int[np.ndarray, " n"] | None = None) -> Sight:
    """What the egos of some episodes see, by default of all; situation i is episode `rows[i]`."""
    data = world.episodes
    maps, map_index = world.maps()
    everyone = rows is None
    rows = np.arange(len(world)) if rows is None else rows
    targets = np.full((len(rows), 2), EGO)
    targets[:, 0] = np.arange(len(rows))
    states, valid = last_ticks(data, world.now, rows, world.history)
    sizes, classes, ids, routes, route_valid = (
        column if everyone else column[rows]
        for column in (data.sizes, data.classes, data.ids, data.route, data.route_valid)
    )
    return Sight(
        states=states,
        valid=valid,
        sizes=sizes,
        classes=classes,
        ids=ids,
        targets=targets,
        routes=routes,
        route_valid=route_valid,
        maps=maps,
        map_index=map_index if everyone else map_index[rows],
        dt_s=world.dt_s,
    )
