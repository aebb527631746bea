"""What a step in highway-env's traffic costs here: `python -m tests.benchmarks.highway_rate`.

Three contestants go on from the same vehicles with the same actions of the ego, in turns of a
second, at 5 Hz control and 15 Hz inside:

- theirs: `step` of highway-env's own environment with continuous actions and its Kinematics
  observation. Its ego foresees where it goes by copying the whole road, which ours need not.
- bare: nothing but `act` and `step` of highway-env's road, its ego one of the traffic.
- ours: `step` of the environment that `gymnasium.make` makes, observing vectors.

Before each turn their vehicles are laid anew, as ours are, and their own spawning is off: at 5 Hz
it would fill the road five times as fast. The reward of their roundabout fails with continuous
actions, so theirs gives none. Times are the process's own; resets and copies do not count.
"""

import argparse
import gc
from collections.abc import Callable, Iterator
from copy import copy
from dataclasses import dataclass, field
from time import process_time
from typing import Any

import gymnasium
import numpy as np
from highway_env.envs import IntersectionEnv, RoundaboutEnv
from highway_env.vehicle.behavior import IDMVehicle
from highway_env.vehicle.kinematics import Vehicle
from rich.console import Console
from rich.table import Table

import asp_env
from asp_env.dynamics import inverse, normalize_actions
from scenarios.highway import world as highway_world
from scenarios.highway.sites import SITES, STEP_S, Site

assert asp_env  # registers the environments

TURN = 5
"""Steps from one laying of the vehicles to the next."""
SUBSTEPS = 3
CONTESTANTS = ("theirs", "bare", "ours")


class IntersectionCar(IDMVehicle):
    """Their own vehicle; their intersection sets constants of the class that it is told."""


class RoundaboutCar(IDMVehicle):
    """Likewise, untouched by the other place's constants."""


@dataclass(slots=True)
class Times:
    """Seconds of one episode."""

    reset_s: dict[str, float] = field(default_factory=lambda: dict.fromkeys(CONTESTANTS, 0.0))
    step_s: dict[str, float] = field(default_factory=lambda: dict.fromkeys(CONTESTANTS, 0.0))
    """Of all steps together."""
    road_s: dict[str, float] = field(default_factory=lambda: dict.fromkeys(CONTESTANTS, 0.0))
    """Of those, in `act` and `step` of the road."""
    vehicles: dict[str, int] = field(default_factory=lambda: dict.fromkeys(CONTESTANTS, 0))
    """Summed over steps."""
    steps: int = 0


class Theirs:
    """highway-env's environment with plain vehicles, and its road alone."""

    def __init__(self, site: Site) -> None:
        """A road whose vehicles are laid before each turn."""
        self.car: type[IDMVehicle] = {
            "intersection": IntersectionCar,
            "roundabout": RoundaboutCar,
        }[site.name]
        self.env: Any = _environment(site, self.car)
        self.bare: Any = _environment(site, self.car).road

    def lay(self, road: Any, ego_track: int) -> None:
        """The vehicles of a road of ours on both roads of theirs."""
        self._lay(self.env.road, road, ego_track)
        self._lay(self.bare, road, None)

    def _lay(self, onto: Any, road: Any, ego_track: int | None) -> None:
        onto.vehicles = []
        if hasattr(onto, "steps"):
            onto.steps = road.steps
        for each in road.vehicles:
            ego = each.track == ego_track
            kind = Vehicle if ego else self.car
            copied: Any = kind(onto, each.position, each.heading, each.speed)
            for name in ("crashed", "impact", "action"):
                setattr(copied, name, copy(getattr(each, name)))
            if ego:
                self.env.vehicle = copied
            else:
                for name in ("target_lane_index", "target_speed", "timer", "DELTA"):
                    setattr(copied, name, getattr(each, name))
                copied.route = list(each.route)
                if each.steered:
                    copied.plan_route_to(each.route[-1][1])  # from where it is by now
                if getattr(each, "is_yielding", False):
                    copied.is_yielding, copied.color = True, None
                    copied.yield_timer = each.yield_timer
            onto.vehicles.append(copied)


def _environment(site: Site, car: type[IDMVehicle]) -> Any:
    base: Any = {"intersection": IntersectionEnv, "roundabout": RoundaboutEnv}[site.name]

    class Environment(base):
        """Tells what its road takes, and gives no reward, which fails at their roundabout."""

        road_s = 0.0

        def _simulate(self, action: Any = None) -> None:
            begin = process_time()
            super()._simulate(action)
            self.road_s += process_time() - begin

        def _reward(self, action: Any) -> float:
            del action
            return 0.0

        def _rewards(self, action: Any) -> dict[str, float]:
            del action
            return {}

    config = {
        "action": {"type": "ContinuousAction", "dynamical": False},
        "simulation_frequency": 15,
        "policy_frequency": 5,
        "duration": 1_000,
        "other_vehicles_type": f"{car.__module__}.{car.__qualname__}",
    }
    return Environment(config=config | ({"spawn_probability": 0.0} if site.spawn else {}))


