"""`asp_env.parallel_env`: many vehicles are agents, each with its own view of one world."""

import copy
import math
import pickle
import warnings
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.spaces import Dict, flatten, flatten_space

import asp_env
from asp_env.data.classes import AgentClass
from asp_env.envs.parallel import ParallelReplayEnv
from asp_env.envs.replay import ReplayEnv
from tests.builders import Drive
from tests.crossing_files import write_crossing
from tests.envs.same import same, same_alone
from tests.real_data import real_data

with warnings.catch_warnings():  # PettingZoo's tests import its games in a deprecated way
    warnings.simplefilter("ignore")
    from pettingzoo.test import api_test, parallel_api_test, parallel_seed_test
    from pettingzoo.utils import parallel_to_aec

COMPONENTS = ("raster", "vectors", "actions", "state", "route")


def _make(data: str, **options: Any) -> ParallelReplayEnv:
    return asp_env.parallel_env(
        data, **{"observations": ("state", "actions", "route"), "raster_px": (45, 30), **options}
    )


def _zero_actions(env: ParallelReplayEnv) -> dict[str, np.ndarray]:
    return {agent: np.zeros(2) for agent in env.agents}


def _random_actions(env: ParallelReplayEnv, rng: np.random.Generator) -> dict[str, np.ndarray]:
    return {agent: rng.uniform((-0.2, -0.1), (0.6, 0.1)) for agent in env.agents}


@pytest.fixture(scope="module")
def queue(tmp_path_factory: pytest.TempPathFactory) -> str:
    """A folder: A at 8 m/s behind B at 4 m/s, 18 m from centre to centre after 3 s."""
    drives = (
        Drive(kind=AgentClass.CAR, start=(-90.0, -1.75, 0.0, 8.0)),
        Drive(kind=AgentClass.CAR, start=(-60.0, -1.75, 0.0, 4.0)),
    )
    folder: Path = tmp_path_factory.mktemp("queue")
    return str(write_crossing(folder, drives=(drives,)))


@pytest.mark.parametrize(
    "options",
    [{"observations": COMPONENTS}, {"traffic": "idm", "classes": ("car", "van"), "max_agents": 3}],
    ids=("log", "idm"),
)
def test_pettingzoo_tests_pass(crossing, options):
    """To the end of episodes, which last at most 75 ticks; other warnings are errors."""
    parallel_api_test(_make(crossing, **options), num_cycles=80)
    parallel_seed_test(lambda: _make(crossing, **options), num_cycles=5)


@pytest.mark.parametrize("options", [{}, {"flatten": True}], ids=("dict", "flat"))
def test_pettingzoo_tests_pass_without_warnings_with_padding(crossing, options):
    parallel_api_test(_make(crossing, pad_absent=True, **options), num_cycles=80)
    parallel_seed_test(lambda: _make(crossing, pad_absent=True, **options), num_cycles=5)


@pytest.mark.filterwarnings("ignore:Observation numpy array is all zeros")
@pytest.mark.parametrize("pad_absent", [False, True])
def test_the_conversion_to_agents_in_turn_passes(crossing, pad_absent):
    """PettingZoo's `parallel_to_aec` and its own test of the result."""
    env = parallel_to_aec(_make(crossing, pad_absent=pad_absent, flatten=True))
    api_test(env, num_cycles=100)


def test_possible_agents_never_change(crossing):
    """Over all scenarios, whose numbers of agents differ; those present come first."""
    env, padded = _make(crossing), _make(crossing, pad_absent=True)
    possible = list(env.possible_agents)
    counts = set()
    for scenario in range(len(env.scenarios)):
        env.reset(options={"scenario": scenario})
        padded.reset(options={"scenario": scenario})
        assert env.possible_agents == padded.possible_agents == possible
        assert env.agents == padded.agents == possible
        assert env.present_agents == possible[: len(env.present_agents)]
        counts.add(len(env.present_agents))
    assert len(counts) > 1
    assert max(counts) <= len(possible)


def _num_present(env: ParallelReplayEnv, scenario: int) -> int:
    env.reset(options={"scenario": scenario})
    return len(env.present_agents)


