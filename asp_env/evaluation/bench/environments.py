"""Rates of the Gymnasium environments, beside highway-env if it is installed."""

import importlib
import importlib.util
from collections.abc import Sequence
from time import process_time
from typing import Any

import gymnasium
import numpy as np

from asp_env.evaluation.bench.timing import REFERENCE, Rate, median_s

SINGLE_STEPS = 300
VECTOR_STEPS = 40
RASTER_STEPS = 10
FORECAST_STEPS = 150
PEER_STEPS = 40
PEER = "highway_env"
PEER_ID = "intersection-v2"


def environment_rates(data: str, *, num_envs: int, write_bytes_per_s: float) -> list[Rate]:
    """Steps per second of single and batched environments, resets included.

    Args:
        data: DATA.
        num_envs: Number of environments in a batch.
        write_bytes_per_s: Bandwidth of filling rasters, the upper bound for raster observations.
    """
    bytes_each = 12 * 360 * 240
    bound = {"reference_per_s": write_bytes_per_s / bytes_each, "reference": "write bandwidth"}
    peer, vehicles = _peer() if importlib.util.find_spec(PEER) else (None, 0)
    highway = {} if peer is None else {"reference_per_s": peer, "reference": "highway-env"}
    single = _single(data, ("vectors",), "log")
    reacting = _single(data, ("vectors",), "idm")
    vectors = _batched(data, ("vectors",), num_envs, VECTOR_STEPS)
    state = _batched(data, ("state",), num_envs, VECTOR_STEPS)
    raster = _batched(data, ("raster",), num_envs, RASTER_STEPS)
    rates = [
        Rate(name="gym.make, vectors, log", per_s=single, unit="steps/s"),
        Rate(name="gym.make, vectors, idm", per_s=reacting, unit="steps/s", **highway),
        Rate(name=f"gym.make_vec of {num_envs}, state", per_s=state, unit="steps/s"),
        Rate(name=f"gym.make_vec of {num_envs}, vectors 16 x 64", per_s=vectors, unit="steps/s"),
        Rate(
            name=f"gym.make_vec of {num_envs}, raster 12x360x240",
            per_s=raster,
            unit="steps/s",
            bytes_each=bytes_each,
            **bound,
        ),
        *_with_forecasts(data, num_envs),
    ]
    if peer is not None:
        name = f"highway-env {PEER_ID}, {vehicles:.0f} vehicles, 5 Hz (15 Hz inside)"
        rates.append(Rate(name=name, per_s=peer, unit="steps/s"))
    return rates


def _with_forecasts(data: str, num_envs: int) -> tuple[Rate, Rate]:
    """Rates without and with forecasts of constant velocity, stepped in turn.

    Both environments take every step one after the other, so that changes of the processor's speed
    hardly affect the ratio.
    """
    pair = [
        gymnasium.make_vec(
            "asp_env/Replay-v0",
            num_envs=num_envs,
            vectorization_mode="vector_entry_point",
            data=data,
            observations=("vectors", "state", "route"),
            predictor=predictor,
        )
        for predictor in (None, REFERENCE)
    ]
    actions = np.zeros((num_envs, 2), dtype=np.float32)
    durations_s = np.zeros((2, FORECAST_STEPS))
    for envs in pair:
        envs.reset(seed=0)
        envs.step(actions)
    for step in range(FORECAST_STEPS):
        for number, envs in enumerate(pair):
            start = process_time()
            envs.step(actions)
            durations_s[number, step] = process_time() - start
    for envs in pair:
        envs.close()
    without, with_forecasts = num_envs / durations_s.mean(axis=1)
    name = f"gym.make_vec of {num_envs}, vectors, state, route"
    return (
        Rate(name=name, per_s=float(without), unit="steps/s"),
        Rate(
            name=f"… and forecasts of {REFERENCE}",
            per_s=float(with_forecasts),
            unit="steps/s",
            reference_per_s=float(without),
            reference="without forecasts",
        ),
    )


def _single(data: str, observations: Sequence[str], traffic: str) -> float:
    env: gymnasium.Env[Any, Any] = gymnasium.make(
        "asp_env/Replay-v0",
        disable_env_checker=True,
        data=data,
        observations=observations,
        traffic=traffic,
    )
    env.reset(seed=0)
    action = np.zeros(2, dtype=np.float32)

    def drive() -> None:
        for _ in range(SINGLE_STEPS):
            *_, terminated, truncated, _ = env.step(action)
            if terminated or truncated:
                env.reset()

    rate = SINGLE_STEPS / median_s(drive)
    env.close()
    return rate


def _batched(data: str, observations: Sequence[str], num_envs: int, steps: int) -> float:
    envs = gymnasium.make_vec(
        "asp_env/Replay-v0",
        num_envs=num_envs,
        vectorization_mode="vector_entry_point",
        data=data,
        observations=observations,
    )
    envs.reset(seed=0)
    actions = np.zeros((num_envs, 2), dtype=np.float32)

    def drive() -> None:
        for _ in range(steps):
            envs.step(actions)

    rate = steps * num_envs / median_s(drive)
    envs.close()
    return rate


def _peer() -> tuple[float, float]:
    """Steps per second of highway-env's intersection, and its mean number of vehicles.

    It runs at the same control rate with a kinematic bicycle and observes 16 vehicles.
    """
    importlib.import_module(PEER)  # registers its environments

    config = {
        "action": {"type": "ContinuousAction", "dynamical": False},
        "observation": {"type": "Kinematics", "vehicles_count": 16},
        "simulation_frequency": 15,
        "policy_frequency": 5,
        "initial_vehicle_count": 20,
        "duration": 1000,
    }
    env: gymnasium.Env[Any, Any] = gymnasium.make(PEER_ID, disable_env_checker=True, config=config)
    inner: Any = env.unwrapped
    env.reset(seed=0)
    vehicles: list[int] = []
    action = np.zeros(2, dtype=np.float32)

    def drive() -> None:
        for _ in range(PEER_STEPS):
            *_, terminated, truncated, _ = env.step(action)
            vehicles.append(len(inner.road.vehicles))
            if terminated or truncated:
                env.reset()

    rate = PEER_STEPS / median_s(drive)
    env.close()
    return rate, float(np.mean(vehicles))
