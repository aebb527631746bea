"""`asp_env.parallel_env`: every vehicle an agent, each with the world from its own view."""

import copy
import math
import pickle
import warnings
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest

import asp_env
from asp_env.data.classes import AgentClass
from asp_env.envs.parallel import ParallelReplayEnv
from asp_env.envs.replay import ReplayEnv
from tests.builders import Drive
from tests.crossing_files import write_crossing
from tests.envs.same import same, same_alone
from tests.real_data import real_data

with warnings.catch_warnings():  # PettingZoo's tests import its games by a way it calls old
    warnings.simplefilter("ignore")
    from pettingzoo.test import parallel_api_test, parallel_seed_test

PARTS = ("raster", "vectors", "actions", "state", "route")


def _make(data: str, **options: Any) -> ParallelReplayEnv:
    return asp_env.parallel_env(
        data, **{"observations": ("state", "actions", "route"), "raster_px": (45, 30), **options}
    )


def _coast(env: ParallelReplayEnv) -> dict[str, np.ndarray]:
    return {agent: np.zeros(2) for agent in env.agents}


def _wild(env: ParallelReplayEnv, rng: np.random.Generator) -> dict[str, np.ndarray]:
    return {agent: rng.uniform((-0.2, -0.1), (0.6, 0.1)) for agent in env.agents}


@pytest.fixture(scope="module")
def queue(tmp_path_factory: pytest.TempPathFactory) -> str:
    """DATA: A drives at 8 m/s behind B at 4 m/s, 18 m from centre to centre after 3 s."""
    drives = (
        Drive(kind=AgentClass.CAR, start=(-90.0, -1.75, 0.0, 8.0)),
        Drive(kind=AgentClass.CAR, start=(-60.0, -1.75, 0.0, 4.0)),
    )
    folder: Path = tmp_path_factory.mktemp("queue")
    return str(write_crossing(folder, drives=(drives,)))


@pytest.mark.parametrize(
    "options",
    [{"observations": PARTS}, {"traffic": "idm", "classes": ("car", "van"), "max_agents": 3}],
    ids=("log", "idm"),
)
def test_passes_the_tests_of_pettingzoo_without_a_warning(crossing, options):
    """To the end of episodes, which last 75 ticks at most; warnings are errors here."""
    parallel_api_test(_make(crossing, **options), num_cycles=80)
    parallel_seed_test(lambda: _make(crossing, **options), num_cycles=5)


@pytest.mark.data
def test_passes_the_test_of_pettingzoo_on_real_traffic():
    """Karlsruhe, where people wait, cross and park."""
    parallel_api_test(_make(str(real_data("karlsruhe")), traffic="idm"), num_cycles=80)


@pytest.mark.parametrize("traffic", ["log", "idm"])
def test_a_lone_agent_is_the_ego_of_the_single_environment(crossing, traffic):
    """With one agent everything that is returned is the same, bit for bit."""
    options: dict[str, Any] = {
        "observations": PARTS, "raster_px": (45, 30), "traffic": traffic
    }  # fmt: skip
    one, other = _make(crossing, max_agents=1, **options), ReplayEnv(crossing, **options)
    for seed in range(4):
        same_alone(one, other, seed)


def test_each_agent_sees_what_it_would_see_as_the_ego(crossing):
    """At the start, against the single environment with that vehicle as its ego from that tick."""
    env = _make(crossing, observations=PARTS)
    single = ReplayEnv(crossing, observations=PARTS, raster_px=(45, 30))
    compared = 0
    for scenario in range(len(env.scenarios)):
        seen, infos = env.reset(options={"scenario": scenario})
        for agent in env.agents:
            start = {
                "scenario": scenario,
                "ego": int(infos[agent]["scenario"].split("-")[1]),
                "start_tick": env.scenarios[scenario].start_tick,
            }
            expected, _ = single.reset(options=start)
            known = seen[agent].copy()
            if env.scenarios[scenario].length < 75:  # then the goal may lie nearer
                known["state"] = expected["state"]
            same(known, expected)
            compared += 1
    assert compared > 2 * len(env.scenarios)


