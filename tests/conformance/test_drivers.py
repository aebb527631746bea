"""What holds of every driver: those of the registry, and tables of several."""

import copy

import numpy as np
import pytest

from asp_env import registry
from asp_env.data.scenario import Scenario, find_scenarios
from asp_env.data.source import open_data
from asp_env.errors import AspEnvError
from asp_env.sim.drivers import Driver, DriverPlug
from asp_env.sim.drivers.driver import vehicles
from asp_env.sim.simulation import Simulation
from asp_env.sim.traffic import make_traffic
from tests.builders import make_recording
from tests.sim.worlds import DT_S, HISTORY, scenario

ARGUMENTS = {
    "predictor": ("constant-turn-rate", "every=3:mode=sampled:constant-velocity", "oracle")
}
"""Behind the colon, for drivers that need an argument."""

NAMES = tuple(
    f"{name}:{argument}" if argument else name
    for name in registry.names("drivers")
    for argument in ARGUMENTS.get(name, ("",))
)
TABLE = "default=idm,car=hybrid,truck=log-actions,van=predictor:constant-velocity,3=policy"
STEPS = 30


def _made_up() -> tuple[list, list[Scenario]]:
    recordings = [make_recording(), make_recording(name="01", seed=1, duration_s=16.0)]
    scenarios = [
        scenario(1, start=15, length=24),
        scenario(3, start=20, length=40, recording=1),
        scenario(7, start=36, length=20),
        scenario(2, start=15, length=40),
    ]
    return recordings, scenarios


def _sample() -> tuple[list, list[Scenario]]:
    recordings = list(open_data("sample:intersection"))
    found = find_scenarios(recordings, source="sample", dt_s=DT_S, history=HISTORY)
    return recordings, [found[i] for i in (0, 9, 21, 33)]


DATA = {"made up": _made_up(), "sample": _sample()}

every = pytest.mark.parametrize("traffic", [*NAMES, TABLE])
anywhere = pytest.mark.parametrize("data", DATA.values(), ids=list(DATA))


def _begin(recordings, scenarios, traffic) -> Simulation:
    simulation = Simulation(
        recordings,
        make_traffic(traffic),
        num_episodes=len(scenarios),
        dt_s=DT_S,
        history=HISTORY,
    )
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


@every
@anywhere
def test_a_driver_says_nothing_of_others(traffic, data):
    """Its actions are finite and within limits, 0 for whom it does not drive, and its own alone."""
    recordings, scenarios = data
    simulation = _begin(recordings, scenarios, traffic)
    world, limits = simulation.world, np.array([5.0, np.pi / 4]) + 1e-6
    logged = traffic.startswith("log-actions") or "log-actions" in traffic
    for tick in range(STEPS):
        control = copy.deepcopy(simulation.driver).control(world)
        assert control.actions.shape == (*world.episodes.ids.shape, 2)
        assert control.actions.dtype == np.float32
        assert np.isfinite(control.actions).all()
        assert logged or (np.abs(control.actions) <= limits).all()
        assert not control.actions[~control.driven & ~control.leaving].any()
        assert not (control.driven & control.leaving).any()
        assert not ((control.driven | control.leaving) & ~vehicles(world)).any()
        _step(simulation, tick, [0, 1, 2, 3])
    assert np.isfinite(world.episodes.states).all()


@every
@anywhere
def test_episodes_do_not_know_of_each_other(traffic, data):
    """Five at once are bit for bit the five alone."""
    recordings, scenarios = data
    order = [0, 1, 2, 3, 0]
    together = _begin(recordings, [scenarios[i] for i in order], traffic)
    alone = [_begin(recordings, [scenarios[i]], traffic) for i in order]
    for tick in range(STEPS):
        _step(together, tick, order)
        for single, number in zip(alone, order, strict=True):
            _step(single, tick, [number])
    for row, single in enumerate(alone):
        assert _told(together, row) == _told(single, 0)


@every
@anywhere
def test_a_reset_of_some_disturbs_no_others(traffic, data):
    """Row 1 begins anew with a scenario of another size; it is then as if it were alone."""
    recordings, scenarios = data
    disturbed = _begin(recordings, [scenarios[2], scenarios[0], scenarios[1]], traffic)
    left_alone = _begin(recordings, [scenarios[2], scenarios[0], scenarios[1]], traffic)
    fresh = _begin(recordings, [scenarios[3]], traffic)
    for tick in range(STEPS):
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


@every
@anywhere
def test_a_snapshot_brings_back_what_a_driver_remembers(traffic, data):
    """Taken amid the episodes and restored twice, another reset in between: the same bits."""
    recordings, scenarios = data
    simulation = _begin(recordings, scenarios, traffic)
    for tick in range(8):
        _step(simulation, tick, [0, 1, 2, 3])
    snapshot = simulation.snapshot()
    runs = []
    for _ in range(3):
        for tick in range(8, STEPS):
            _step(simulation, tick, [0, 1, 2, 3])
        runs.append([_told(simulation, row) for row in range(4)])
        where = np.array([True, False, False, True])
        simulation.reset([scenarios[1]] * 4, [np.random.default_rng(5)] * 4, where)
        simulation.restore(snapshot)
    assert runs[0] == runs[1] == runs[2]


@every
def test_a_driver_can_go_on_to_another_world(traffic):
    """What it remembers of a larger one does not show."""
    driver = make_traffic(traffic)
    for recordings, scenarios in (DATA["sample"], DATA["made up"]):
        used = Simulation(
            recordings, driver, num_episodes=len(scenarios), dt_s=DT_S, history=HISTORY
        )
        used.reset(scenarios, [np.random.default_rng(each.ego_id) for each in scenarios])
        fresh = _begin(recordings, scenarios, traffic)
        for tick in range(10):
            _step(used, tick, [0, 1, 2, 3])
            _step(fresh, tick, [0, 1, 2, 3])
        assert [_told(used, row) for row in range(4)] == [_told(fresh, row) for row in range(4)]


@every
def test_a_copy_shares_what_never_changes(traffic):
    """Neither recordings nor predictors nor paths are copied: no object of theirs is met."""
    recordings, scenarios = DATA["made up"]
    simulation = _begin(recordings, scenarios, traffic)
    memo: dict[int, object] = {}
    copy.deepcopy(simulation.driver, memo)
    kinds = {type(each).__name__ for each in memo.values()}
    assert not kinds & {"Recording", "RoadMap", "Paths", "Conflicts", "Recordings"}
    assert not {kind for kind in kinds if "Velocity" in kind or "Turn" in kind or kind == "Oracle"}