class Ours:
    """This project's environment."""

    def __init__(self, site: Site) -> None:
        """As `gymnasium.make` makes it."""
        self.env: gymnasium.Env[Any, Any] = gymnasium.make(
            f"asp_env/Highway{site.name.capitalize()}-v0",
            observations=("vectors",),
            disable_env_checker=True,
        )
        self._inner: Any = self.env.unwrapped
        self.road_s = 0.0
        self._step_road = highway_world.step_road
        highway_world.step_road = self._timed

    def _timed(self, road: Any) -> None:
        begin = process_time()
        self._step_road(road)
        self.road_s += process_time() - begin

    @property
    def road(self) -> Any:
        """highway-env's road."""
        return self._inner._episodes.simulation.world._runs[0].road

    @property
    def ego_track(self) -> int:
        """Of the ego, its number in the recording."""
        return int(self._inner._episodes.simulation.world.episodes.tracks[0, 0])

    def action(self) -> np.ndarray:
        """What brings the ego to the speed and heading that it is recorded with next."""
        world = self._inner._episodes.simulation.world
        data, now = world.episodes, int(world.now[0])
        there, length = data.log_states[0, now + 1, 0], data.sizes[0, 0, 0]
        needed = normalize_actions(inverse(data.states[0, now, 0], there, length, world.dt_s))
        return np.clip(needed, -1.0, 1.0).astype(np.float32)

    def close(self) -> None:
        """Takes the clock away again."""
        highway_world.step_road = self._step_road
        self.env.close()


def drive(theirs: Theirs, ours: Ours, seed: int) -> Times:
    """One episode, turn by turn."""
    times = Times()
    times.reset_s["theirs"] = _seconds(lambda: theirs.env.reset(seed=seed))
    times.reset_s["ours"] = _seconds(lambda: ours.env.reset(seed=seed))
    theirs.env.road_s = ours.road_s = 0.0
    over = False
    while not over:
        theirs.lay(ours.road, ours.ego_track)
        over, actions = _our_turn(ours, times)
        _their_turn(theirs, times, actions)
        _bare_turn(theirs, times, len(actions))
        times.steps += len(actions)
    times.road_s = {
        "theirs": theirs.env.road_s,
        "bare": times.step_s["bare"],
        "ours": ours.road_s,
    }
    return times


def _our_turn(ours: Ours, times: Times) -> tuple[bool, list[np.ndarray]]:
    gc.collect()
    actions: list[np.ndarray] = []
    over = False
    while not over and len(actions) < TURN:
        actions.append(ours.action())
        begin = process_time()
        *_, terminated, truncated, _ = ours.env.step(actions[-1])
        times.step_s["ours"] += process_time() - begin
        times.vehicles["ours"] += len(ours.road.vehicles)
        over = terminated or truncated
    return over, actions


def _their_turn(theirs: Theirs, times: Times, actions: list[np.ndarray]) -> None:
    gc.collect()
    for action in actions:
        mirrored = action * [1.0, -1.0]  # their y axis points down
        times.step_s["theirs"] += _seconds(lambda action=mirrored: theirs.env.step(action))
        times.vehicles["theirs"] += len(theirs.env.road.vehicles)


def _bare_turn(theirs: Theirs, times: Times, steps: int) -> None:
    gc.collect()
    for _ in range(steps):
        for _ in range(SUBSTEPS):
            times.step_s["bare"] += _seconds(theirs.bare.act)
            times.step_s["bare"] += _seconds(lambda: theirs.bare.step(STEP_S))
        times.vehicles["bare"] += len(theirs.bare.vehicles)


def _seconds(work: Callable[[], object]) -> float:
    begin = process_time()
    work()
    return process_time() - begin


def tables(name: str, found: list[Times]) -> Iterator[Table]:
    """Medians over episodes, with the quartiles of what is compared within each."""
    steps = np.array([each.steps for each in found])
    ms = {who: 1e3 * np.array([each.step_s[who] for each in found]) / steps for who in CONTESTANTS}
    title = f"{name}, {len(found)} episodes, {steps.sum()} steps of {SUBSTEPS} sub-steps"
    table = Table(title=title)
    for heading in ("", "vehicles", "ms per step", "sub-steps/s", "outside act, step", "reset ms"):
        table.add_column(heading, justify="right" if heading else "left", no_wrap=True)
    for who in CONTESTANTS:
        road = np.array([each.road_s[who] for each in found])
        outside = 1.0 - road / np.array([each.step_s[who] for each in found])
        resets = 1e3 * np.array([each.reset_s[who] for each in found])
        table.add_row(
            who,
            f"{sum(each.vehicles[who] for each in found) / steps.sum():.1f}",
            f"{np.median(ms[who]):.2f}",
            f"{SUBSTEPS * 1e3 / np.median(ms[who]):,.0f}",
            f"{100.0 * np.median(outside):.0f} %",
            "" if who == "bare" else f"{np.median(resets):.1f}",
        )
    yield table
    ratios = Table(title=f"{name}, ours as a multiple, of 5, 25, 50, 75 and 95 % of episodes")
    for heading in ("of", "5 %", "25 %", "50 %", "75 %", "95 %"):
        ratios.add_column(heading, justify="left" if heading == "of" else "right")
    for who in ("theirs", "bare"):
        spread = np.quantile(ms["ours"] / ms[who], (0.05, 0.25, 0.5, 0.75, 0.95))
        ratios.add_row(who, *(f"{each:.2f}" for each in spread))
    yield ratios


def main() -> None:
    """Measures and prints."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0] if __doc__ else None)
    parser.add_argument("--episodes", type=int, default=60)
    count = parser.parse_args().episodes
    console = Console(width=max(Console().width, 110))
    for name, site in SITES.items():
        theirs, ours = Theirs(site), Ours(site)
        drive(theirs, ours, count)  # what is compiled or read once does not count
        gc.freeze()
        found = [drive(theirs, ours, seed) for seed in range(count)]
        ours.close()
        for table in tables(name, found):
            console.print(table)


if __name__ == "__main__":
    main()
