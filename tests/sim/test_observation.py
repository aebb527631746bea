"""Observations: their values, their spaces, and what is computed for them."""

import dataclasses
import itertools
import math

import numpy as np
import pytest

from asp_env.errors import AspEnvError
from asp_env.sim.observation import (
    ROUTE_POINTS,
    ROUTE_STEP_M,
    STATE_FIELDS,
    Observer,
    ego_context,
)
from asp_env.views import make_raster_view
from asp_env.views.vectors import AGENT_FIELDS, VectorView
from tests.builders import make_recording
from tests.sim.worlds import HISTORY, car, drive, on_road, replay, scenario, simulate

VIEW = make_raster_view("chauffeurnet", pixels=(90, 60))
X, Y, SPEED = (AGENT_FIELDS.index(name) for name in ("x", "y", "speed"))


def _observe(simulation, *names: str) -> dict[str, np.ndarray]:
    world = simulation.world
    return Observer(names, VIEW, HISTORY).observe(ego_context(world), world.events())


def _state(simulation) -> dict[str, float]:
    row = _observe(simulation, "state")["state"][0]
    return dict(zip(STATE_FIELDS, row.tolist(), strict=True))


def test_state_by_hand():
    """The ego goes north at 5 m/s at the start of its route of 30 m; a car is 4.5 m by 1.8 m."""
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
    # 1.04 m farther, to the left of the route and turned left against it
    assert state["to_goal_m"] == pytest.approx(28.96, abs=0.02)
    assert state["route_done"] == pytest.approx(1.04 / 30, abs=1e-3)
    slip = math.atan(0.5 * math.tan(0.1))
    assert state["route_heading_error_rad"] == pytest.approx(
        5.2 * 0.2 * math.sin(slip) / 1.35, rel=0.01
    )
    assert 0 < state["route_offset_m"] < 0.1


def test_actions_are_the_last_three_seconds_oldest_first():
    """The actions of three steps are the last three of fifteen rows."""
    simulation = simulate(on_road(), scenario(length=30))
    drive(simulation, [(1.0, 0.0), (0.0, 0.1), (-2.0, -0.2)])
    actions = _observe(simulation, "actions")["actions"]
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
    """Every combination in any order has the type and shape of its space, and is within bounds."""
    observer = Observer(names, VIEW, HISTORY)
    simulation = simulate(make_recording(), [scenario(3), scenario(5)])
    drive(simulation, [(5.0, 0.7)] * 4)
    observed = observer.observe(ego_context(simulation.world), simulation.world.events())
    assert set(observed) == set(observer.space)
    for row in range(2):
        assert {name: part[row] for name, part in observed.items()} in observer.space


def test_values_beyond_the_bounds_are_clipped():
    """A jump of 85 m/s in a tick and a position far off the route."""
    simulation = simulate(on_road(), scenario())
    world = simulation.world
    world.episodes.states[0, HISTORY, 0] = (900.0, -95.0, np.pi / 2, 90.0)
    world.episodes.num_actions[0] -= 1
    world.episodes.on_route[0] = (-900.0, -890.0, 0.0)
    observer = Observer(("actions", "state"), VIEW, HISTORY)
    observed = observer.observe(ego_context(world), world.events())
    assert {name: part[0] for name, part in observed.items()} in observer.space
    assert observed["actions"][0, -1, 0] == 10.0
    assert observed["state"][0, 0] == 60.0


def test_unknown_and_missing_names_are_refused():
    with pytest.raises(AspEnvError, match=r"unknown observation 'rastr' \(did you mean 'raster'"):
        Observer(("state", "rastr"), VIEW, HISTORY)
    with pytest.raises(AspEnvError, match="no observation given: expected some of raster, vectors"):
        Observer((), VIEW, HISTORY)


def test_a_neighbour_in_vectors_by_hand():
    """The ego goes north at 5 m/s from (1.75, -95); a car 11.75 m to the left goes east at 3 m/s.

    In the frame of the ego left is +y, and a car that goes east goes to the right.
    """
    neighbour = car(-10.0 - 3 * 3.0, 3.0, y_m=-80.0)  # after 3 s of history
    simulation = simulate(on_road(neighbour), scenario(length=30))
    observation = _observe(simulation, "vectors")
    agents, valid = observation["agents"][0], observation["agents_valid"][0]
    assert valid[:2].all()
    assert not valid[2:].any()
    assert agents[0, -1, [X, Y]] == pytest.approx((0, 0), abs=1e-5)
    assert agents[0, 0, [X, Y, SPEED]] == pytest.approx((-15, 0, 5), abs=1e-3)
    assert agents[1, -1, [X, Y, SPEED]] == pytest.approx((0, 11.75, 3), abs=1e-3)
    cos, sin = agents[1, -1, AGENT_FIELDS.index("cos")], agents[1, -1, AGENT_FIELDS.index("sin")]
    assert (cos, sin) == pytest.approx((0, -1), abs=1e-5)
    assert not agents[2:].any()


def test_vectors_are_those_of_the_view():
    """The same bits as the input of a network, as float32 and masks of 0 and 1."""
    simulation = simulate(make_recording(), [scenario(3), scenario(5)])
    drive(simulation, [(2.0, 0.1)] * 4)
    scene = simulation.world.scene()
    drawn = VectorView().render(scene.with_targets(np.array([(0, 0), (1, 0)])))
    observation = _observe(simulation, "vectors")
    for name, part in drawn._asdict().items():
        assert observation[name].astype(part.dtype).tobytes() == part.tobytes()
    assert observation["agents_valid"].dtype == np.int8


