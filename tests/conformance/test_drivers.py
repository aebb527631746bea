"""Laws of every driver: those of the registry, tables of several, and one with a network."""

import copy
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from asp_env import registry
from asp_env.data.scenarios.scenario import Scenario, find_scenarios
from asp_env.data.source import open_data
from asp_env.errors import AspEnvError
from asp_env.sim.simulation import Simulation
from asp_env.sim.traffic import Driver, DriverPlug
from asp_env.sim.traffic.assignment import make_traffic
from asp_env.sim.traffic.driver import controllable_agents
from asp_env.sim.world import ReplayWorld, World, world_class
from tests.builders import make_recording
from tests.conformance.predictor_cases import Case
from tests.highway_folders import highway_recordings
from tests.sim.worlds import DT_S, HISTORY, replay, scenario, simulate

ARGUMENTS = {
    "predictor": ("constant-turn-rate", "every=3:mode=sampled:constant-velocity", "oracle")
}
"""Arguments of the drivers that need one."""

NAMES = tuple(
    f"{name}:{argument}" if argument else name
    for name in registry.names("drivers")
    for argument in ARGUMENTS.get(name, ("",))
)
REPLAY_TABLE = "default=idm,car=hybrid,truck=log-actions,van=predictor:constant-velocity,3=policy"
OWN_TABLE = "default=own,3=policy,8=idm,2=log-actions,4=predictor:constant-velocity"


@dataclass(frozen=True, slots=True, kw_only=True)
class DriverCase:
    """Four episodes in one world."""

    recordings: Sequence[Any]
    scenarios: list[Scenario]
    world_class: type[World] = ReplayWorld
    steps: int = 30


def _synthetic() -> DriverCase:
    return DriverCase(
        recordings=[make_recording(), make_recording(name="01", seed=1, duration_s=16.0)],
        scenarios=[
            scenario(1, start=15, length=24),
            scenario(3, start=20, length=40, recording=1),
            scenario(7, start=36, length=20),
            scenario(2, start=15, length=40),
        ],
    )


def _sample() -> DriverCase:
    recordings = list(open_data("sample:intersection"))
    found = find_scenarios(recordings, source="sample", dt_s=DT_S, history=HISTORY)
    return DriverCase(recordings=recordings, scenarios=[found[i] for i in (0, 9, 21, 33)])


def _highway() -> DriverCase:
    return DriverCase(
        recordings=highway_recordings("roundabout"),
        scenarios=[
            scenario(7, start=115, length=10),
            scenario(4, start=28, length=20, recording=1),
            scenario(2, start=20, length=12),
            scenario(9, start=130, length=40, recording=1),
        ],
        world_class=world_class("highway:"),
        steps=14,
    )


DRIVER_CASES = {"sample": _sample, "highway": _highway, "synthetic": _synthetic}
"""From larger to smaller scenes."""

REFUSED = {"sample": {"own"}, "synthetic": {"own"}, "highway": {"log", "hybrid"}}
"""Drivers that do not fit the world of each case."""


@cache
def _case(name: str) -> DriverCase:
    return DRIVER_CASES[name]()


def _traffics(case: str) -> list[str]:
    """The drivers that fit the world of a case, and a table of several."""
    table = OWN_TABLE if case == "highway" else REPLAY_TABLE
    return [*(name for name in NAMES if name not in REFUSED[case]), table]


every = pytest.mark.parametrize(
    ("traffic", "cases"),
    [
        pytest.param(
            traffic, [case for case in DRIVER_CASES if traffic in _traffics(case)], id=traffic
        )
        for traffic in (*NAMES, REPLAY_TABLE, OWN_TABLE)
    ],
)
every_in_every_case = pytest.mark.parametrize(
    ("case", "traffic"),
    [
        pytest.param(case, traffic, id=f"{case}-{traffic}")
        for case in DRIVER_CASES
        for traffic in _traffics(case)
    ],
)