@pytest.mark.parametrize("flatten", [False, True, "parts"])
def test_agents_that_the_scenario_does_not_have_end_in_the_first_step(crossing, flatten):
    """With zeros, the reward 0 and infos with the keys of others, whatever their actions are."""
    env = _make(crossing, flatten=flatten)
    fewest = min(range(len(env.scenarios)), key=lambda number: _num_present(env, number))
    first = env.reset(options={"scenario": fewest})
    absent = [agent for agent in env.agents if agent not in env.present_agents]
    assert absent
    assert env.agents == env.possible_agents
    seen, rewards, terminated, truncated, infos = env.step(dict.fromkeys(env.agents, np.ones(2)))
    for observations, about in (first, (seen, infos)):
        assert list(observations) == list(about) == env.possible_agents
        for agent in absent:
            observation = observations[agent]
            assert env.observation_space(agent).contains(observation)
            parts = observation.values() if isinstance(observation, dict) else [observation]
            assert not any(np.any(part) for part in parts)
            assert about[agent].keys() == about["vehicle_0"].keys()
    for agent in absent:
        assert (rewards[agent], terminated[agent], truncated[agent]) == (0.0, True, False)
    assert env.agents == env.present_agents
    assert not set(absent) & set(env.step(_zero_actions(env))[0])


def test_a_step_without_actions_after_the_end_returns_five_empty_dicts(queue):
    """Any number of times; actions after the end are an error."""
    for pad_absent in (False, True):
        env = _make(queue, pad_absent=pad_absent)
        env.reset(seed=0)
        while env.agents:
            env.step(_zero_actions(env))
        assert env.step({}) == env.step({}) == ({}, {}, {}, {}, {})
        with pytest.raises(gymnasium.error.ResetNeeded):
            env.step({"vehicle_0": np.zeros(2)})
        env.reset()
        assert env.agents


def test_absent_agents_are_padded(queue):
    """A collides with B at its own fault at tick 17, its last tick; B alone lasts to the end.

    From tick 18 on, A's observation is zero with the mask 0, and its reward is 0. It stays in
    `agents` and ends in the tick in which B ends, with B's flags.
    """
    env, plain = _make(queue, pad_absent=True), _make(queue)
    one, _ = env.reset(options={"scenario": 0})
    other, _ = plain.reset(options={"scenario": 0})
    assert list(one["vehicle_0"]) == [*other["vehicle_0"], "present"]
    tick = 0
    while plain.agents:
        tick += 1
        padded, unpadded = env.step(_zero_actions(env)), plain.step(_zero_actions(plain))
        _check_padding(padded, unpadded)
        _, rewards, terminated, truncated, infos = padded
        assert infos["vehicle_0"]["present"] is (tick <= 17)
        assert infos["vehicle_1"]["present"] is True
        assert (rewards["vehicle_0"] != 0.0) is (tick <= 17)
        assert (infos["vehicle_0"]["ending"] == "COLLISION") is (tick == 17)
        assert set(infos["vehicle_0"]) == set(infos["vehicle_1"])
        assert env.agents == (["vehicle_0", "vehicle_1"] if plain.agents else [])
        flags = {(terminated[agent], truncated[agent]) for agent in ("vehicle_0", "vehicle_1")}
        assert len(flags) == 1
        assert any(flags.pop()) is not bool(plain.agents)
    assert tick > 17


def _check_padding(padded: Any, unpadded: Any) -> None:
    """Present agents have the same values, absent ones zeros."""
    for agent, seen in padded[0].items():
        present = agent in unpadded[0]
        assert seen["present"].tolist() == [int(present)]
        for name, value in seen.items():
            if present and name != "present":
                same(value, unpadded[0][agent][name])
            elif not present:
                assert not value.any()
        assert padded[1][agent] == unpadded[1].get(agent, 0.0)


def test_agents_that_the_scenario_lacks_are_absent_from_the_start(crossing):
    """Within their space; their actions are ignored, and they have no scene."""
    env = _make(crossing, pad_absent=True)
    lacking = 0
    for scenario in range(len(env.scenarios)):
        seen, infos = env.reset(options={"scenario": scenario})
        for agent in env.possible_agents:
            assert seen[agent] in env.observation_space(agent)
            assert infos[agent]["present"] == bool(seen[agent]["present"][0])
        absent = [agent for agent in env.agents if not infos[agent]["present"]]
        lacking += len(absent)
        if absent:
            env.step({agent: np.zeros(2) for agent in env.agents if agent not in absent})
            assert not env.state()[[int(agent.split("_")[1]) for agent in absent]].any()
            with pytest.raises(asp_env.AspEnvError, match="is absent from this episode: expected"):
                env.scene(absent[-1])
    assert lacking > 0


def test_numeric_infos_are_numbers_with_the_same_keys(crossing):
    """In `reset` and in every step of an episode, of present and of absent agents."""
    env = _make(crossing, pad_absent=True, numeric_infos=True)
    _, infos = env.reset(seed=0)
    keys = list(infos["vehicle_0"])
    assert {"tick", "progress", "collision", "tags", "present"} <= set(keys)
    while env.agents:
        for info in infos.values():
            assert list(info) == keys
            assert all(np.asarray(value).dtype.kind in "bif" for value in info.values())
        *_, infos = env.step(_zero_actions(env))