@pytest.mark.parametrize("traffic", ["log", "log-actions", "idm"])
def test_all_agents_live_in_one_world(crossing, traffic):
    """Whoever looks, everybody is in the same place at every tick; crashed ones are gone."""
    env = _make(crossing, traffic=traffic)
    gone = 0
    for scenario in range(len(env.scenarios)):
        env.reset(options={"scenario": scenario})
        rng = np.random.default_rng(scenario)
        while env.agents:
            before = set(env.agents)
            env.step(_wild(env, rng))
            gone += len(before - set(env.agents))
            worlds = [_states(env, agent) for agent in env.agents]
            for world in worlds[1:]:
                same(world, worlds[0])
    assert gone > 2 * len(env.scenarios)


def _states(env: ParallelReplayEnv, agent: str) -> dict[int, list[float]]:
    """Everybody who is there now, by track id."""
    scene = env.scene(agent)
    slots = np.flatnonzero(scene.valid[0, :, -1])
    return {int(scene.ids[0, a]): scene.states[0, a, -1].tolist() for a in slots}


def test_a_crash_by_hand(queue):
    """A gains 0.8 m a tick on B; of 13.5 m between bumpers none is left at tick 17.

    A answers for it, is terminated and gone one tick later. B drives on.
    """
    env = _make(queue)
    env.reset(options={"scenario": 0})
    assert env.agents == ["vehicle_0", "vehicle_1"]
    rewards: dict[str, float] = {}
    infos: dict[str, dict[str, Any]] = {}
    for tick in range(1, 18):
        _, rewards, terminated, truncated, infos = env.step(_coast(env))
        assert not any(truncated.values())
        assert terminated == {"vehicle_0": tick == 17, "vehicle_1": False}
    assert infos["vehicle_0"]["ending"] == "COLLISION"
    assert rewards["vehicle_0"] == pytest.approx(1.6 / 120 - 1, abs=1e-3)
    assert (infos["vehicle_1"]["collision"], infos["vehicle_1"]["at_fault"]) == (True, False)
    assert env.agents == ["vehicle_1"]
    _, _, _, _, infos = env.step(_coast(env))
    assert not infos["vehicle_1"]["collision"]
    assert list(_states(env, "vehicle_1")) == [2]


def test_who_stands_all_the_while_is_traffic(tmp_path):
    """C stops at 2 s for good, before the scenario of A begins at 3 s."""
    drives = (
        Drive(kind=AgentClass.CAR, start=(-90.0, -1.75, 0.0, 8.0)),
        Drive(kind=AgentClass.CAR, start=(30.0, 1.75, math.pi, 4.0), phases=((2.0, -2.0, 0.0),)),
    )
    env = _make(str(write_crossing(tmp_path, drives=(drives,))))
    env.reset(options={"scenario": 0})
    assert env.agents == ["vehicle_0"]
    assert list(_states(env, "vehicle_0")) == [1, 2]


def test_actions_move_the_agent_that_they_are_for(queue):
    """B speeds up by 5 m/s² for a second, from 4 to 9 m/s; A brakes as hard, from 8 to 3 m/s."""
    env = _make(queue)
    env.reset(options={"scenario": 0})
    given = {"vehicle_1": np.array([1.0, 0.0]), "vehicle_0": np.array([-1.0, 0.0])}
    for _ in range(4):
        env.step(given)
    seen, *_ = env.step(given)
    assert seen["vehicle_0"]["state"][0] == pytest.approx(3.0, abs=1e-3)
    assert seen["vehicle_1"]["state"][0] == pytest.approx(9.0, abs=1e-3)
    state = env.state()
    np.testing.assert_allclose(state[:, 3], [3.0, 9.0], atol=1e-3)
    # 5 m/s² over a second: 5.5 m of 8 m for A and 6.5 m for B, in steps of 0.2 s to the mean speed
    np.testing.assert_allclose(state[:, 0], [-66 + 5.5, -48 + 6.5], atol=0.01)
    np.testing.assert_allclose(state[:, 1:3], [[-1.75, 0]] * 2, atol=1e-3)
    np.testing.assert_array_equal(state[:, 6], [1, 1])


