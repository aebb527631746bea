"""highway-env's y axis points down: motion and handedness from end to end."""

from typing import Any

import numpy as np
import pytest
from highway_env.vehicle.kinematics import Vehicle

from asp_env.data.scenarios.scenario import Scenario
from asp_env.dynamics import forward, inverse, normalize_actions
from asp_env.dynamics.bicycle import AXLE_SHARE_OF_LENGTH
from asp_env.geometry import to_frame, wrap_angle
from asp_env.sim.world import world_class
from asp_env.views import make_raster_view
from scenarios.highway.road_map import mirror_actions, mirror_states
from scenarios.highway.rounds import hidden_path, load_history
from scenarios.highway.sites import network
from scenarios.highway.world import HighwayWorld
from tests.highway_folders import highway_data, highway_recordings, highway_scenarios
from tests.scenarios.highway.environments import ego, make
from tests.sim.worlds import drive, replay, simulate

STEP_S, FRAMES = 1 / 15, 3
TRAIL = 2
"""Channel of the raster."""


@pytest.mark.parametrize("seed", range(4))
def test_our_bicycle_with_axles_at_the_bumpers_is_highway_envs(seed):
    """200 steps of Euler's method under random actions agree within a micrometre."""
    rng = np.random.default_rng(seed)
    nowhere: Any = None
    reference = Vehicle(nowhere, rng.uniform(-50, 50, 2), rng.uniform(-3, 3), rng.uniform(-10, 20))
    state = mirror_states(np.array([*reference.position, reference.heading, reference.speed]))
    length = np.array(Vehicle.LENGTH * 0.5 / AXLE_SHARE_OF_LENGTH)
    furthest = 0.0
    for action in rng.uniform((-5.0, -np.pi / 4), (5.0, np.pi / 4), (200, 2)):
        reference.act({"acceleration": action[0], "steering": action[1]})
        reference.step(STEP_S)
        state = forward(
            state, mirror_actions(action), length, STEP_S, integrator="euler", reverse=True
        )
        expected = mirror_states(
            np.array([*reference.position, reference.heading, reference.speed])
        )
        away = state - expected
        away[2] = wrap_angle(away[2])
        assert np.abs(away).max() < 1e-6
        assert abs(reference.speed) < Vehicle.MAX_SPEED
        furthest = max(furthest, np.abs(action).max())
    assert furthest > 4.0


SIDES = pytest.mark.parametrize(("tag", "side"), [("left", 1), ("right", -1)])


def _turning(tag: str) -> Scenario:
    """A vehicle that turns without a stop, from before the turn to after it."""
    found = highway_scenarios("intersection").filtered(f"{tag},!stopping,!yielding")
    quarter = np.abs(np.abs(found.column("turn_deg")) - 90.0) < 3.0
    return next(iter(found.select(quarter).sorted_by("length_s", descending=True)))


@SIDES
def test_left_turns_are_those_of_highway_env(tag, side):
    """Its arms are numbered clockwise, so a left turn from arm c leads to arm c + 1."""
    compared, roads = 0, network("intersection").roads
    for scenario in highway_scenarios("intersection"):
        path = highway_recordings("intersection").tracks_path(scenario.recording)
        rows = load_history(hidden_path(path)).rows
        mine = rows[rows["track"] == scenario.ego_id]
        start = roads[mine[0]["route"][0, 0]]
        end = network("intersection").indices[mine[-1]["target_lane"]]
        if tag in scenario.tags and start[0].startswith("o") and end[1].startswith("o"):
            assert (int(end[1][1]) - int(start[0][1])) % 4 == side % 4
            compared += 1
    assert compared > 5


@SIDES
def test_the_path_turns_to_the_side_of_the_steering(tag, side):
    """Under the logged actions the heading turns by 90° to the side of the steering.

    Before a left turn the route ahead is to the left of the vehicle, after it the trail.
    """
    scenario = _turning(tag)
    recording = highway_recordings("intersection")[scenario.recording]
    log = recording.track(scenario.ego_id)[::FRAMES].astype(np.float64)
    start = scenario.start_tick - recording.first_frames[scenario.ego_id] // FRAMES
    acts = normalize_actions(inverse(log[:-1], log[1:], np.array(Vehicle.LENGTH), 0.2))
    env = make(
        highway_data("intersection"), observations=("raster", "actions", "route"), traffic="own"
    )
    seen, _ = env.reset(options={"scenario": scenario.name})
    before, steering, ahead, behind = ego(env)[2], [], [], []
    for k in range(scenario.length - 1):
        seen, _, over, *_ = env.step(acts[start + k])
        steering.append(seen["actions"][-1, 1])
        ahead.append(seen["route"][10, 1])
        behind.append(_side(seen["raster"][TRAIL]))
        if over:
            break
    turned = float(wrap_angle(np.array(ego(env)[2] - before)))
    assert turned == pytest.approx(side * np.pi / 2, abs=0.3)
    most = np.argmax(np.abs(steering))
    assert steering[most] * side > 0.1
    assert ahead[max(most - 10, 0)] * side > 3.0
    assert max(behind, key=abs) * side > 2.0
    assert sum(steering) * side > 0