@pytest.mark.parametrize("pad_absent", [False, True])
def test_flat_observations_are_those_of_gymnasium(crossing, pad_absent):
    """`gymnasium.spaces.flatten` of the Dict observation, bit for bit, and of its space."""
    options = {"observations": ("vectors", "state", "route"), "pad_absent": pad_absent}
    one, other = _make(crossing, **options), _make(crossing, flatten=True, **options)
    space = one.observation_space("vehicle_0")
    assert other.observation_space("vehicle_0") == flatten_space(space)
    parts = _make(crossing, flatten="parts", **options).observation_space("vehicle_0")
    assert isinstance(space, Dict)
    assert isinstance(parts, Dict)
    assert list(parts) == list(space)
    assert all(len(box.shape or ()) == 1 for box in parts.values())
    seen, flat = one.reset(seed=1)[0], other.reset(seed=1)[0]
    for _ in range(10):
        assert list(seen) == list(flat)
        for agent in seen:
            same(flatten(space, seen[agent]), flat[agent])
            assert flat[agent] in other.observation_space(agent)
        seen, flat = one.step(_zero_actions(one))[0], other.step(_zero_actions(other))[0]


@pytest.mark.data
def test_pettingzoo_test_passes_on_real_traffic():
    """Karlsruhe, with waiting, crossing and parked agents."""
    parallel_api_test(_make(str(real_data("karlsruhe")), traffic="idm"), num_cycles=80)


@pytest.mark.parametrize("traffic", ["log", "idm"])
def test_one_agent_equals_the_single_environment(crossing, traffic):
    options: dict[str, Any] = {
        "observations": COMPONENTS, "raster_px": (45, 30), "traffic": traffic
    }  # fmt: skip
    one, other = _make(crossing, max_agents=1, **options), ReplayEnv(crossing, **options)
    for seed in range(4):
        same_alone(one, other, seed)


def test_agents_observe_as_egos_of_the_single_environment(crossing):
    """At the start, with the same vehicle as ego and the same start tick."""
    env = _make(crossing, observations=COMPONENTS)
    single = ReplayEnv(crossing, observations=COMPONENTS, raster_px=(45, 30))
    compared = 0
    for scenario in range(len(env.scenarios)):
        seen, infos = env.reset(options={"scenario": scenario})
        for agent in env.present_agents:
            start = {
                "scenario": scenario,
                "ego": int(infos[agent]["scenario"].split("-")[1]),
                "start_tick": env.scenarios[scenario].start_tick,
            }
            expected, _ = single.reset(options=start)
            known = seen[agent].copy()
            if env.scenarios[scenario].length < 75:  # The goal may be nearer.
                known["state"] = expected["state"]
            same(known, expected)
            compared += 1
    assert compared > 2 * len(env.scenarios)


@pytest.mark.parametrize("traffic", ["log", "log-actions", "idm"])
def test_all_agents_share_one_world(crossing, traffic):
    """Every agent's scene has the same vehicles in the same states; agents that left are absent."""
    env = _make(crossing, traffic=traffic)
    gone = 0
    for scenario in range(len(env.scenarios)):
        env.reset(options={"scenario": scenario})
        rng = np.random.default_rng(scenario)
        while env.agents:
            before = set(env.agents)
            env.step(_random_actions(env, rng))
            gone += len(before - set(env.agents))
            worlds = [_states(env, agent) for agent in env.agents]
            for world in worlds[1:]:
                same(world, worlds[0])
    assert gone > 2 * len(env.scenarios)


def _states(env: ParallelReplayEnv, agent: str) -> dict[int, list[float]]:
    """States of the vehicles present now, by track id."""
    scene = env.scene(agent)
    slots = np.flatnonzero(scene.valid[0, :, -1])
    return {int(scene.ids[0, a]): scene.states[0, a, -1].tolist() for a in slots}


def test_a_rear_end_collision_ends_the_agent_at_fault(queue):
    """A gains 0.8 m per tick on B and closes the 13.5 m between the bumpers at tick 17.

    A is at fault, is terminated and disappears one tick later. B continues.
    """
    env = _make(queue)
    env.reset(options={"scenario": 0})
    assert env.agents == ["vehicle_0", "vehicle_1"]
    rewards: dict[str, float] = {}
    infos: dict[str, dict[str, Any]] = {}
    for tick in range(1, 18):
        _, rewards, terminated, truncated, infos = env.step(_zero_actions(env))
        assert not any(truncated.values())
        assert terminated == {"vehicle_0": tick == 17, "vehicle_1": False}
    assert infos["vehicle_0"]["ending"] == "COLLISION"
    assert rewards["vehicle_0"] == pytest.approx(1.6 / 120 - 1, abs=1e-3)
    assert (infos["vehicle_1"]["collision"], infos["vehicle_1"]["at_fault"]) == (True, False)
    assert env.agents == ["vehicle_1"]
    _, _, _, _, infos = env.step(_zero_actions(env))
    assert not infos["vehicle_1"]["collision"]
    assert list(_states(env, "vehicle_1")) == [2]


