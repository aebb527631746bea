"""Controlled and uncontrolled agents, arrivals and departures."""

import numpy as np
import pytest
from highway_env.vehicle.kinematics import Vehicle

from asp_env.data.scenarios.scenario import Scenario
from asp_env.dynamics.bicycle import AXLE_SHARE_OF_LENGTH
from asp_env.errors import AspEnvError
from asp_env.geometry import wrap_angle
from asp_env.sim.simulation import Simulation
from asp_env.sim.world import ReplayWorld, World, world_class
from scenarios.highway.sites import SITES, empty_road, network
from scenarios.highway.world import APART_M, HighwayWorld
from tests.envs.same import same
from tests.highway_folders import (
    SITE_NAMES,
    highway_data,
    highway_recordings,
    highway_scenarios,
)
from tests.scenarios.highway.elsewhere import drive as drive_some
from tests.scenarios.highway.environments import make
from tests.sim.worlds import DT_S, HISTORY, drive, now, replay, scenario, simulate

every_site = pytest.mark.parametrize("site", SITE_NAMES)

FOLLOWED = scenario(11, start=55, length=40)
"""An ego at 6.7 m/s on the western arm, and 13 at 8.2 m/s 21 m behind it."""


def begin(site: str, scenarios: list[Scenario] | Scenario, traffic: str = "own") -> Simulation:
    """Starts episodes."""
    return simulate(highway_recordings(site), scenarios, traffic, world_class("highway:"))


def step(world: HighwayWorld | ReplayWorld, driven: np.ndarray, tick: int) -> None:
    """Steps one tick in which some agents execute actions."""
    shape = (*driven.shape, 2)
    actions = np.random.default_rng(tick).uniform((-3.0, -0.2), (3.0, 0.2), shape)
    world.step(actions.astype(np.float32), driven)


@every_site
def test_controlled_agents_move_as_in_a_replay(site):
    """The bits are equal from equal states, for all agents, in collisions and off the road."""
    scenarios = list(highway_scenarios(site))[::16]
    count, recordings = len(scenarios), highway_recordings(site)
    worlds = [
        kind(recordings, num_episodes=count, dt_s=DT_S, history=HISTORY)
        for kind in (HighwayWorld, ReplayWorld)
    ]
    for world in worlds:
        world.reset(scenarios, [np.random.default_rng(0)] * count)
    reacting, replaying = worlds
    replaying.episodes.states[:] = reacting.episodes.states
    driven = reacting.episodes.valid[:, HISTORY]
    for tick in range(15):
        step(reacting, driven, tick)
        step(replaying, driven, tick)
    states, valid = reacting.episodes.states, reacting.episodes.valid
    for b in range(count):
        reference = states[b, :, driven[b]], valid[b, :, driven[b]]
        others = (
            replaying.episodes.states[b, :, driven[b]],
            replaying.episodes.valid[b, :, driven[b]],
        )
        assert [each.tobytes() for each in reference] == [each.tobytes() for each in others]
    assert driven.sum() >= 10


@every_site
def test_released_agents_continue_on_their_own(site):
    """Egos are controlled in two ticks of three, then released: all states stay finite."""
    scenarios = list(highway_scenarios(site))[2::12]
    simulation = begin(site, scenarios)
    for tick in range(14):
        drive_some(simulation, tick)
    replay(simulation, 20)
    episodes = simulation.world.episodes
    assert np.isfinite(episodes.states).all()
    there = episodes.valid[np.arange(len(scenarios)), simulation.world.now, 0]
    assert there.all(), "egos stay"


def test_a_released_agent_returns_to_its_lane():
    """After a shift of 1.5 m to the left, the ego is within 0.2 m of its lane about 4 s later."""
    simulation = begin("intersection", FOLLOWED)
    lane = network("intersection").get_lane(("o1", "ir1", 0))
    drive(simulation, [(0.0, 0.25)] * 3 + [(0.0, -0.25)] * 3)
    aside = _aside(simulation, lane)
    assert 1.0 < abs(aside) < 2.0
    replay(simulation, 20)
    assert abs(_aside(simulation, lane)) < 0.2
    state = simulation.world.ego_states()[0]
    assert float(wrap_angle(state[2])) == pytest.approx(0.0, abs=0.05)
    assert state[3] > 4.0