def _side(layer: np.ndarray) -> float:
    """Distance of the drawn pixels from the middle column to the left, metres; negative: right."""
    columns = 0.2 * (120 - np.flatnonzero(layer.any(axis=0)))
    return float(columns[np.argmax(np.abs(columns))]) if len(columns) else 0.0


@SIDES
def test_an_observed_vehicle_turns_the_same_way(tag, side):
    """It is a target of another agent: inferred steering, heading and its own raster agree."""
    turner = _turning(tag)
    scenario = next(
        each
        for each in highway_scenarios("intersection")
        if each.recording == turner.recording
        and each.ego_id != turner.ego_id
        and abs(each.start_tick - turner.start_tick) < 10
        and each.length > 50
    )
    simulation = simulate(
        highway_recordings("intersection"), scenario, "own", world_class("highway:")
    )
    view, steering, heading, trail = make_raster_view("chauffeurnet"), [], [], []
    for _ in range(scenario.length):
        scene = simulation.world.scene()
        slot = int(np.flatnonzero(scene.ids[0] == turner.ego_id)[0])
        if not scene.valid[0, slot, -1]:
            break
        steering.append(scene.actions[0, slot, -1, 1])
        heading.append(scene.states[0, slot, -1, 2])
        picture = view.render(scene.with_targets(np.array([[0, slot]])))[0]
        trail.append(_side(picture[TRAIL]))
        replay(simulation, 1)
    turned = np.unwrap(heading)
    assert turned[-1] - turned[0] == pytest.approx(side * np.pi / 2, abs=0.3)
    assert max(steering, key=abs) * side > 0.1
    assert max(trail, key=abs) * side > 2.0


@pytest.mark.parametrize("side", [1, -1])
def test_steering_turns_the_body_that_other_vehicles_see(side):
    """Left is positive: the heading grows here, falls in highway-env, and the box turns left."""
    scenario = highway_scenarios("intersection")[4]
    simulation = simulate(
        highway_recordings("intersection"), scenario, "own", world_class("highway:")
    )
    first = simulation.world.ego_states()[0].copy()
    drive(simulation, [(0.0, side * 0.25)] * 4)
    scene = simulation.world.scene()
    state = scene.states[0, 0, -1]
    turned = float(wrap_angle(state[2] - first[2]))
    assert side * turned > 0.5
    away = state[:2] - first[:2]
    assert side * (np.cos(first[2]) * away[1] - np.sin(first[2]) * away[0]) > 0.5
    assert isinstance(simulation.world, HighwayWorld)
    run = simulation.world._runs[0]
    assert run is not None
    reference = next(each for each in run.road.vehicles if each.track == scene.ids[0, 0])
    assert reference.heading == pytest.approx(-state[2], abs=1e-6)
    assert reference.position == pytest.approx(state[:2] * [1, -1], abs=1e-6)
    assert reference.action["steering"] == pytest.approx(-side * 0.25)
    # seen by a target in whose raster the front of the ego is in range
    others = scene.targets[:, 1]
    nearest = others[np.argmin(np.hypot(*(scene.states[0, others, -1, :2] - state[:2]).T))]
    picture = make_raster_view("chauffeurnet", pixels=(720, 480)).render(
        scene.with_targets(np.array([[0, nearest]]))
    )[0, -1]
    for turn, shown in ((state[2], True), (2 * first[2] - state[2], False)):
        nose = state[:2] + 2.2 * np.array([np.cos(turn), np.sin(turn)])
        x, y = to_frame(nose, scene.states[0, nearest, -1])
        assert bool(picture[576 - round(x / 0.1), 240 - round(y / 0.1)]) == shown
