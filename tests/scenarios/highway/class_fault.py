"""Prints hashes of episodes; run in a process of its own, since highway-env changes its classes."""

import hashlib
import json
import sys

import numpy as np
from highway_env.envs import IntersectionEnv, RoundaboutEnv
from highway_env.vehicle.behavior import IDMVehicle

from scenarios.highway.rounds import simulate_round, step_road
from scenarios.highway.sites import SITES, populated_road
from tests.scenarios.highway.environments import make

NAMES = ("DISTANCE_WANTED", "COMFORT_ACC_MAX", "COMFORT_ACC_MIN")


def parameters() -> list[float]:
    """Parameters of the class of all uncontrolled vehicles."""
    return [float(getattr(IDMVehicle, name)) for name in NAMES]


def reference() -> str:
    """A hash of the vehicles' positions in an episode of highway-env's roundabout."""
    env = RoundaboutEnv()
    env.reset(seed=8)
    seen = []
    for _ in range(5):
        env.step(1)
        seen += [each.position for each in env.road.vehicles]
    return hashlib.sha256(np.array(seen).tobytes()).hexdigest()


def own() -> str:
    """A hash of the vehicles' positions in an episode of this package's roundabout."""
    road = populated_road(SITES["roundabout"], np.random.default_rng(8))
    for _ in range(75):
        step_road(road)
    return hashlib.sha256(np.array([each.position for each in road.vehicles]).tobytes()).hexdigest()


def observed() -> list:
    """Everything that must not change."""
    return [parameters(), reference(), own()]


def main() -> None:
    """Prints hashes at first, after this package's intersection, and after highway-env's."""
    out = [observed()]
    simulate_round(SITES["intersection"], np.random.default_rng(0), frames=60)
    env = make(sys.argv[1])
    env.reset(seed=0)
    for _ in range(5):
        env.step(np.zeros(2))
    out.append(observed())
    IntersectionEnv()
    out.append(observed())
    sys.stdout.write(json.dumps(out))


if __name__ == "__main__":
    main()