def test_standing_vehicles_are_traffic(tmp_path):
    """The second car stops at 2 s, before the scenario of the first one begins at 3 s."""
    drives = (
        Drive(kind=AgentClass.CAR, start=(-90.0, -1.75, 0.0, 8.0)),
        Drive(kind=AgentClass.CAR, start=(30.0, 1.75, math.pi, 4.0), phases=((2.0, -2.0, 0.0),)),
    )
    env = _make(str(write_crossing(tmp_path, drives=(drives,))))
    env.reset(options={"scenario": 0})
    assert env.present_agents == ["vehicle_0"]
    assert list(_states(env, "vehicle_0")) == [1, 2]


def test_actions_move_their_own_agent(queue):
    """In one second at 5 m/s², B accelerates from 4 to 9 m/s and A brakes from 8 to 3 m/s."""
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
    # The mean speeds are 5.5 m/s and 6.5 m/s.
    np.testing.assert_allclose(state[:, 0], [-66 + 5.5, -48 + 6.5], atol=0.01)
    np.testing.assert_allclose(state[:, 1:3], [[-1.75, 0]] * 2, atol=1e-3)
    np.testing.assert_array_equal(state[:, 6], [1, 1])


def test_the_end_of_an_agents_track_truncates_it(crossing):
    """The motorcycle's track ends 30 ticks after the start at 8 s; the other agents continue."""
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


def test_selection_of_agents(crossing):
    """By classes, ids and number; the ego of the scenario is always the first agent."""
    unrestricted = _make(crossing)
    for classes, kinds in ((("car",), {0}), (("truck", "van"), {1, 2})):
        env = _make(crossing, classes=classes)
        for scenario in range(len(env.scenarios)):
            env.reset(options={"scenario": scenario})
            assert {int(env.scene(agent).classes[0, 0]) for agent in env.present_agents} <= kinds
            assert env.scene("vehicle_0").ids[0, 0] == env.scenarios[scenario].ego_id
        assert 0 < len(env.scenarios) < len(unrestricted.scenarios)
    few = _make(crossing, ids=(1, 3))
    assert {scenario.ego_id for scenario in few.scenarios} == {1, 3}
    pair = _make(crossing, max_agents=2)
    assert pair.possible_agents == ["vehicle_0", "vehicle_1"]
    for scenario in range(len(pair.scenarios)):
        pair.reset(options={"scenario": scenario})
        unrestricted.reset(options={"scenario": scenario})
        ego, *others = (
            unrestricted.scene(agent).states[0, 0, -1, :2] for agent in unrestricted.present_agents
        )
        away = [math.dist(ego, other) for other in others]
        if "vehicle_1" in pair.present_agents:
            second = pair.scene("vehicle_1").states[0, 0, -1, :2]
            assert math.dist(ego, second) == min(away)


def test_copies_and_pickles_continue_in_the_same_way(crossing):
    """From the middle of an episode through the next reset."""
    env = _make(crossing, traffic="idm")
    env.reset(seed=4, options={"scenario": 1})
    for _ in range(3):
        env.step(_zero_actions(env))
    for twin in (copy.deepcopy(env), pickle.loads(pickle.dumps(env))):
        original = copy.deepcopy(env)
        for _ in range(5):
            same(original.step(_zero_actions(original)), twin.step(_zero_actions(twin)))
        same(original.reset(), twin.reset())


def test_renders_the_whole_place(crossing):
    """The same state gives the same image; without a render mode there is none."""
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


def test_invalid_input_is_rejected(crossing):
    for options, message in (
        ({"classes": ("kite",)}, "unknown class of agents 'kite'.*known are bus, car"),
        ({"classes": "car"}, "classes 'car': expected a sequence"),
        ({"ids": ()}, r"ids \(\): expected a sequence"),
        ({"ids": (99,)}, "the ego of no scenario has one of the given classes and ids"),
        ({"max_agents": 0}, "max_agents 0: expected a whole number of at least 1"),
        ({"render_mode": "ansi"}, "render mode 'ansi'"),
        ({"colour": 1}, "unexpected keyword argument 'colour'"),
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
        env.step(_zero_actions(env) | {"vehicle_0": np.array([np.nan, 0.0])})
