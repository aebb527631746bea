"""What holds of every driver: those of the registry, and tables of several."""

import copy
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
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
from tests.highway_folders import highway_recordings
from tests.sim.worlds import DT_S, HISTORY, scenario, simulate

ARGUMENTS = {
    "predictor": ("constant-turn-rate", "every=3:mode=sampled:constant-velocity", "oracle")
}
"""Behind the colon, for drivers that need an argument."""

NAMES = tuple(
    f"{name}:{argument}" if argument else name
    for name in registry.names("drivers")
    for argument in ARGUMENTS.get(name, ("",))
)
REPLAY_TABLE = "default=idm,car=hybrid,truck=log-actions,van=predictor:constant-velocity,3=policy"
OWN_TABLE = "default=own,3=policy,8=idm,2=log-actions,4=predictor:constant-velocity"


@dataclass(frozen=True, slots=True, kw_only=True)
class Stage:
    """Four episodes, and who can drive in them."""

    recordings: Sequence[Any]
    scenarios: list[Scenario]
    kind: type[World] = ReplayWorld
    steps: int = 30


def _made_up() -> Stage:
    return Stage(
        recordings=[make_recording(), make_recording(name="01", seed=1, duration_s=16.0)],
        scenarios=[
            scenario(1, start=15, length=24),
            scenario(3, start=20, length=40, recording=1),
            scenario(7, start=36, length=20),
            scenario(2, start=15, length=40),
        ],
    )


def _sample() -> Stage:
    recordings = list(open_data("sample:intersection"))
    found = find_scenarios(recordings, source="sample", dt_s=DT_S, history=HISTORY)
    return Stage(recordings=recordings, scenarios=[found[i] for i in (0, 9, 21, 33)])


def _highway() -> Stage:
    return Stage(
        recordings=highway_recordings("roundabout"),
        scenarios=[
            scenario(7, start=115, length=10),
            scenario(4, start=28, length=20, recording=1),
            scenario(2, start=20, length=12),
            scenario(9, start=130, length=40, recording=1),
        ],
        kind=world_class("highway:"),
        steps=14,
    )


STAGES = {"sample": _sample, "highway": _highway, "made up": _made_up}
"""From larger scenes to smaller ones."""

REFUSED = {"sample": {"own"}, "made up": {"own"}, "highway": {"log", "hybrid"}}
"""By whom nobody can be driven there."""


@cache
def _stage(name: str) -> Stage:
    return STAGES[name]()


def _traffics(stage: str) -> list[str]:
    """Everybody who drives there, and a table of several."""
    table = OWN_TABLE if stage == "highway" else REPLAY_TABLE
    return [*(name for name in NAMES if name not in REFUSED[stage]), table]


every = pytest.mark.parametrize(
    ("traffic", "stages"),
    [
        pytest.param(
            traffic, [stage for stage in STAGES if traffic in _traffics(stage)], id=traffic
        )
        for traffic in (*NAMES, REPLAY_TABLE, OWN_TABLE)
    ],
)
anywhere = pytest.mark.parametrize(
    ("stage", "traffic"),
    [
        pytest.param(stage, traffic, id=f"{stage}-{traffic}")
        for stage in STAGES
        for traffic in _traffics(stage)
    ],
)


def _begin(stage: Stage, traffic: str | Driver, *numbers: int) -> Simulation:
    """Some of its episodes, by default all, that have just begun."""
    scenarios = [stage.scenarios[i] for i in numbers or range(4)]
    simulation = simulate(stage.recordings, scenarios, traffic, stage.kind)
    simulation.reset(scenarios, [np.random.default_rng(each.ego_id) for each in scenarios])
    return simulation


def _action(episode: int, tick: int) -> np.ndarray:
    """Some egos brake, some swerve, all differently."""
    rng = np.random.default_rng([episode, tick])
    low, high = np.array([-3.0, -0.1]), np.array([2.0, 0.1])
    return rng.uniform(low, high).astype(np.float32)


def _step(simulation: Simulation, tick: int, episodes: list[int]) -> None:
    actions = np.stack([_action(episode, tick) for episode in episodes])
    simulation.step(actions, np.ones(len(episodes), dtype=bool))


def _told(simulation: Simulation, row: int) -> bytes:
    episodes, tick = simulation.world.episodes, int(simulation.world.now[row])
    agents = int((episodes.ids[row] >= 0).sum())
    kept = episodes.states[row, : tick + 1, :agents], episodes.valid[row, : tick + 1, :agents]
    return b"".join(each.tobytes() for each in kept)


@pytest.mark.parametrize("name", registry.names("drivers"))
def test_the_registry_holds_plugs_of_drivers(name):
    """Each makes a driver from its name, and refuses an argument that makes no sense."""
    plug: DriverPlug = registry.find("drivers", name)
    assert isinstance(plug, DriverPlug)
    for argument in ARGUMENTS.get(name, ("",)):
        assert isinstance(plug.from_name(argument, dt_s=DT_S), Driver)
    with pytest.raises(AspEnvError, match=r"^[^\n]*nonsense[^\n]*$"):
        plug.from_name("nonsense", dt_s=DT_S)