def _begin(case: DriverCase, traffic: str | Driver, *numbers: int) -> Simulation:
    """Some of its episodes, by default all, that have just started."""
    scenarios = [case.scenarios[i] for i in numbers or range(4)]
    simulation = simulate(case.recordings, scenarios, traffic, case.world_class)
    simulation.reset(scenarios, [np.random.default_rng(each.ego_id) for each in scenarios])
    return simulation


def _action(episode: int, tick: int) -> np.ndarray:
    """A different action for each ego and tick."""
    rng = np.random.default_rng([episode, tick])
    low, high = np.array([-3.0, -0.1]), np.array([2.0, 0.1])
    return rng.uniform(low, high).astype(np.float32)


def _step(simulation: Simulation, tick: int, episodes: list[int]) -> None:
    actions = np.stack([_action(episode, tick) for episode in episodes])
    simulation.step(actions, np.ones(len(episodes), dtype=bool))


def _bits(simulation: Simulation, row: int) -> bytes:
    episodes, tick = simulation.world.episodes, int(simulation.world.now[row])
    agents = int((episodes.ids[row] >= 0).sum())
    arrays = episodes.states[row, : tick + 1, :agents], episodes.valid[row, : tick + 1, :agents]
    return b"".join(each.tobytes() for each in arrays)


@pytest.mark.parametrize("name", registry.names("drivers"))
def test_is_a_driver_plug(name):
    """Each creates a driver from its name, and refuses an invalid argument."""
    plug: DriverPlug = registry.find("drivers", name)
    assert isinstance(plug, DriverPlug)
    for argument in ARGUMENTS.get(name, ("",)):
        assert isinstance(plug.from_name(argument, dt_s=DT_S), Driver)
    with pytest.raises(AspEnvError, match=r"^[^\n]*nonsense[^\n]*$"):
        plug.from_name("nonsense", dt_s=DT_S)


@pytest.mark.parametrize(
    ("case", "traffic"), [(case, name) for case in DRIVER_CASES for name in sorted(REFUSED[case])]
)
def test_drivers_that_do_not_fit_the_world_are_refused(case, traffic):
    """In one line that names drivers that fit; also within a table."""
    for spec in (traffic, f"default=idm,car={traffic}"):
        with pytest.raises(AspEnvError, match=rf"^traffic {traffic}: [^\n]* use [^\n]*idm[^\n]*$"):
            _begin(_case(case), spec)


@every_in_every_case
def test_controls_are_valid(case, traffic):
    """Actions are finite and within limits, and zero for agents that are not controlled."""
    simulation = _begin(_case(case), traffic)
    world, limits = simulation.world, np.array([5.0, np.pi / 4]) + 1e-6
    recorded = "log-actions" in traffic
    for tick in range(_case(case).steps):
        control = copy.deepcopy(simulation.driver).control(world)
        assert control.actions.shape == (*world.episodes.ids.shape, 2)
        assert control.actions.dtype == np.float32
        assert np.isfinite(control.actions).all()
        assert recorded or (np.abs(control.actions) <= limits).all()
        assert not control.actions[~control.controlled & ~control.leaving].any()
        assert not (control.controlled & control.leaving).any()
        assert not ((control.controlled | control.leaving) & ~controllable_agents(world)).any()
        _step(simulation, tick, [0, 1, 2, 3])
    assert np.isfinite(world.episodes.states).all()


@every_in_every_case
def test_episodes_are_independent(case, traffic):
    """Five episodes in a batch are bit for bit the same as each on its own."""
    order = [0, 1, 2, 3, 0]
    together = _begin(_case(case), traffic, *order)
    alone = [_begin(_case(case), traffic, i) for i in order]
    for tick in range(_case(case).steps):
        _step(together, tick, order)
        for single, number in zip(alone, order, strict=True):
            _step(single, tick, [number])
    for row, single in enumerate(alone):
        assert _bits(together, row) == _bits(single, 0)


