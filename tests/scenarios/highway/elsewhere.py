"""Continues from a snapshot in another process."""

import hashlib
import pickle
import sys
from pathlib import Path
from typing import Any

import numpy as np

from asp_env.data.source import Recordings, open_data
from asp_env.sim.simulation import Simulation
from asp_env.sim.traffic.assignment import make_traffic
from asp_env.sim.world import world_class
from tests.sim.worlds import DT_S, HISTORY


def open_world(recordings: Recordings, episodes: int) -> Simulation:
    """A world of highway-env's traffic before its first reset."""
    return Simulation(
        recordings,
        make_traffic("own"),
        num_episodes=episodes,
        dt_s=DT_S,
        history=HISTORY,
        world_class=world_class("highway:"),
    )


def drive(simulation: Simulation, tick: int) -> None:
    """Steps one tick; the egos are controlled in two ticks of three."""
    count = len(simulation.world)
    actions = np.random.default_rng(tick).uniform((-2.0, -0.1), (2.0, 0.1), (count, 2))
    simulation.step(actions.astype(np.float32), np.full(count, tick % 3 > 0))


def go_on(simulation: Simulation, snapshot: Any, first: int, last: int) -> str:
    """Continues from a snapshot up to a tick and returns a hash of the states at all ticks."""
    simulation.world.restore(snapshot)
    for tick in range(first, last):
        drive(simulation, tick)
    data = simulation.world.episodes
    return hashlib.sha256(data.states.tobytes() + data.valid.tobytes()).hexdigest()


def main(path: Path) -> None:
    """Prints the hashes of episodes that continue from the snapshots of a file."""
    for data, snapshots, last in pickle.loads(path.read_bytes()):
        simulation = open_world(open_data(data), len(snapshots[0][1][1]))
        for tick, snapshot in snapshots:
            sys.stdout.write(go_on(simulation, snapshot, tick, last) + "\n")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
