"""Scenes with an ego on the eastbound lane, and forecasts of the other agents in them."""

import dataclasses

import numpy as np
from jaxtyping import Float

from asp_env.data.predictor import Forecast, constant_velocity, make_forecast
from asp_env.data.road_map import Ragged, RoadMap
from asp_env.data.scene import Scene
from asp_env.planning.planner import Planner
from asp_env.sim.simulation import Simulation
from tests.builders import Drive, make_map, make_recording
from tests.sim.worlds import car, scenario, simulate

STEPS = 15


def approach(
    *others: Drive, speed_mps: float = 10.0, y_m: float = -1.75, road_map: RoadMap | None = None
) -> Simulation:
    """An episode whose ego drives east at constant speed from x = -90, and starts after 3 s."""
    drives = (car(-90.0, speed_mps, y_m=y_m), *others)
    recording = make_recording(drives=drives, duration_s=20.0, road_map=road_map)
    return simulate(recording, scenario(1, length=80))


def wide_map() -> RoadMap:
    """The crossing with a drivable area of 350 m by 300 m."""
    square = np.array([(-150.0, -150.0), (200.0, -150.0), (200.0, 150.0), (-150.0, 150.0)])
    return dataclasses.replace(make_map(), name="wide", drivable=Ragged.pack([square]))


def straight_ahead(scene: Scene, *, modes: int = 1) -> Forecast:
    """All targets continue straight at their present speed, in equally probable modes."""
    states = constant_velocity(scene, steps=STEPS)[:, None].repeat(modes, axis=1)
    return make_forecast(
        scene,
        states=states,
        actions=None,
        log_probs=np.full(states.shape[:2], -np.log(modes)),
        valid=np.ones(len(states), dtype=bool),
    )


def two_modes(scene: Scene, other: Float[np.ndarray, "steps 4"], probability: float) -> Forecast:
    """The first target continues straight, or moves as `other` with the given probability."""
    forecast = straight_ahead(scene, modes=2)
    forecast.states[0, 1] = other
    forecast.log_probs[0] = np.log([1 - probability, probability])
    return forecast


def close_loop(planner: Planner, simulation: Simulation, steps: int) -> Float[np.ndarray, "n 4"]:
    """The ego's states under a planner, with forecasts that continue straight."""
    world = simulation.world
    states = [world.ego_states()[0]]
    for _ in range(steps):
        scene = world.scene()
        plan = planner.plan(scene, straight_ahead(scene))
        simulation.step(plan.actions[:, 0], np.ones(1, dtype=bool))
        states.append(world.ego_states()[0])
    return np.stack(states)
