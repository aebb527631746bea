"""Rounds: highway-env's episodes one after the other, as they would go without an ego."""

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float, Int

from scenarios.highway.axes import mirror_states
from scenarios.highway.hidden import Rows, read_vehicles
from scenarios.highway.sites import (
    STEP_S,
    STEPS_PER_S,
    Site,
    bring_another,
    clear_leavers,
    populated_road,
)
from scenarios.highway.vehicles import Road, TrafficVehicle

ROUND_S = 20
"""highway-env's own episodes last 11 s and 13 s; by then its roundabout is nearly empty."""

KEPT_EVERY = 3
"""Frames from one kept hidden state to the next: 0.2 s."""


@dataclass(slots=True, kw_only=True)
class Seen:
    """One vehicle while it is on the road."""

    first_frame: int
    states: list[Float[np.ndarray, " 4"]] = field(default_factory=list)
    """[x m, y m, heading rad, speed m/s] at each frame, in our axes."""
    slips: list[float] = field(default_factory=list)
    """Slip angle of the step before each frame, rad, left positive."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Round:
    """What happened in one round; numbers of vehicles are those of `seen`."""

    seen: list[Seen]
    hidden: list[Rows]
    """Every `KEPT_EVERY` frames, from the first on."""
    steps: Int[np.ndarray, " kept"]
    """What the road had counted by then."""


def step_road(road: Road) -> None:
    """One of highway-env's steps of 1/15 s."""
    road.act()
    road.step(STEP_S)


def simulate_round(site: Site, rng: np.random.Generator, *, frames: int) -> Round:
    """One of highway-env's episodes, in which the ego is one of the traffic."""
    road = populated_road(site, rng)
    seen: list[Seen] = []
    hidden: list[Rows] = []
    steps: list[int] = []
    for frame in range(frames):
        if frame:
            step_road(road)
            if frame % STEPS_PER_S == 0:
                clear_leavers(site, road)
                bring_another(site, road, rng)
        _look(road.vehicles, seen, frame)
        if frame % KEPT_EVERY == 0:
            hidden.append(read_vehicles(road))
            steps.append(road.steps)
    return Round(seen=seen, hidden=hidden, steps=np.array(steps, dtype=np.int64))


def _look(vehicles: list[TrafficVehicle], seen: list[Seen], frame: int) -> None:
    for vehicle in vehicles:
        if vehicle.track < 0:
            vehicle.track = len(seen)
            seen.append(Seen(first_frame=frame))
        theirs = np.array([*vehicle.position, vehicle.heading, vehicle.speed])
        seen[vehicle.track].states.append(mirror_states(theirs))
        slip = np.arctan(0.5 * np.tan(vehicle.action["steering"]))
        seen[vehicle.track].slips.append(-float(slip))
