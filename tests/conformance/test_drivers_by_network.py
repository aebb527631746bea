"""Agents that follow a network: what can be promised although its last bits depend on the batch."""

from pathlib import Path

import numpy as np

from asp_env.sim.simulation import Simulation
from asp_env.sim.traffic.assignment import make_traffic
from tests.builders import make_recording
from tests.conformance.predictor_cases import Case
from tests.sim.worlds import DT_S, HISTORY, replay, scenario

SCENARIOS = [scenario(1, start=20, length=20), scenario(3, start=30, length=20)]


def _run(traffic: str, scenarios: list) -> np.ndarray:
    simulation = Simulation(
        [make_recording()],
        make_traffic(traffic),
        num_episodes=len(scenarios),
        dt_s=DT_S,
        history=HISTORY,
    )
    simulation.reset(scenarios, [np.random.default_rng(3) for _ in scenarios])
    replay(simulation, 19)
    snapshot = simulation.snapshot()
    replay(simulation, 1)
    after = simulation.world.episodes.states.copy()
    simulation.restore(snapshot)
    replay(simulation, 1)
    assert simulation.world.episodes.states.tobytes() == after.tobytes()
    return after


def test_a_network_drives(folder: Path):
    """Random weights at the end of a name: finite, repeatable, alike alone and beside others."""
    name = Case("ffw-asp", "vectors").save(folder)
    traffic = f"default=log,car=predictor:every=3:mode=sampled:{name}"
    together = _run(traffic, SCENARIOS)
    assert np.isfinite(together).all()
    assert together.tobytes() == _run(traffic, SCENARIOS).tobytes()
    for row, each in enumerate(SCENARIOS):
        alone = _run(traffic, [each])
        away = together[row, :, : alone.shape[2], :2] - alone[0, :, :, :2]
        assert np.abs(away).max() < 0.01