def _aside(simulation: Simulation, lane) -> float:
    return lane.local_coordinates(simulation.world.ego_states()[0, :2] * [1, -1])[1]


def test_a_released_agent_plans_a_route_from_its_position():
    """Driven straight across the junction instead of left, it stays on the eastern arm.

    The same holds after a snapshot that was taken before the release.
    """
    simulation = begin("intersection", scenario(19, start=115, length=60))
    drive(simulation, [(1.0, 0.0)] * 35)
    world = simulation.world
    assert isinstance(world, HighwayWorld)
    taken, observed = world.snapshot(), []
    for _ in range(2):
        run = world._runs[0]
        assert run is not None
        ego = next(each for each in run.road.vehicles if each.track == 19)
        assert ego.steered
        assert ("ir1", "il2", None) in ego.route
        replay(simulation, 1)
        assert not ego.steered
        assert ego.route[0][:2] == ("il3", "o3")
        assert ego.target_lane_index == ("il3", "o3", 0)
        replay(simulation, 5)
        observed.append(world.episodes.states.tobytes())
        assert world.ego_states()[0, 1] == pytest.approx(-2.0, abs=0.5)
        world.restore(taken)
    assert observed[0] == observed[1]


def test_other_vehicles_react_to_a_controlled_ego():
    """The ego stops on its lane and its follower stops behind it. Without control neither stops."""
    alone, driven = (begin("intersection", FOLLOWED) for _ in range(2))
    replay(alone, 25)
    drive(driven, [(-5.0, 0.0)] * 25)
    undisturbed, follower = now(alone, 13), now(driven, 13)
    assert undisturbed is not None
    assert follower is not None
    assert undisturbed[3] > 5.0
    assert follower[3] < 1.0
    halted = driven.world.ego_states()[0]
    assert halted[3] == 0.0
    assert 5.0 < halted[0] - follower[0] < 20.0
    assert not driven.world.events().collision.any()


def test_a_predictor_controls_its_agents():
    """Vehicle 13 continues at its speed and heading until it hits the ego."""
    simulation = begin("intersection", FOLLOWED, "default=own,13=predictor:constant-velocity")
    first = now(simulation, 13)
    assert first is not None
    drive(simulation, [(-5.0, 0.0)] * 15)
    last = now(simulation, 13)
    assert last is not None
    assert last[2:] == pytest.approx(first[2:], abs=1e-3)
    assert last[0] - first[0] == pytest.approx(15 * DT_S * first[3], abs=0.05)
    assert simulation.world.events().collision.any()


def test_vehicles_do_not_appear_near_others_and_blocked_ones_never_appear():
    """Vehicle 20 appears on the southern arm at tick 120 and stops: 23, 26 and 29 never appear.

    Without control they appear behind it at ticks 140, 160 and 180.
    """
    long = scenario(13, start=115, length=75, recording=1)
    left_alone, disturbed = (begin("intersection", long).world for _ in range(2))
    ids = left_alone.episodes.ids[0]
    blocker = ids == 20
    for world in (left_alone, disturbed):
        for tick in range(75):
            driven = (blocker & (world is disturbed) & (tick > 5))[None]
            world.step(np.full((*driven.shape, 2), (-5.0, 0.0), dtype=np.float32), driven)
    came, kept_away = (each.episodes.valid[0].any(axis=0) for each in (left_alone, disturbed))
    for number, tick in ((20, 120), (23, 140), (26, 160), (29, 180)):
        slot = int(np.flatnonzero(ids == number)[0])
        assert came[slot]
        first = int(np.argmax(left_alone.episodes.valid[0, :, slot]))
        assert first == tick - 115 + HISTORY
        assert kept_away[slot] == (number == 20)
    for world in (left_alone, disturbed):
        assert _nearest_comer(world) >= APART_M


