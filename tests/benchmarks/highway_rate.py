"""Cost of a step in highway-env's traffic: `python -m tests.benchmarks.highway_rate`.

Three implementations continue from the same vehicles with the same actions of the ego, in turns of
one second, at 5 Hz control and 15 Hz simulation:

- highway-env: `step` of highway-env's environment with continuous actions and its Kinematics
  observation. Its ego predicts its own path by copying the road, which asp-env's does not need.
- road: `act` and `step` of highway-env's road without an environment; traffic moves the ego too.
- asp-env: `step` of the environment that `gymnasium.make` creates, with vectors as observation.

Before each turn the vehicles of asp-env are copied to the other two. highway-env's own spawning is
off: at 5 Hz it would fill the road five times as fast. The reward of its roundabout fails with
continuous actions, so its environments return no reward. Times are processor times of this process;
resets and copies are not included.
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
"""Steps between two copies of the vehicles."""
SUBSTEPS = 3
IMPLEMENTATIONS = ("highway-env", "road", "asp-env")


class IntersectionCar(IDMVehicle):
    """The vehicle at the intersection, whose environment changes constants of the class."""


class RoundaboutCar(IDMVehicle):
    """The vehicle at the roundabout, with the original constants."""


@dataclass(slots=True)
class Times:
    """Times of one episode, s, and counts, by implementation."""

    reset_s: dict[str, float] = field(default_factory=lambda: dict.fromkeys(IMPLEMENTATIONS, 0.0))
    step_s: dict[str, float] = field(default_factory=lambda: dict.fromkeys(IMPLEMENTATIONS, 0.0))
    """Total of all steps."""
    road_s: dict[str, float] = field(default_factory=lambda: dict.fromkeys(IMPLEMENTATIONS, 0.0))
    """The part of `step_s` in `act` and `step` of the road."""
    vehicles: dict[str, int] = field(default_factory=lambda: dict.fromkeys(IMPLEMENTATIONS, 0))
    """Sum over steps."""
    steps: int = 0


class HighwayEnv:
    """highway-env's environment, and a road of highway-env without an environment."""

    def __init__(self, site: Site) -> None:
        self.car: type[IDMVehicle] = {
            "intersection": IntersectionCar,
            "roundabout": RoundaboutCar,
        }[site.name]
        self.env: Any = _environment(site, self.car)
        self.road: Any = _environment(site, self.car).road

    def copy_vehicles(self, road: Any, ego_track: int) -> None:
        """Replaces the vehicles of both roads by those of a road of asp-env."""
        self._copy_vehicles(self.env.road, road, ego_track)
        self._copy_vehicles(self.road, road, None)

    def _copy_vehicles(self, target: Any, road: Any, ego_track: int | None) -> None:
        target.vehicles = []
        if hasattr(target, "steps"):
            target.steps = road.steps
        for each in road.vehicles:
            ego = each.track == ego_track
            kind = Vehicle if ego else self.car
            copied: Any = kind(target, each.position, each.heading, each.speed)
            for name in ("crashed", "impact", "action"):
                setattr(copied, name, copy(getattr(each, name)))
            if ego:
                self.env.vehicle = copied
            else:
                for name in ("target_lane_index", "target_speed", "timer", "DELTA"):
                    setattr(copied, name, getattr(each, name))
                copied.route = list(each.route)
                if each.steered:
                    copied.plan_route_to(each.route[-1][1])  # from its present lane
                if getattr(each, "is_yielding", False):
                    copied.is_yielding, copied.color = True, None
                    copied.yield_timer = each.yield_timer
            target.vehicles.append(copied)


def _environment(site: Site, car: type[IDMVehicle]) -> Any:
    base: Any = {"intersection": IntersectionEnv, "roundabout": RoundaboutEnv}[site.name]

    class Environment(base):
        """Measures the time of its road; returns no reward, which fails at the roundabout."""

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


class AspEnv:
    """asp-env's environment as `gymnasium.make` creates it."""

    def __init__(self, site: Site) -> None:
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
        """The road of the episode."""
        return self._inner._episodes.simulation.world._runs[0].road

    @property
    def ego_track(self) -> int:
        """Track number of the ego."""
        return int(self._inner._episodes.simulation.world.episodes.tracks[0, 0])

    def action(self) -> np.ndarray:
        """The action that leads to the recorded speed and heading at the next tick."""
        world = self._inner._episodes.simulation.world
        data, now = world.episodes, int(world.now[0])
        target, length = data.log_states[0, now + 1, 0], data.sizes[0, 0, 0]
        action = normalize_actions(inverse(data.states[0, now, 0], target, length, world.dt_s))
        return np.clip(action, -1.0, 1.0).astype(np.float32)

    def close(self) -> None:
        """Removes the time measurement and closes the environment."""
        highway_world.step_road = self._step_road
        self.env.close()


