"""Tables from agents to drivers."""

import numpy as np
import pytest

from asp_env.data.classes import AgentClass
from asp_env.errors import AspEnvError
from asp_env.sim.traffic import Control, Driver
from asp_env.sim.traffic.assignment import Traffic, make_traffic
from asp_env.sim.traffic.driver import controllable_agents, no_control
from asp_env.sim.traffic.log import LogActionsDriver, LogDriver
from tests.builders import Drive, make_recording
from tests.sim.worlds import car, now, on_road, replay, scenario, simulate


class Spy:
    """Drives nobody and remembers what it was told."""

    def __init__(self) -> None:
        """Knows nothing yet."""
        self.mine: np.ndarray | None = None
        self.asked = 0

    def reset(self, world, reset_mask, agent_mask=None) -> None:
        """Remembers its agents."""
        assert reset_mask.shape == (len(world),)
        self.mine = agent_mask

    def control(self, world) -> Control:
        """Counts."""
        self.asked += 1
        return no_control(world.episodes.ids.shape)


def _ids(spy: Spy, simulation) -> list[int]:
    if spy.mine is None:
        return []
    return sorted(simulation.world.episodes.ids[spy.mine].tolist())


def test_an_agent_has_the_driver_of_its_id_else_of_its_class_else_the_default():
    """Vehicles 1 (ego) to 7 and 9 of the made-up crossing; 8 walks and 10 is parked."""
    by_id, by_class, rest = Spy(), Spy(), Spy()
    table = {5: by_id, 3: by_id, "car": by_class, "default": rest}
    simulation = simulate(make_recording(), scenario(1), table)
    assert _ids(by_id, simulation) == [3, 5]
    assert _ids(by_class, simulation) == [2, 6]
    assert _ids(rest, simulation) == [4, 7, 9]


def test_without_a_default_the_others_replay():
    """Their states are the log's bits."""
    simulation = simulate(make_recording(), scenario(1), {3: "idm"})
    replay(simulation, 20)
    episodes, tick = simulation.world.episodes, simulation.world.now[0]
    for slot, track in enumerate(episodes.ids[0].tolist()):
        same = (
            episodes.states[0, tick, slot].tobytes() == episodes.log_states[0, tick, slot].tobytes()
        )
        assert same == (track != 3)


def test_a_driver_that_nobody_has_costs_nothing():
    """It is neither reset nor asked."""
    nobodys, everybodys = Spy(), Spy()
    simulation = simulate(on_road(car(-50, 8)), scenario(), {99: nobodys, "default": everybodys})
    replay(simulation, 3)
    assert nobodys.mine is None
    assert nobodys.asked == 0
    assert everybodys.asked == 3


def test_equal_names_share_one_driver():
    """So that a predictor is asked once, whoever has it."""
    traffic = make_traffic({"car": "idm", "truck": "idm", "default": "idm"})
    assert isinstance(traffic, Traffic)
    # the default of a table is `log` before it is given
    assert len(traffic.drivers) == 1


@pytest.mark.parametrize(
    "text",
    [
        "default=idm,truck=log-actions,3=policy",
        " default = idm , truck=log-actions,3 =policy",
    ],
)
def test_text_means_what_a_table_means(text):
    """Ten ticks later every state is the same."""
    table = {"default": "idm", "truck": "log-actions", 3: "policy"}
    one, other = (simulate(make_recording(), scenario(1), each) for each in (text, table))
    for simulation in (one, other):
        replay(simulation, 10)
    same = one.world.episodes.states.tobytes() == other.world.episodes.states.tobytes()
    assert same


def test_options_of_a_driver_survive_in_a_table():
    """Colons, equal signs and commas do not get into each other's way."""
    text = "default=predictor:every=2:mode=sampled:constant-velocity,truck=idm"
    traffic = make_traffic(text)
    assert isinstance(traffic, Traffic)
    kinds = [type(driver).__name__ for driver in traffic.drivers]
    assert kinds == ["PredictorDriver", "IDMDriver"]


@pytest.mark.parametrize(
    ("spec", "error"),
    [
        ("idn", "unknown driver 'idn' (did you mean 'idm'?): known are "),
        ("", "unknown driver '': known are "),
        ("idm:3", "driver idm takes no argument, '3' was given: use idm"),
        ("lorri=idm", "traffic for 'lorri': expected an agent's id, bicycle, bus, car, "),
        ("pedestrian=idm", "traffic for 'pedestrian': only vehicles are driven; expected "),
        ("car=idm,car=log", "traffic 'car=idm,car=log' names 'car' twice"),
        ({"default": "idn"}, "unknown driver 'idn'"),
        ({"truck": "log:x"}, "driver log takes no argument"),
        ({-1: "idm"}, "traffic for -1: expected an agent's id"),
        ("predictor", "driver predictor: names no predictor; expected predictor:[every=TICKS:]"),
        ("predictor:nobody", "unknown predictor 'nobody'"),
        ("predictor:evry=3:constant-velocity", "'evry=3' is no option; expected predictor:[every"),
        ("predictor:every=0:constant-velocity", "'every=0' is no option"),
        ("predictor:mode=best:constant-velocity", "'mode=best' is no option"),
        ("predictor:constant-velocity:x", "predictor constant-velocity takes no argument"),
    ],
    ids=str,
)
def test_what_is_not_understood_is_refused_in_one_line(spec, error):
    """What was given and what was expected."""
    with pytest.raises(AspEnvError) as caught:
        make_traffic(spec)
    assert error in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_plain_name_is_that_driver():
    """No table is put around it, and a driver is handed back as it is."""
    assert isinstance(make_traffic("log"), LogDriver)
    driver = LogActionsDriver()
    assert make_traffic(driver) is driver
    assert isinstance(driver, Driver)


def test_the_caller_comes_before_the_table():
    """An agent that the caller drives obeys it, whatever driver it has."""
    simulation = simulate(on_road(car(-50, 8), car(-80, 8)), scenario(), "idm")
    actions = np.zeros((1, 3, 2), dtype=np.float32)
    actions[0, 1, 0] = -4.0
    driven = np.array([[False, True, False]])
    for _ in range(5):
        simulation.step_agents(actions, driven)
    braked, other = now(simulation, 2), now(simulation, 3)
    assert braked is not None
    assert other is not None
    assert braked[3] == pytest.approx(4.0, abs=1e-3)
    assert other[3] > 7.0


def test_agents_of_the_caller_go_straight_on_where_it_is_silent():
    """8 m/s for 2 s are 16 m; beyond all recorded positions by more than 10 m it leaves."""
    leaver = Drive(kind=AgentClass.CAR, start=(60.0, -1.75, 0.0, 8.0), leaves_s=4.0)
    simulation = simulate(on_road(leaver), scenario(length=60), "policy")
    replay(simulation, 10)
    assert now(simulation, 2) == pytest.approx([60 + 8 * 5, -1.75, 0, 8], abs=0.01)
    edge = simulation.world.recordings[0].extent_m[2]
    replay(simulation, round((edge + 10 - 100) / 1.6))
    assert now(simulation, 2) is not None
    replay(simulation, 2)
    assert now(simulation, 2) is None


def test_vehicles_are_what_can_be_driven():
    """Cars, a van, a truck, a motorcycle and a bicycle; not the ego, walkers and the parked."""
    world = simulate(make_recording(), scenario(1, start=25)).world
    assert sorted(world.episodes.ids[controllable_agents(world)].tolist()) == [2, 3, 4, 5, 6, 7, 9]
