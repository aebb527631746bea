"""What each shortcut of `scenarios.highway` saves: `python -m tests.benchmarks.highway_parts`.

`scenarios/highway/vehicles.py` replaces parts of highway-env by faster ones with the same results.
Here each of them in turn is replaced by highway-env's own code, the same episodes are stepped, and
the time per step is compared with that of all shortcuts together. Episodes must agree bit for bit.
The variants take turns, episode by episode; times are the processor time of `World.step`.
"""

import argparse
import gc
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from time import process_time
from typing import Any

import numpy as np
from highway_env.road.regulation import RegulatedRoad
from highway_env.road.road import Road, RoadNetwork
from highway_env.vehicle.behavior import IDMVehicle
from rich.console import Console
from rich.table import Table

from asp_env.data.scenarios.scenario import find_scenarios
from asp_env.data.source import open_data
from scenarios.highway import sites, vehicles
from scenarios.highway.sites import SITES
from scenarios.highway.vehicles import Network, RegulatedTrafficRoad, TrafficRoad
from scenarios.highway.world import HighwayWorld

DT_S = 0.2
HISTORY = 15


@contextmanager
def replaced(owner: Any, name: str, value: Any) -> Iterator[None]:
    """Sets an attribute of a class or module for a while."""
    own = vars(owner)[name]
    setattr(owner, name, value)
    try:
        yield
    finally:
        setattr(owner, name, own)


def _predict_each_time(vehicle: Any, times: Any) -> Any:
    if vehicle.steered:
        return vehicle._along_curve(times)
    return IDMVehicle.predict_trajectory_constant_speed(vehicle, times)


def _plain_rules(road: Any) -> None:
    RegulatedRoad.enforce_road_rules(road)


def _plain_step(road: Any, dt: float) -> None:
    Road.step(road, dt)


def _plain_neighbours(road: Any, vehicle: Any, lane_index: Any = None) -> Any:
    return Road.neighbour_vehicles(road, vehicle, lane_index)


def _plain_closest(network: Any, position: Any, heading: float | None = None) -> Any:
    return RoadNetwork.get_closest_lane_index(network, position, heading)


_PLAIN_CONFLICT = staticmethod(RegulatedRoad.is_conflict_possible)

PARTS: dict[str, list[tuple[Any, str, Any]]] = {
    "neighbours by lane boxes": [(TrafficRoad, "neighbour_vehicles", _plain_neighbours)],
    "collisions by coordinates": [(TrafficRoad, "step", _plain_step)],
    "conflicts foreseen once": [
        (RegulatedTrafficRoad, "enforce_road_rules", _plain_rules),
        (
            RegulatedTrafficRoad,
            "is_conflict_possible",
            staticmethod(RegulatedRoad.is_conflict_possible),
        ),
    ],
    "closest lane by cells": [(Network, "get_closest_lane_index", _plain_closest)],
    "lane coordinates stored": [(vehicles, "_cached", lambda locate: locate)],
}


def step_all(world: HighwayWorld, scenario: Any, ego: bool) -> tuple[float, np.ndarray]:
    """Seconds of all steps of an episode, and its states; `ego`: the ego is controlled."""
    world.reset([scenario], [np.random.default_rng(0)])
    agents = world.episodes.valid.shape[2]
    actions, controlled = (
        np.zeros((1, agents, 2), dtype=np.float32),
        np.zeros((1, agents), dtype=bool),
    )
    controlled[:, 0] = ego
    gc.disable()
    begin = process_time()
    for _ in range(scenario.length):
        world.step(actions, controlled)
    spent = process_time() - begin
    gc.enable()
    return spent, world.episodes.states.copy()


def measure(site: str, episodes: int, ego: bool) -> dict[str, tuple[float, list[float]]]:
    """Per variant: milliseconds per step, and the ratio to all shortcuts in every episode."""
    recordings = open_data(f"highway:{site}")
    found = find_scenarios(recordings, source=f"highway:{site}", dt_s=DT_S, history=HISTORY)
    chosen = [found[int(i)] for i in np.linspace(0, len(found) - 1, episodes)]
    variants: dict[str, list[tuple[Any, str, Any]]] = {
        "all shortcuts": [],
        **{f"without {name}": changes for name, changes in PARTS.items()},
        "without any": [change for changes in PARTS.values() for change in changes],
    }
    times: dict[str, list[float]] = {name: [] for name in variants}
    for scenario in chosen:
        states = None
        for name, changes in variants.items():
            with ExitStack() as stack:
                for change in changes:
                    stack.enter_context(replaced(*change))
                sites.network.cache_clear()
                world = HighwayWorld(recordings, num_episodes=1, dt_s=DT_S, history=HISTORY)
                step_all(world, scenario, ego)  # fills caches that last, as in a long run
                spent, got = step_all(world, scenario, ego)
            assert states is None or np.array_equal(states, got), (name, scenario)
            states = got
            times[name].append(spent / scenario.length)
    sites.network.cache_clear()
    base = times["all shortcuts"]
    return {
        name: (1e3 * float(np.mean(each)), [a / b for a, b in zip(each, base, strict=True)])
        for name, each in times.items()
    }


def main() -> None:
    """Prints a table for each site."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--episodes", type=int, default=20)
    parser.add_argument("--ego", action="store_true", help="control the ego: coast straight ahead")
    options = parser.parse_args()
    show: Callable[[Any], None] = Console().print
    for site in SITES:
        table = Table(title=site)
        for heading in ("", "ms per step", "ratio, median", "quartiles"):
            table.add_column(heading, justify="left" if not heading else "right")
        for name, (milliseconds, ratios) in measure(site, options.episodes, options.ego).items():
            low, middle, high = np.percentile(ratios, [25, 50, 75])
            table.add_row(name, f"{milliseconds:.2f}", f"{middle:.2f}", f"{low:.2f} to {high:.2f}")
        show(table)


if __name__ == "__main__":
    main()
