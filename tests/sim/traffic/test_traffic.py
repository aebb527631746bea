"""Assignment of agents to drivers."""

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
    """Controls no agents and stores its calls."""

    def __init__(self) -> None:
        self.agent_mask: np.ndarray | None = None
        self.calls = 0

    def reset(self, world, reset_mask, agent_mask=None) -> None:
        """Stores its agents."""
        assert reset_mask.shape == (len(world),)
        self.agent_mask = agent_mask

    def control(self, world) -> Control:
        """Counts its calls."""
        self.calls += 1
        return no_control(world.episodes.ids.shape)


def _ids(spy: Spy, simulation) -> list[int]:
    if spy.agent_mask is None:
        return []
    return sorted(simulation.world.episodes.ids[spy.agent_mask].tolist())


def test_an_agent_has_the_driver_of_its_id_else_of_its_class_else_the_default():
    """Vehicles are 1 (ego) to 7 and 9; 8 is a pedestrian and 10 is parked."""
    by_id, by_class, rest = Spy(), Spy(), Spy()
    table = {5: by_id, 3: by_id, "car": by_class, "default": rest}
    simulation = simulate(make_recording(), scenario(1), table)
    assert _ids(by_id, simulation) == [3, 5]
    assert _ids(by_class, simulation) == [2, 6]
    assert _ids(rest, simulation) == [4, 7, 9]


def test_without_a_default_all_other_agents_replay():
    simulation = simulate(make_recording(), scenario(1), {3: "idm"})
    replay(simulation, 20)
    episodes, tick = simulation.world.episodes, simulation.world.now[0]
    for slot, track in enumerate(episodes.ids[0].tolist()):
        same = (
            episodes.states[0, tick, slot].tobytes() == episodes.log_states[0, tick, slot].tobytes()
        )
        assert same == (track != 3)


def test_a_driver_without_agents_is_not_called():
    unused, used = Spy(), Spy()
    simulation = simulate(on_road(car(-50, 8)), scenario(), {99: unused, "default": used})
    replay(simulation, 3)
    assert unused.agent_mask is None
    assert unused.calls == 0
    assert used.calls == 3


def test_equal_names_share_one_driver():
    """So that a predictor is called once for all its agents."""
    traffic = make_traffic({"car": "idm", "truck": "idm", "default": "idm"})
    assert isinstance(traffic, Traffic)
    assert len(traffic.drivers) == 1


@pytest.mark.parametrize(
    "text",
    [
        "default=idm,truck=log-actions,3=policy",
        " default = idm , truck=log-actions,3 =policy",
    ],
)
def test_text_is_equivalent_to_a_table(text):
    table = {"default": "idm", "truck": "log-actions", 3: "policy"}
    one, other = (simulate(make_recording(), scenario(1), each) for each in (text, table))
    for simulation in (one, other):
        replay(simulation, 10)
    same = one.world.episodes.states.tobytes() == other.world.episodes.states.tobytes()
    assert same


def test_drivers_with_options_in_a_table():
    """Colons, equal signs and commas of options and of the table are distinguished."""
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
        ("pedestrian=idm", "traffic for 'pedestrian': only vehicles have drivers; expected "),
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
def test_invalid_traffic_is_refused_in_one_line(spec, error):
    with pytest.raises(AspEnvError) as caught:
        make_traffic(spec)
    assert error in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_name_or_a_driver_needs_no_table():
    assert isinstance(make_traffic("log"), LogDriver)
    driver = LogActionsDriver()
    assert make_traffic(driver) is driver
    assert isinstance(driver, Driver)


def test_the_caller_overrides_the_driver():
    simulation = simulate(on_road(car(-50, 8), car(-80, 8)), scenario(), "idm")
    actions = np.zeros((1, 3, 2), dtype=np.float32)
    actions[0, 1, 0] = -4.0
    controlled = np.array([[False, True, False]])
    for _ in range(5):
        simulation.step_agents(actions, controlled)
    braked, other = now(simulation, 2), now(simulation, 3)
    assert braked is not None
    assert other is not None
    assert braked[3] == pytest.approx(4.0, abs=1e-3)
    assert other[3] > 7.0


def test_policy_agents_continue_straight_without_the_caller():
    """8 m/s for 2 s are 16 m; the agent leaves 10 m outside the recorded area."""
    leaver = Drive(kind=AgentClass.CAR, start=(60.0, -1.75, 0.0, 8.0), leaves_s=4.0)
    simulation = simulate(on_road(leaver), scenario(length=60), "policy")
    replay(simulation, 10)
    assert now(simulation, 2) == pytest.approx([60 + 8 * 5, -1.75, 0, 8], abs=0.01)
    edge = simulation.world.recordings[0].extent_m[2]
    replay(simulation, round((edge + 10 - 100) / 1.6))
    assert now(simulation, 2) is not None
    replay(simulation, 2)
    assert now(simulation, 2) is None


def test_controllable_agents():
    """Cars, a van, a truck, a motorcycle, a bicycle; not the ego, a pedestrian, a parked car."""
    world = simulate(make_recording(), scenario(1, start=25)).world
    assert sorted(world.episodes.ids[controllable_agents(world)].tolist()) == [2, 3, 4, 5, 6, 7, 9]