def drive(peer: HighwayEnv, env: AspEnv, seed: int) -> Times:
    """Measures one episode."""
    times = Times()
    times.reset_s["highway-env"] = _seconds(lambda: peer.env.reset(seed=seed))
    times.reset_s["asp-env"] = _seconds(lambda: env.env.reset(seed=seed))
    peer.env.road_s = env.road_s = 0.0
    over = False
    while not over:
        peer.copy_vehicles(env.road, env.ego_track)
        over, actions = _asp_env_turn(env, times)
        _highway_env_turn(peer, times, actions)
        _road_turn(peer, times, len(actions))
        times.steps += len(actions)
    times.road_s = {
        "highway-env": peer.env.road_s,
        "road": times.step_s["road"],
        "asp-env": env.road_s,
    }
    return times


def _asp_env_turn(env: AspEnv, times: Times) -> tuple[bool, list[np.ndarray]]:
    gc.collect()
    actions: list[np.ndarray] = []
    over = False
    while not over and len(actions) < TURN:
        actions.append(env.action())
        begin = process_time()
        *_, terminated, truncated, _ = env.env.step(actions[-1])
        times.step_s["asp-env"] += process_time() - begin
        times.vehicles["asp-env"] += len(env.road.vehicles)
        over = terminated or truncated
    return over, actions


def _highway_env_turn(peer: HighwayEnv, times: Times, actions: list[np.ndarray]) -> None:
    gc.collect()
    for action in actions:
        mirrored = action * [1.0, -1.0]  # the y axis of highway-env points down
        times.step_s["highway-env"] += _seconds(lambda action=mirrored: peer.env.step(action))
        times.vehicles["highway-env"] += len(peer.env.road.vehicles)


def _road_turn(peer: HighwayEnv, times: Times, steps: int) -> None:
    gc.collect()
    for _ in range(steps):
        for _ in range(SUBSTEPS):
            times.step_s["road"] += _seconds(peer.road.act)
            times.step_s["road"] += _seconds(lambda: peer.road.step(STEP_S))
        times.vehicles["road"] += len(peer.road.vehicles)


def _seconds(work: Callable[[], object]) -> float:
    begin = process_time()
    work()
    return process_time() - begin


def tables(site: str, episodes: list[Times]) -> Iterator[Table]:
    """Medians over episodes, and quantiles of the ratios within each episode."""
    steps = np.array([each.steps for each in episodes])
    ms = {
        name: 1e3 * np.array([each.step_s[name] for each in episodes]) / steps
        for name in IMPLEMENTATIONS
    }
    title = f"{site}, {len(episodes)} episodes, {steps.sum()} steps of {SUBSTEPS} sub-steps"
    table = Table(title=title)
    for heading in ("", "vehicles", "ms per step", "sub-steps/s", "outside act, step", "reset ms"):
        table.add_column(heading, justify="right" if heading else "left", no_wrap=True)
    for name in IMPLEMENTATIONS:
        road = np.array([each.road_s[name] for each in episodes])
        outside = 1.0 - road / np.array([each.step_s[name] for each in episodes])
        resets = 1e3 * np.array([each.reset_s[name] for each in episodes])
        table.add_row(
            name,
            f"{sum(each.vehicles[name] for each in episodes) / steps.sum():.1f}",
            f"{np.median(ms[name]):.2f}",
            f"{SUBSTEPS * 1e3 / np.median(ms[name]):,.0f}",
            f"{100.0 * np.median(outside):.0f} %",
            "" if name == "road" else f"{np.median(resets):.1f}",
        )
    yield table
    ratios = Table(title=f"{site}, time of asp-env as a multiple, quantiles over episodes")
    for heading in ("of", "5 %", "25 %", "50 %", "75 %", "95 %"):
        ratios.add_column(heading, justify="left" if heading == "of" else "right")
    for name in ("highway-env", "road"):
        spread = np.quantile(ms["asp-env"] / ms[name], (0.05, 0.25, 0.5, 0.75, 0.95))
        ratios.add_row(name, *(f"{each:.2f}" for each in spread))
    yield ratios


def main() -> None:
    """Measures all sites and prints tables."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0] if __doc__ else None)
    parser.add_argument("--episodes", type=int, default=60)
    count = parser.parse_args().episodes
    console = Console(width=max(Console().width, 110))
    for name, site in SITES.items():
        peer, env = HighwayEnv(site), AspEnv(site)
        drive(peer, env, count)  # an episode that is not measured compiles and caches
        gc.freeze()
        episodes = [drive(peer, env, seed) for seed in range(count)]
        env.close()
        for table in tables(name, episodes):
            console.print(table)


if __name__ == "__main__":
    main()