def test_vectors_far_away_are_clipped_to_the_bounds():
    """A neighbour at 5 km and 300 m/s is observed at 1 km and 60 m/s."""
    simulation = simulate(on_road(car(0.0, 3.0)), scenario())
    world = simulation.world
    world.episodes.states[0, HISTORY, 1] = (5000.0, 5000.0, 0.0, 300.0)
    agents = _observe(simulation, "vectors")["agents"]
    assert agents[0, 1, -1, [X, Y, SPEED]].tolist() == [1000.0, -1000.0, 60.0]
    assert np.abs(agents).max() <= 1000.0


def test_the_route_straight_ahead_by_hand():
    """Points 2, 4, … 60 m ahead of an ego that drives along its route to the north."""
    simulation = simulate(on_road(), scenario(length=30))
    ahead = ROUTE_STEP_M * np.arange(1, ROUTE_POINTS + 1)
    route = _observe(simulation, "route")["route"][0]
    assert route == pytest.approx(np.stack([ahead, 0 * ahead], axis=-1), abs=1e-3)


def test_the_route_turns_with_the_ego_and_continues_straight_after_its_end():
    """Half a metre to the right of the route and turned left by 0.3 rad, near the route's end."""
    simulation = simulate(on_road(), scenario(length=30))
    world, episodes = simulation.world, simulation.world.episodes
    x, y = 1.75 + 0.5, -95.0 + 15.0 + 20.0  # the route starts at y = -80
    episodes.states[0, HISTORY, 0] = (x, y, np.pi / 2 + 0.3, 5.0)
    episodes.on_route[0] = (20.0, -0.5, np.pi / 2)
    count = 41
    episodes.route_valid[0, count:] = False  # it ends at arc length 40 m, 20 m ahead
    episodes.route[0, count:] = 1e6
    route = _observe(simulation, "route")["route"][0]
    ahead = ROUTE_STEP_M * np.arange(1, ROUTE_POINTS + 1)
    cos, sin = np.cos(0.3), np.sin(0.3)
    assert world.events().route_m[0] == 20.0
    expected = np.stack([cos * ahead + sin * 0.5, cos * 0.5 - sin * ahead], axis=-1)
    assert route == pytest.approx(expected, abs=2e-3)


def test_observations_of_some_episodes_are_rows_of_all():
    simulation = simulate(make_recording(), [scenario(3), scenario(5), scenario(1)])
    replay(simulation, 3)
    world, events = simulation.world, simulation.world.events()
    observer = Observer(("vectors", "raster", "actions", "state", "route"), VIEW, HISTORY)
    every = observer.observe(ego_context(world), events)
    rows = np.array([2, 0])
    fields = {each.name: getattr(events, each.name)[rows] for each in dataclasses.fields(events)}
    some = observer.observe(ego_context(world, rows), type(events)(**fields))
    for name, part in some.items():
        assert part.tobytes() == every[name][rows].tobytes()


def test_given_arrays_are_returned_and_their_content_does_not_matter():
    simulation = simulate(make_recording(), [scenario(3), scenario(5)])
    world = simulation.world
    observer = Observer(("vectors", "raster", "actions", "state", "route"), VIEW, HISTORY)
    fresh = observer.observe(ego_context(world), world.events())
    arrays = observer.allocate(2)
    for part in arrays.values():
        part.view(np.uint8)[:] = 127
    observation = observer.observe(ego_context(world), world.events(), arrays)
    for name, part in observation.items():
        assert part is arrays[name]
        assert part.tobytes() == fresh[name].tobytes()


def test_only_chosen_components_are_computed(monkeypatch):
    """Without the raster no raster is drawn; vectors and route infer no actions."""

    def refuse(*_: object) -> None:
        raise AssertionError("not needed")

    simulation = simulate(on_road(), scenario())
    monkeypatch.setattr(type(VIEW), "render", refuse)
    monkeypatch.setattr("asp_env.sim.world.World.scene", refuse)
    _observe(simulation, "actions", "state")
    monkeypatch.setattr("asp_env.sim.observation.infer_actions", refuse)
    _observe(simulation, "vectors", "route")
    with pytest.raises(AssertionError, match="not needed"):
        _observe(simulation, "raster")


def test_a_context_is_the_scene_without_its_actions():
    """It has the same states and masks; its targets are the egos."""
    simulation = simulate(make_recording(), [scenario(3), scenario(5)])
    drive(simulation, [(1.0, 0.0)] * 2)
    context, scene = ego_context(simulation.world), simulation.world.scene()
    assert context.states.tobytes() == (scene.states * scene.valid[..., None]).tobytes()
    assert np.array_equal(context.valid, scene.valid)
    assert np.array_equal(context.targets, [(0, 0), (1, 0)])
    assert (context.history, context.dt_s) == (scene.history, scene.dt_s)


def test_a_short_history_is_refused_at_construction():
    with pytest.raises(AspEnvError, match="'vectors' needs 15 past ticks, there are 10"):
        Observer(("state", "vectors"), VIEW, 10)
    with pytest.raises(AspEnvError, match="'raster' needs 15 past ticks, there are 5"):
        Observer(("raster",), VIEW, 5)


def test_repeated_names_and_a_string_are_refused():
    with pytest.raises(AspEnvError, match="observations state, state: name each once"):
        Observer(("state", "state"), VIEW, HISTORY)
    with pytest.raises(AspEnvError, match="observations 'state': expected some of"):
        Observer("state", VIEW, HISTORY)
