"""The future that a simulation has if the egos execute given actions."""

import numpy as np
from jaxtyping import Bool, Float

from asp_env.data.scene import Scene
from asp_env.data.snippets import Future
from asp_env.sim.simulation import Simulation
from asp_env.sim.traffic.log import LogDriver
from asp_env.sim.world import recorded_future


def simulated_future(
    simulation: Simulation,
    scene: Scene,
    ego_actions: Float[np.ndarray, "b steps 2"],
    running: Bool[np.ndarray, " b"],
) -> Future:
    """The states that a scene's targets will have if the egos execute these actions.

    The simulation is stepped and then restored bit for bit, its random generators included. It
    continues beyond the end of a scenario, without the agents that appear after that. Traffic that
    replays its log does not react, so that its future is the recorded one.

    Args:
        simulation: the simulation that the scene was taken from.
        scene: the present scene, with N targets.
        ego_actions: [acceleration m/s², steering rad] of the egos in the coming ticks.
        running: mask of the episodes that have not ended; the others are not stepped, and their
            targets have no future.

    Returns:
        States (N, steps, 4) from the next tick on, and the mask of the ticks at which the target is
        present.
    """
    steps = ego_actions.shape[1]
    if isinstance(simulation.driver, LogDriver):
        return recorded_future(simulation.world, scene, steps)
    before = simulation.snapshot()
    world, (b, a) = simulation.world, scene.targets.T
    world.set_lengths(world.episodes.elapsed + steps * running)
    states = np.zeros((len(b), steps, 4), dtype=np.float32)
    valid = np.zeros((len(b), steps), dtype=bool)
    for k in range(steps):
        simulation.step(ego_actions[:, k], running)
        now = world.now[b]
        states[:, k] = world.episodes.states[b, now, a]
        valid[:, k] = world.episodes.valid[b, now, a] & running[b]
    simulation.restore(before)
    return Future(states=np.where(valid[..., None], states, 0), valid=valid)