@pytest.mark.parametrize(
    ("stage", "traffic"), [(stage, name) for stage in STAGES for name in sorted(REFUSED[stage])]
)
def test_who_cannot_drive_there_is_refused(stage, traffic):
    """In one line that names who can; so are tables that leave somebody to it."""
    for spec in (traffic, f"default=idm,car={traffic}"):
        with pytest.raises(AspEnvError, match=rf"^traffic {traffic}: [^\n]* use [^\n]*idm[^\n]*$"):
            _begin(_stage(stage), spec)


@anywhere
def test_a_driver_says_nothing_of_others(stage, traffic):
    """Its actions are finite and within limits, 0 for whom it does not drive, and its own alone."""
    simulation = _begin(_stage(stage), traffic)
    world, limits = simulation.world, np.array([5.0, np.pi / 4]) + 1e-6
    logged = traffic.startswith("log-actions") or "log-actions" in traffic
    for tick in range(_stage(stage).steps):
        control = copy.deepcopy(simulation.driver).control(world)
        assert control.actions.shape == (*world.episodes.ids.shape, 2)
        assert control.actions.dtype == np.float32
        assert np.isfinite(control.actions).all()
        assert logged or (np.abs(control.actions) <= limits).all()
        assert not control.actions[~control.controlled & ~control.leaving].any()
        assert not (control.controlled & control.leaving).any()
        assert not ((control.controlled | control.leaving) & ~controllable_agents(world)).any()
        _step(simulation, tick, [0, 1, 2, 3])
    assert np.isfinite(world.episodes.states).all()


@anywhere
def test_episodes_do_not_know_of_each_other(stage, traffic):
    """Five at once are bit for bit the five alone."""
    order = [0, 1, 2, 3, 0]
    together = _begin(_stage(stage), traffic, *order)
    alone = [_begin(_stage(stage), traffic, i) for i in order]
    for tick in range(_stage(stage).steps):
        _step(together, tick, order)
        for single, number in zip(alone, order, strict=True):
            _step(single, tick, [number])
    for row, single in enumerate(alone):
        assert _told(together, row) == _told(single, 0)


@anywhere
def test_a_reset_of_some_disturbs_no_others(stage, traffic):
    """Row 1 begins anew with a scenario of another size; it is then as if it were alone."""
    scenarios = _stage(stage).scenarios
    disturbed, left_alone = (_begin(_stage(stage), traffic, 2, 0, 1) for _ in range(2))
    fresh = _begin(_stage(stage), traffic, 3)
    for tick in range(_stage(stage).steps):
        if tick == 7:
            where = np.array([False, True, False])
            rngs = [np.random.default_rng(scenarios[3].ego_id)] * 3
            disturbed.reset([scenarios[0], scenarios[3], scenarios[0]], rngs, where)
        _step(left_alone, tick, [2, 0, 1])
        _step(disturbed, tick, [2, 0 if tick < 7 else 3, 1])
        if tick >= 7:
            _step(fresh, tick, [3])
    assert _told(disturbed, 0) == _told(left_alone, 0)
    assert _told(disturbed, 2) == _told(left_alone, 2)
    assert _told(disturbed, 1) == _told(fresh, 0)


@anywhere
def test_a_snapshot_brings_back_what_a_driver_remembers(stage, traffic):
    """Taken amid the episodes and restored twice, another reset in between: the same bits."""
    scenarios = _stage(stage).scenarios
    simulation = _begin(_stage(stage), traffic)
    for tick in range(8):
        _step(simulation, tick, [0, 1, 2, 3])
    snapshot = simulation.snapshot()
    runs = []
    for _ in range(3):
        for tick in range(8, _stage(stage).steps):
            _step(simulation, tick, [0, 1, 2, 3])
        runs.append([_told(simulation, row) for row in range(4)])
        where = np.array([True, False, False, True])
        simulation.reset([scenarios[1]] * 4, [np.random.default_rng(5)] * 4, where)
        simulation.restore(snapshot)
    assert runs[0] == runs[1] == runs[2]


@every
def test_a_driver_can_go_on_to_another_world(traffic, stages):
    """What it remembers of a larger one, or of one that reacts, does not show."""
    driver = make_traffic(traffic)
    for stage in (*stages, stages[0]):
        used, fresh = _begin(_stage(stage), driver), _begin(_stage(stage), traffic)
        for tick in range(10):
            _step(used, tick, [0, 1, 2, 3])
            _step(fresh, tick, [0, 1, 2, 3])
        assert [_told(used, row) for row in range(4)] == [_told(fresh, row) for row in range(4)]


@every
def test_a_copy_shares_what_never_changes(traffic, stages):
    """Neither recordings nor predictors nor paths are copied: no object of theirs is met."""
    simulation = _begin(_stage(stages[-1]), traffic)
    memo: dict[int, object] = {}
    copy.deepcopy(simulation.driver, memo)
    kinds = {type(each).__name__ for each in memo.values()}
    assert not kinds & {"Recording", "RoadMap", "Paths", "Conflicts", "Recordings"}
    assert not {kind for kind in kinds if "Velocity" in kind or "Turn" in kind or kind == "Oracle"}
