"""What an agent is shown."""

import itertools
import math

import numpy as np
import pytest

from asp_env.errors import AspEnvError
from asp_env.sim.observation import STATE_FIELDS, Observer, ego_context
from asp_env.views import make_raster_view
from tests.builders import make_recording
from tests.sim.worlds import HISTORY, drive, on_road, scenario, simulate

VIEW = make_raster_view("chauffeurnet", pixels=(90, 60))


def _state(simulation) -> dict[str, float]:
    observer = Observer(("state",), VIEW, HISTORY)
    world = simulation.world
    row = observer.observe(ego_context(world), world.events())["state"][0]
    return dict(zip(STATE_FIELDS, row.tolist(), strict=True))


def test_state_by_hand():
    """The ego goes north at 5 m/s; its way of 30 m begins here; a car is 4.5 m by 1.8 m."""
    simulation = simulate(on_road(), scenario(length=30))
    assert _state(simulation) == pytest.approx(
        {
            "speed_mps": 5.0,
            "acceleration_mps2": 0.0,
            "steering_rad": 0.0,
            "route_offset_m": 0.0,
            "route_heading_error_rad": 0.0,
            "route_done": 0.0,
            "to_goal_m": 30.0,
            "length_m": 4.5,
            "width_m": 1.8,
        },
        abs=0.01,
    )
    drive(simulation, [(2.0, 0.1)])
    state = _state(simulation)
    assert state["acceleration_mps2"] == pytest.approx(2.0, abs=1e-3)
    assert state["steering_rad"] == pytest.approx(0.1, abs=1e-3)
    assert state["speed_mps"] == pytest.approx(5.4)
    # 1.04 m on, to the left of the route and turned left against it
    assert state["to_goal_m"] == pytest.approx(28.96, abs=0.02)
    assert state["route_done"] == pytest.approx(1.04 / 30, abs=1e-3)
    slip = math.atan(0.5 * math.tan(0.1))
    assert state["route_heading_error_rad"] == pytest.approx(
        5.2 * 0.2 * math.sin(slip) / 1.35, rel=0.01
    )
    assert 0 < state["route_offset_m"] < 0.1


def test_actions_are_the_last_three_seconds_oldest_first():
    """Three driven steps are the last three of fifteen rows."""
    simulation = simulate(on_road(), scenario(length=30))
    drive(simulation, [(1.0, 0.0), (0.0, 0.1), (-2.0, -0.2)])
    observer = Observer(("actions",), VIEW, HISTORY)
    world = simulation.world
    actions = observer.observe(ego_context(world), world.events())["actions"]
    assert actions.shape == (1, 15, 2)
    expected = np.array([(0, 0)] * 12 + [(1, 0), (0, 0.1), (-2, -0.2)])
    assert actions[0] == pytest.approx(expected, abs=3e-3)


@pytest.mark.parametrize(
    "names",
    [
        names
        for n in (1, 2, 3)
        for names in itertools.permutations(("raster", "actions", "state"), n)
    ],
    ids="-".join,
)
def test_observations_lie_in_their_space(names):
    """Every choice of parts, in any order: of the space's type and shape, within its bounds."""
    observer = Observer(names, VIEW, HISTORY)
    simulation = simulate(make_recording(), [scenario(3), scenario(5)])
    drive(simulation, [(5.0, 0.7)] * 4)
    observed = observer.observe(ego_context(simulation.world), simulation.world.events())
    assert set(observed) == set(observer.space)
    for row in range(2):
        assert {name: part[row] for name, part in observed.items()} in observer.space


def test_wild_values_are_clipped_to_the_bounds():
    """A leap of 40 m/s in a tick and a place far off the route are shown as the bounds."""
    simulation = simulate(on_road(), scenario())
    world = simulation.world
    world.episodes.states[0, HISTORY, 0] = (900.0, -95.0, np.pi / 2, 90.0)
    world.episodes.inferred[0] -= 1
    world.episodes.on_route[0] = (-900.0, -890.0, 0.0)
    observer = Observer(("actions", "state"), VIEW, HISTORY)
    observed = observer.observe(ego_context(world), world.events())
    assert {name: part[0] for name, part in observed.items()} in observer.space
    assert observed["actions"][0, -1, 0] == 10.0
    assert observed["state"][0, 0] == 60.0


def test_unknown_and_missing_names_are_refused():
    """One line that lists what there is."""
    with pytest.raises(AspEnvError, match=r"unknown observation 'rastr' \(did you mean 'raster'"):
        Observer(("state", "rastr"), VIEW, HISTORY)
    with pytest.raises(AspEnvError, match="no observation given: expected some of raster, vectors"):
        Observer((), VIEW, HISTORY)