def test_an_agent_leaves_when_its_track_ends(crossing):
    """From 8 s on, the motorcycle's track lasts 30 ticks more, to 14 s; the others go on."""
    env = _make(crossing)
    env.reset(options={"scenario": 0, "start_tick": 40})
    kinds = {agent: int(env.scene(agent).classes[0, 0]) for agent in env.agents}
    rider = next(agent for agent, kind in kinds.items() if kind == AgentClass.MOTORCYCLE)
    assert rider != "vehicle_0"
    brakes = np.array([-1.0, 0.0])
    for _ in range(29):
        env.step(dict.fromkeys(env.agents, brakes))
    _, _, terminated, truncated, infos = env.step(dict.fromkeys(env.agents, brakes))
    assert (terminated[rider], truncated[rider]) == (False, True)
    assert infos[rider]["ending"] == "OUT_OF_DATA"
    assert rider not in env.agents
    assert env.agents


def test_who_may_be_an_agent(crossing):
    """Classes, ids and a number; the scenario's own vehicle always comes first."""
    everybody = _make(crossing)
    for classes, kinds in ((("car",), {0}), (("truck", "van"), {1, 2})):
        env = _make(crossing, classes=classes)
        for scenario in range(len(env.scenarios)):
            env.reset(options={"scenario": scenario})
            assert {int(env.scene(agent).classes[0, 0]) for agent in env.agents} <= kinds
            assert env.scene("vehicle_0").ids[0, 0] == env.scenarios[scenario].ego_id
        assert 0 < len(env.scenarios) < len(everybody.scenarios)
    few = _make(crossing, ids=(1, 3))
    assert {scenario.ego_id for scenario in few.scenarios} == {1, 3}
    pair = _make(crossing, max_agents=2)
    assert pair.possible_agents == ["vehicle_0", "vehicle_1"]
    for scenario in range(len(pair.scenarios)):
        pair.reset(options={"scenario": scenario})
        everybody.reset(options={"scenario": scenario})
        ego, *others = (everybody.scene(agent).states[0, 0, -1, :2] for agent in everybody.agents)
        away = [math.dist(ego, other) for other in others]
        if "vehicle_1" in pair.agents:
            second = pair.scene("vehicle_1").states[0, 0, -1, :2]
            assert math.dist(ego, second) == min(away)


def test_copies_and_pickles_go_on_in_the_same_way(crossing):
    """From the middle of an episode on, through the next reset."""
    env = _make(crossing, traffic="idm")
    env.reset(seed=4, options={"scenario": 1})
    for _ in range(3):
        env.step(_coast(env))
    for twin in (copy.deepcopy(env), pickle.loads(pickle.dumps(env))):
        original = copy.deepcopy(env)
        for _ in range(5):
            same(original.step(_coast(original)), twin.step(_coast(twin)))
        same(original.reset(), twin.reset())


def test_renders_the_whole_place(crossing):
    """uint8 RGB, the same for the same state, as long as anybody asks; else nothing."""
    env = _make(crossing, render_mode="rgb_array")
    env.reset(seed=0)
    picture = env.render()
    assert picture.dtype == np.uint8
    assert picture.shape[2] == 3
    assert len(np.unique(picture.reshape(-1, 3), axis=0)) > 3
    assert np.array_equal(picture, env.render())
    env.close()
    env.close()
    assert _make(crossing).render() is None


def test_refuses_in_one_line(crossing):
    """What was given, what was expected."""
    for options, message in (
        ({"classes": ("kite",)}, "unknown class of agents 'kite'.*known are bus, car"),
        ({"classes": "car"}, "classes 'car': expected a sequence"),
        ({"ids": ()}, r"ids \(\): expected a sequence"),
        ({"ids": (99,)}, "no scenario's vehicle is of the given classes and ids"),
        ({"max_agents": 0}, "max_agents 0: expected at least 1"),
        ({"render_mode": "ansi"}, "render mode 'ansi'"),
        ({"colour": 1}, "unknown argument 'colour'"),
    ):
        with pytest.raises(asp_env.AspEnvError, match=message):
            _make(crossing, **options)
    env = _make(crossing)
    with pytest.raises(gymnasium.error.ResetNeeded):
        env.step({})
    with pytest.raises(gymnasium.error.ResetNeeded):
        env.scene("vehicle_0")
    env.reset(seed=0)
    with pytest.raises(asp_env.AspEnvError, match="no action for vehicle_0"):
        env.step({})
    with pytest.raises(asp_env.AspEnvError, match="unknown agent 'vehicle_99'"):
        env.scene("vehicle_99")
    with pytest.raises(asp_env.AspEnvError, match="expected two finite numbers"):
        env.step(_coast(env) | {"vehicle_0": np.array([np.nan, 0.0])})