@every_in_every_case
def test_a_reset_touches_only_the_chosen_rows(case, traffic):
    """Row 1 restarts with a scenario of another size, and equals a new episode of it."""
    scenarios = _case(case).scenarios
    partly_reset, undisturbed = (_begin(_case(case), traffic, 2, 0, 1) for _ in range(2))
    fresh = _begin(_case(case), traffic, 3)
    for tick in range(_case(case).steps):
        if tick == 7:
            reset_mask = np.array([False, True, False])
            rngs = [np.random.default_rng(scenarios[3].ego_id)] * 3
            partly_reset.reset([scenarios[0], scenarios[3], scenarios[0]], rngs, reset_mask)
        _step(undisturbed, tick, [2, 0, 1])
        _step(partly_reset, tick, [2, 0 if tick < 7 else 3, 1])
        if tick >= 7:
            _step(fresh, tick, [3])
    assert _bits(partly_reset, 0) == _bits(undisturbed, 0)
    assert _bits(partly_reset, 2) == _bits(undisturbed, 2)
    assert _bits(partly_reset, 1) == _bits(fresh, 0)


@every_in_every_case
def test_a_snapshot_restores_the_memory_of_a_driver(case, traffic):
    """Restored twice, with a reset in between: the same bits."""
    scenarios = _case(case).scenarios
    simulation = _begin(_case(case), traffic)
    for tick in range(8):
        _step(simulation, tick, [0, 1, 2, 3])
    snapshot = simulation.snapshot()
    runs = []
    for _ in range(3):
        for tick in range(8, _case(case).steps):
            _step(simulation, tick, [0, 1, 2, 3])
        runs.append([_bits(simulation, row) for row in range(4)])
        reset_mask = np.array([True, False, False, True])
        simulation.reset([scenarios[1]] * 4, [np.random.default_rng(5)] * 4, reset_mask)
        simulation.restore(snapshot)
    assert runs[0] == runs[1] == runs[2]


@every
def test_a_driver_can_be_used_in_another_world(traffic, cases):
    """Its memory of other worlds has no effect."""
    driver = make_traffic(traffic)
    for case in (*cases, cases[0]):
        used, fresh = _begin(_case(case), driver), _begin(_case(case), traffic)
        for tick in range(10):
            _step(used, tick, [0, 1, 2, 3])
            _step(fresh, tick, [0, 1, 2, 3])
        assert [_bits(used, row) for row in range(4)] == [_bits(fresh, row) for row in range(4)]


@every
def test_a_copy_shares_what_never_changes(traffic, cases):
    """Recordings, predictors and paths are not copied."""
    simulation = _begin(_case(cases[-1]), traffic)
    memo: dict[int, object] = {}
    copy.deepcopy(simulation.driver, memo)
    kinds = {type(each).__name__ for each in memo.values()}
    assert not kinds & {"Recording", "RoadMap", "Paths", "Conflicts", "Recordings"}
    assert not {kind for kind in kinds if "Velocity" in kind or "Turn" in kind or kind == "Oracle"}


NETWORK_SCENARIOS = [scenario(1, start=20, length=20), scenario(3, start=30, length=20)]


def _run_network(traffic: str, scenarios: list) -> np.ndarray:
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


def test_a_driver_with_a_network(folder: Path):
    """Random weights: finite and repeatable; alone and in a batch the same within 1 cm."""
    name = Case("ffw-asp", "vectors").save(folder)
    traffic = f"default=log,car=predictor:every=3:mode=sampled:{name}"
    together = _run_network(traffic, NETWORK_SCENARIOS)
    assert np.isfinite(together).all()
    assert together.tobytes() == _run_network(traffic, NETWORK_SCENARIOS).tobytes()
    for row, each in enumerate(NETWORK_SCENARIOS):
        alone = _run_network(traffic, [each])
        difference = together[row, :, : alone.shape[2], :2] - alone[0, :, :, :2]
        assert np.abs(difference).max() < 0.01
