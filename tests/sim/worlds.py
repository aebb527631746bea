"""Helpers for recordings of a few vehicles, their scenarios, and simulations of them."""

from collections.abc import Sequence

import numpy as np

from asp_env.data.classes import AgentClass
from asp_env.data.recording import Recording
from asp_env.data.scenarios.scenario import Scenario
from asp_env.sim.simulation import Simulation
from asp_env.sim.traffic.assignment import TrafficSpec, make_traffic
from asp_env.sim.world import ReplayWorld, World
from tests.builders import Drive, make_recording

DT_S = 0.2
HISTORY = 15

TRAFFICS = (
    *("log", "log-actions", "idm", "hybrid", "policy"),
    *("predictor:constant-turn-rate", "predictor:every=3:mode=sampled:oracle"),
    "default=idm,truck=log-actions,4=policy,6=predictor:constant-velocity",
)
"""Every driver of a replay world without a network, and a table of several."""

EGO = Drive(kind=AgentClass.CAR, start=(1.75, -95.0, np.pi / 2, 5.0))
"""Drives north, away from the road along x."""


def car(
    x_m: float,
    speed_mps: float,
    *phases: tuple[float, float, float],
    y_m: float = -1.75,
    kind: AgentClass = AgentClass.CAR,
    appears_s: float = 0.0,
) -> Drive:
    """A vehicle on the eastbound lane; a standing one that appears after 0 s is not parked."""
    start = (x_m, y_m, 0.0, speed_mps)
    return Drive(kind=kind, start=start, phases=phases, appears_s=appears_s)


def scenario(
    ego_id: int = 1, *, start: int = HISTORY, length: int = 30, recording: int = 0
) -> Scenario:
    """A scenario of a recording in memory."""
    return Scenario(
        source="made-up",
        recording=recording,
        recording_name=f"{recording:02d}",
        start_tick=start,
        length=length,
        ego_id=ego_id,
    )


def simulate(
    recordings: Sequence[Recording] | Recording,
    scenarios: Sequence[Scenario] | Scenario,
    traffic: TrafficSpec = "log",
    world_class: type[World] = ReplayWorld,
    history: int = HISTORY,
) -> Simulation:
    """Episodes that have just started."""
    recordings = [recordings] if isinstance(recordings, Recording) else recordings
    scenarios = [scenarios] if isinstance(scenarios, Scenario) else scenarios
    simulation = Simulation(
        recordings,
        make_traffic(traffic),
        num_episodes=len(scenarios),
        dt_s=DT_S,
        history=history,
        world_class=world_class,
    )
    simulation.reset(scenarios, [np.random.default_rng(each.seed) for each in scenarios])
    return simulation


def on_road(*drives: Drive, duration_s: float = 20.0) -> Recording:
    """A recording of the ego on the crossing road with id 1, and of vehicles with ids from 2."""
    return make_recording(drives=(EGO, *drives), duration_s=duration_s)


def replay(simulation: Simulation, steps: int) -> None:
    """Steps in which the egos replay their tracks."""
    count = len(simulation.world)
    for _ in range(steps):
        simulation.step(np.zeros((count, 2), dtype=np.float32), np.zeros(count, dtype=bool))


def drive(simulation: Simulation, actions: Sequence[tuple[float, float]]) -> None:
    """Steps in which every ego executes the same actions."""
    count = len(simulation.world)
    for action in actions:
        held = np.tile(np.array(action, dtype=np.float32), (count, 1))
        simulation.step(held, np.ones(count, dtype=bool))


def now(simulation: Simulation, track_id: int, episode: int = 0) -> np.ndarray | None:
    """The present state of an agent, None if it is absent."""
    world = simulation.world
    tick = world.now[episode]
    slot = int(np.flatnonzero(world.episodes.ids[episode] == track_id)[0])
    if not world.episodes.valid[episode, tick, slot]:
        return None
    return world.episodes.states[episode, tick, slot].copy()