def _nearest_comer(world: World) -> float:
    """Smallest distance between an agent that has just appeared and any other agent, m."""
    valid, states, nearest = world.episodes.valid[0], world.episodes.states[0], np.inf
    for tick in range(HISTORY + 1, len(valid)):
        for slot in np.flatnonzero(valid[tick] & ~valid[tick - 1]).tolist():
            others = valid[tick].copy()
            others[slot] = False
            away = states[tick, others, :2] - states[tick, slot, :2]
            nearest = min(nearest, float(np.hypot(*away.T).min()))
    assert np.isfinite(nearest), "an agent appears"
    return nearest


@pytest.mark.parametrize(
    ("site", "traffic"), [("intersection", "idm"), ("roundabout", "own"), ("roundabout", "idm")]
)
def test_departed_agents_never_return(site, traffic):
    """Each agent is present in one interval; the ego is present throughout."""
    scenarios = list(highway_scenarios(site))[2 :: 12 if site == "intersection" else 3]
    simulation = begin(site, scenarios, traffic)
    replay(simulation, 75)
    for b, each in enumerate(scenarios):
        there = simulation.world.episodes.valid[b, : HISTORY + 1 + each.length]
        edges = np.abs(np.diff(there.astype(int), axis=0)).sum(axis=0)
        assert (edges + there[0] + there[-1] <= 2).all()
        assert there[:, 0].all()


def test_leaving_agents_are_removed():
    """A present agent is removed from the road, and one that has not appeared yet never does."""
    world = begin("intersection", scenario(13, start=115, length=30, recording=1)).world
    assert isinstance(world, HighwayWorld)
    ids = world.episodes.ids
    uncontrolled = np.zeros(ids.shape, dtype=bool)
    nothing = np.zeros((*ids.shape, 2), dtype=np.float32)
    leaving = np.isin(ids, (14, 20))
    world.step(nothing, uncontrolled, leaving)
    for _ in range(20):
        world.step(nothing, uncontrolled)
    there = world.episodes.valid[0]
    slots = [int(np.flatnonzero(ids[0] == number)[0]) for number in (14, 20)]
    assert there[HISTORY, slots[0]]
    assert not there[HISTORY + 1 :, slots].any()
    run = world._runs[0]
    assert run is not None
    assert not {each.track for each in run.road.vehicles} & {14, 20}


class Short(Vehicle):
    """highway-env's plain vehicle with the axles of the bicycle model of this package."""

    LENGTH = 2 * AXLE_SHARE_OF_LENGTH * Vehicle.LENGTH


@pytest.mark.parametrize("steering_rad", [0.0, 0.2, -0.5])
def test_right_of_way_predicts_controlled_vehicles_along_their_curve(steering_rad):
    """The predicted poses every 0.25 s are those of highway-env's plain vehicle."""
    site = SITES["intersection"]
    road, times = empty_road(site), np.arange(0.25, 3.0, 0.25)
    given = (road, [-50.0, 2.0], 0.1, 7.0)
    reference, own = Short(*given), site.vehicle(*given)
    reference.act({"acceleration": 1.0, "steering": steering_rad})
    own.steer(1.0, steering_rad, [])
    places, headings = reference.predict_trajectory_constant_speed(times)
    found, turned = own.predict_trajectory_constant_speed(times)
    assert np.array(found) == pytest.approx(np.array(places), abs=1e-9)
    assert wrap_angle(np.array(turned) - headings) == pytest.approx(0.0, abs=1e-9)
    assert own.predict_trajectory_constant_speed(times)[0] is found
    road.steps += 1
    assert own.predict_trajectory_constant_speed(times)[0] is not found


def test_agents_without_a_driver_are_left_to_the_world():
    """In this world a table without a default has the default `own`, not `log`."""
    env = make(highway_data("intersection"), traffic="13=policy")
    env.reset(options={"scenario": 11})
    twin = make(highway_data("intersection"), traffic="default=own,13=policy")
    twin.reset(options={"scenario": 11})
    for _ in range(5):
        same(env.step(np.zeros(2)), twin.step(np.zeros(2)))
    with pytest.raises(AspEnvError, match="this world replays no tracks"):
        make(highway_data("intersection"), traffic="log").reset(seed=0)
