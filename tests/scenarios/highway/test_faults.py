"""Faults of highway-env 1.12.1: each is shown in highway-env first, then its absence here."""

import copy
import json
import subprocess
import sys
from typing import Any

import numpy as np
import pytest
from highway_env.envs import ContinuousIntersectionEnv, IntersectionEnv, RoundaboutEnv
from highway_env.vehicle.dynamics import BicycleVehicle
from highway_env.vehicle.kinematics import Vehicle

from asp_env.errors import AspEnvError
from scenarios.highway.sites import SITES, populated_road
from tests.envs.same import same
from tests.highway_folders import SITE_NAMES, highway_data, highway_recordings
from tests.scenarios.highway.environments import ego, make

COAST = np.zeros(2, dtype=np.float32)

every_site = pytest.mark.parametrize("site", SITE_NAMES)


def test_an_intersection_does_not_change_a_roundabout():
    """(a) highway-env's intersection writes parameters into the class of all vehicles.

    At its roundabout gaps of 5 m then become 2 m. The intersection here has its own class.
    """
    done = subprocess.run(
        [
            *(sys.executable, "-m", "tests.scenarios.highway.class_fault"),
            highway_data("intersection"),
        ],
        capture_output=True,
        text=True,
        check=True,
    )
    before, after_ours, after_theirs = json.loads(done.stdout)
    assert before[0] == [10.0, 3.0, -5.0]
    assert after_theirs[0] == [7.0, 6.0, -3.0]
    assert after_theirs[1] != before[1]
    assert after_ours == before
    assert after_theirs[2] == before[2], "not even by highway-env's own"


@every_site
def test_the_same_seed_gives_the_same_info(site):
    """(b) In highway-env `info["action"]` at reset is drawn from a space without a seed."""
    reference = RoundaboutEnv()
    assert len({reference.reset(seed=1)[1]["action"] for _ in range(40)}) > 1
    env = make(highway_data(site))
    expected = env.reset(seed=1)
    for _ in range(3):
        same(env.reset(seed=1), expected)
    same(make(highway_data(site)).reset(seed=1), expected)


@every_site
def test_spaces_stay_the_same_objects(site):
    """(c) highway-env replaces both spaces in each reset."""
    for env, stays in ((RoundaboutEnv(), False), (make(highway_data(site)), True)):
        action_space, observation_space = env.action_space, env.observation_space
        env.reset(seed=0)
        assert (env.action_space is action_space) == stays
        assert (env.observation_space is observation_space) == stays


def _reference_alone(speed_mps: float, **config: Any) -> tuple[Any, Vehicle]:
    """A single vehicle that drives straight ahead on highway-env's empty roundabout."""
    env = RoundaboutEnv(config=config)
    vehicle = Vehicle(env.road, [0.0, -200.0], heading=0.0, speed=speed_mps)
    env.road.vehicles = env.controlled_vehicles = [vehicle]
    return env, vehicle


def test_time_and_motion_agree():
    """(d) At 25 and 10 Hz highway-env moves vehicles by 0.08 s and counts 0.1 s.

    Here a vehicle at constant speed moves by 0.2 s times its speed in a step of 0.2 s, and by 0.6 s
    times its speed in one of 0.6 s.
    """
    reference, vehicle = _reference_alone(10.0, simulation_frequency=25, policy_frequency=10)
    reference.step(None)
    assert reference.time == pytest.approx(0.1)
    assert vehicle.position[0] == pytest.approx(0.8)
    for dt_s in (0.2, 0.6):
        env = make(highway_data("intersection"), dt_s=dt_s)
        env.reset(options={"scenario": 4})
        for _ in range(4):
            before = ego(env)
            env.step(COAST)
            moved = ego(env) - before
            assert before[3] > 5.0
            assert np.hypot(moved[0], moved[1]) == pytest.approx(dt_s * before[3], abs=1e-4)
            assert moved[3] == 0.0


@pytest.mark.parametrize("dt_s", [1 / 15, 1 / 3])
def test_other_time_steps_are_refused(dt_s):
    """(d) The error has one line with the valid steps; these are whole frames, but not of 0.2 s."""
    with pytest.raises(AspEnvError, match=r"^time step 0\.[^\n]* choose a multiple of that$"):
        make(highway_data("roundabout"), dt_s=dt_s)


def _copies(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The names of the classes of all objects that are copied from now on."""
    copied, deepcopy = [], copy.deepcopy

    def count(value: Any, *given: Any) -> Any:
        copied.append(type(value).__name__)
        return deepcopy(value, *given)

    monkeypatch.setattr(copy, "deepcopy", count)
    return copied


@every_site
def test_nothing_is_copied_in_a_step(site, monkeypatch):
    """(e) highway-env copies the road with all vehicles to predict a controlled vehicle."""
    reference: Any = IntersectionEnv(config={"action": {"type": "ContinuousAction"}})
    own = make(highway_data(site))
    own.reset(seed=0)
    copied = _copies(monkeypatch)
    reference.step(COAST)
    assert "Vehicle" in copied
    copied.clear()
    for _ in range(10):
        own.step(COAST)
    assert copied == []


def test_the_roundabout_takes_continuous_actions():
    """(f) highway-env's reward compares an array with two numbers."""
    with pytest.raises(ValueError, match="truth value of an array"):
        RoundaboutEnv(config={"action": {"type": "ContinuousAction"}})
    own = make(highway_data("roundabout"))
    own.reset(seed=0)
    _, reward, *_ = own.step(COAST)
    assert np.isfinite(reward)


@every_site
def test_no_vehicle_is_a_dynamical_bicycle(site):
    """(g) The ego of highway-env's newer intersection has another model than the other vehicles."""
    assert isinstance(ContinuousIntersectionEnv().vehicle, BicycleVehicle)
    road = populated_road(SITES[site], np.random.default_rng(0))
    assert len(road.vehicles) > 3
    assert {type(each) for each in road.vehicles} == {SITES[site].vehicle}
    assert not issubclass(SITES[site].vehicle, BicycleVehicle)


def test_vehicles_leave_the_roundabout():
    """(h) highway-env's vehicles continue beyond the end of the road, 170 m from the centre."""
    reference = RoundaboutEnv()
    reference.reset(seed=1)
    for _ in range(25):
        reference.step(1)
    assert len(reference.road.vehicles) == 5
    assert max(np.abs(each.position).max() for each in reference.road.vehicles) > 180.0
    for recording in highway_recordings("roundabout"):
        assert np.abs(recording.states[:, :2]).max() < 170.0
        assert (recording.last_frames < recording.num_frames - 1).any()


@every_site
def test_braking_ends_at_standstill(site):
    """(h) highway-env's plain vehicle reverses: at 6 m/s after 2 s of -4 m/s²."""
    _, vehicle = _reference_alone(2.0)
    vehicle.act({"acceleration": -4.0, "steering": 0.0})
    for _ in range(30):
        vehicle.step(1 / 15)
    assert vehicle.speed == pytest.approx(-6.0)
    env = make(highway_data(site))
    env.reset(options={"scenario": 4})
    for _ in range(16):
        env.step(np.array([-1.0, 0.0]))
        assert ego(env)[3] >= 0.0
    halted = ego(env)
    assert halted[3] == 0.0
    for _ in range(3):
        env.step(np.array([-1.0, 0.5]))
    assert np.array_equal(ego(env), halted)
