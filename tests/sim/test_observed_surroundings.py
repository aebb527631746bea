"""What the ego is shown of its surroundings: vectors and the route ahead, and what that costs."""

import dataclasses

import numpy as np
import pytest

from asp_env.errors import AspEnvError
from asp_env.sim.observation import (
    ROUTE_POINTS,
    ROUTE_STEP_M,
    ObservationContext,
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


def test_a_neighbour_by_hand():
    """The ego goes north at 5 m/s from (1.75, -95); a car 11.75 m to the left goes east at 3 m/s.

    Seen by the ego, left is +y, and what goes east goes to the right.
    """
    neighbour = car(-10.0 - 3 * 3.0, 3.0, y_m=-80.0)  # 3 s of history lie before now
    simulation = simulate(on_road(neighbour), scenario(length=30))
    told = _observe(simulation, "vectors")
    agents, valid = told["agents"][0], told["agents_valid"][0]
    assert valid[:2].all()
    assert not valid[2:].any()
    assert agents[0, -1, [X, Y]] == pytest.approx((0, 0), abs=1e-5)
    assert agents[0, 0, [X, Y, SPEED]] == pytest.approx((-15, 0, 5), abs=1e-3)
    assert agents[1, -1, [X, Y, SPEED]] == pytest.approx((0, 11.75, 3), abs=1e-3)
    cos, sin = agents[1, -1, AGENT_FIELDS.index("cos")], agents[1, -1, AGENT_FIELDS.index("sin")]
    assert (cos, sin) == pytest.approx((0, -1), abs=1e-5)
    assert not agents[2:].any()


def test_vectors_are_those_of_the_view():
    """Bit for bit what a network is shown of the scene, as float32 and masks of 0 and 1."""
    simulation = simulate(make_recording(), [scenario(3), scenario(5)])
    drive(simulation, [(2.0, 0.1)] * 4)
    scene = simulation.world.scene()
    drawn = VectorView().render(scene.with_targets(np.array([(0, 0), (1, 0)])))
    told = _observe(simulation, "vectors")
    for name, part in drawn._asdict().items():
        assert told[name].astype(part.dtype).tobytes() == part.tobytes()
    assert told["agents_valid"].dtype == np.int8


def test_vectors_far_away_are_kept_within_the_bounds():
    """A neighbour at 5 km and 300 m/s is shown at 1 km and 60 m/s."""
    simulation = simulate(on_road(car(0.0, 3.0)), scenario())
    world = simulation.world
    world.episodes.states[0, HISTORY, 1] = (5000.0, 5000.0, 0.0, 300.0)
    agents = _observe(simulation, "vectors")["agents"]
    assert agents[0, 1, -1, [X, Y, SPEED]].tolist() == [1000.0, -1000.0, 60.0]
    assert np.abs(agents).max() <= 1000.0


def test_the_route_straight_ahead_by_hand():
    """Points 2, 4, … 60 m ahead on the way north, in the frame of an ego that drives along it."""
    simulation = simulate(on_road(), scenario(length=30))
    ahead = ROUTE_STEP_M * np.arange(1, ROUTE_POINTS + 1)
    route = _observe(simulation, "route")["route"][0]
    assert route == pytest.approx(np.stack([ahead, 0 * ahead], axis=-1), abs=1e-3)


def test_the_route_turns_with_the_ego_and_goes_on_straight_behind_its_end():
    """Half a metre to the right of the route and turned left by 0.3 rad, near the route's end."""
    simulation = simulate(on_road(), scenario(length=30))
    world, data = simulation.world, simulation.world.episodes
    x, y = 1.75 + 0.5, -95.0 + 15.0 + 20.0  # the route began at y = -80
    data.states[0, HISTORY, 0] = (x, y, np.pi / 2 + 0.3, 5.0)
    data.on_route[0] = (20.0, -0.5, np.pi / 2)
    count = 41
    data.route_valid[0, count:] = False  # it ends at arc 40, 20 m ahead
    data.route[0, count:] = 1e6
    route = _observe(simulation, "route")["route"][0]
    ahead = ROUTE_STEP_M * np.arange(1, ROUTE_POINTS + 1)
    cos, sin = np.cos(0.3), np.sin(0.3)
    assert world.events().route_m[0] == 20.0
    expected = np.stack([cos * ahead + sin * 0.5, cos * 0.5 - sin * ahead], axis=-1)
    assert route == pytest.approx(expected, abs=2e-3)


def test_some_episodes_are_seen_as_among_all():
    """Rows of a sight of everybody, whatever their order."""
    simulation = simulate(make_recording(), [scenario(3), scenario(5), scenario(1)])
    replay(simulation, 3)
    world, events = simulation.world, simulation.world.events()
    observer = Observer(("vectors", "raster", "actions", "state", "route"), VIEW, HISTORY)
    everybody = observer.observe(ego_context(world), events)
    rows = np.array([2, 0])
    fields = {each.name: getattr(events, each.name)[rows] for each in dataclasses.fields(events)}
    some = observer.observe(ego_context(world, rows), type(events)(**fields))
    for name, part in some.items():
        assert part.tobytes() == everybody[name][rows].tobytes()


def test_the_former_content_of_memory_does_not_matter():
    """Garbage in, the same out; what is returned is the memory."""
    simulation = simulate(make_recording(), [scenario(3), scenario(5)])
    world = simulation.world
    observer = Observer(("vectors", "raster", "actions", "state", "route"), VIEW, HISTORY)
    fresh = observer.observe(ego_context(world), world.events())
    memory = observer.memory(2)
    for part in memory.values():
        part.view(np.uint8)[:] = 127
    told = observer.observe(ego_context(world), world.events(), memory)
    for name, part in told.items():
        assert part is memory[name]
        assert part.tobytes() == fresh[name].tobytes()


def test_nothing_is_computed_that_nobody_asked_for(monkeypatch):
    """Without the raster no picture is drawn; vectors and route need no inferred actions."""

    def refuse(*_: object) -> None:
        raise AssertionError("nobody asked for this")

    simulation = simulate(on_road(), scenario())
    monkeypatch.setattr(type(VIEW), "render", refuse)
    monkeypatch.setattr("asp_env.sim.world.World.scene", refuse)
    _observe(simulation, "actions", "state")
    monkeypatch.setattr("asp_env.sim.observation.infer_actions", refuse)
    _observe(simulation, "vectors", "route")
    with pytest.raises(AssertionError, match="nobody asked"):
        _observe(simulation, "raster")


def test_a_sight_is_the_scene_without_its_actions():
    """The same states and masks of the last ticks; the egos are the targets."""
    simulation = simulate(make_recording(), [scenario(3), scenario(5)])
    drive(simulation, [(1.0, 0.0)] * 2)
    sight, scene = ego_context(simulation.world), simulation.world.scene()
    assert isinstance(sight, ObservationContext)
    assert sight.states.tobytes() == (scene.states * scene.valid[..., None]).tobytes()
    assert np.array_equal(sight.valid, scene.valid)
    assert np.array_equal(sight.targets, [(0, 0), (1, 0)])
    assert (sight.history, sight.dt_s) == (scene.history, scene.dt_s)


def test_a_history_too_short_is_refused_at_once():
    """Not only when something is first drawn."""
    with pytest.raises(AspEnvError, match="'vectors' needs 15 past ticks, there are 10"):
        Observer(("state", "vectors"), VIEW, 10)
    with pytest.raises(AspEnvError, match="'raster' needs 15 past ticks, there are 5"):
        Observer(("raster",), VIEW, 5)


def test_names_are_given_once():
    """Twice the same part would be one."""
    with pytest.raises(AspEnvError, match="observations state, state: name each once"):
        Observer(("state", "state"), VIEW, HISTORY)
    with pytest.raises(AspEnvError, match="observations 'state': expected some of"):
        Observer("state", VIEW, HISTORY)
