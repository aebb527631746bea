"""Forecasts as part of an environment's observation: contents, age, seeds and copies."""

import copy
import dataclasses
import pickle
from collections.abc import Mapping
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.envs.registration import EnvSpec
from gymnasium.vector import AutoresetMode

import asp_env
from asp_env import ForecastOptions, PredictionFeatures
from asp_env.data.predictor import Forecast, load_predictor, make_forecast
from asp_env.data.scene import Scene, infer_actions
from asp_env.data.snippets import Future
from asp_env.dynamics import rollout
from asp_env.envs.forecasts import ForecastObserver, Present
from asp_env.envs.parallel import ParallelReplayEnv
from asp_env.envs.replay import ReplayEnv
from asp_env.envs.vector import ReplayVectorEnv
from tests.conformance.predictor_cases import Case
from tests.envs.same import same, same_alone, same_through_ends

STATE: dict[str, Any] = {"observations": ("state",)}
OLD: dict[str, Any] = {"predictor": "constant-turn-rate"} | {
    "forecast": {"every_ticks": 3, "latency_ticks": 2, "agents": 4}
}


class Counting:
    """Constant velocity in two modes, which refuses to be copied and records its calls."""

    name, privileged, dt_s, history, horizon = "counting", False, 0.2, 0, 30
    trained_on = None

    def __init__(self) -> None:
        self.metadata: Mapping[str, str] = {}
        self.situations: list[int] = []
        """Number of situations with targets in each call."""

    def __deepcopy__(self, memo: dict[int, Any]) -> "Counting":
        raise AssertionError("the predictor is copied")

    def predict(self, scene: Scene, future: Future | None = None) -> Forecast:
        del future
        self.situations.append(len(np.unique(scene.targets[:, 0])))
        straight = load_predictor("constant-velocity", horizon=30, dt_s=0.2).predict(scene)
        return make_forecast(
            scene,
            states=np.repeat(straight.states, 2, axis=1),
            actions=None,
            log_probs=np.log(np.tile([0.75, 0.25], (len(scene.targets), 1))),
            valid=straight.valid,
        )


def _vector(crossing: str, count: int = 4, **options: Any) -> ReplayVectorEnv:
    return ReplayVectorEnv(count, crossing, **(STATE | options))


def _actions(count: int, steps: int) -> list[np.ndarray]:
    rng = np.random.default_rng(0)
    return [rng.uniform((0.0, -0.5), (1.0, 0.5), (count, 2)).astype("f4") for _ in range(steps)]


@pytest.mark.parametrize("mode", list(AutoresetMode), ids=lambda mode: mode.value)
@pytest.mark.parametrize(
    ("predictor", "forecast"),
    [
        ("constant-turn-rate", {"every_ticks": 3, "latency_ticks": 2, "agents": 4}),
        ("noisy-oracle:2", {"latency_ticks": 4, "privileged": True, "modes": 1}),
        ({"a": "constant-velocity", "b": "shuffled-oracle"}, {"b": {"privileged": True}}),
    ],
    ids=["old", "noisy", "two"],
)
def test_vector_environments_have_the_bits_of_single_ones(crossing, mode, predictor, forecast):
    """Through endings and restarts in every autoreset mode; `final_obs` has the last forecasts."""
    options = STATE | {"predictor": predictor, "forecast": forecast}
    one = _vector(crossing, autoreset_mode=mode, **options)
    other = gymnasium.make_vec(
        "asp_env/Replay-v0",
        num_envs=4,
        vectorization_mode="sync",
        vector_kwargs={"autoreset_mode": mode},
        data=crossing,
        **options,
    )
    assert one.single_observation_space == other.single_observation_space
    assert same_through_ends(one, other, mode, _actions(4, 30)) > 4


@pytest.mark.parametrize("options", [{"predictor": "constant-turn-rate"}, OLD], ids=["now", "old"])
def test_the_wrappers_show_what_the_environment_shows(crossing, options):
    """Single and vector, through restarts; the default options show forecasts of now."""
    fields = options.get("forecast", {})
    one = ReplayEnv(crossing, **STATE, **options)
    other = PredictionFeatures(ReplayEnv(crossing, **STATE), options["predictor"], **fields)
    assert one.observation_space == other.observation_space
    for seed in range(2):
        same(one.reset(seed=seed), other.reset(seed=seed))
        for _ in range(9):
            same(one.step(np.zeros(2)), other.step(np.zeros(2)))
    for mode in (AutoresetMode.NEXT_STEP, AutoresetMode.DISABLED):
        wrapped = asp_env.VectorPredictionFeatures(
            _vector(crossing, autoreset_mode=mode), options["predictor"], **fields
        )
        built_in = _vector(crossing, autoreset_mode=mode, **options)
        assert same_through_ends(built_in, wrapped, mode, _actions(4, 25)) > 4


class Roads:
    """One episode with the ego and up to three agents that drive at constant velocity.

    The agent 13 appears at tick 4, nearest to the ego.
    """

    dt_s = 0.2
    serial = 0

    def __init__(self) -> None:
        self.tick = 0
        starts = np.array(
            [[0, 0, 0.3, 5], [20, 4, 1.0, 8], [-9, 12, -2.0, 3], [1, 2, 0.0, 2]], dtype=np.float32
        )
        actions = np.zeros((4, 60, 2), dtype=np.float32)
        lengths = np.full(4, 4.0, dtype=np.float32)
        later = rollout(starts, actions, lengths, self.dt_s, reverse=True)
        self.states = np.concatenate([starts[:, None], later], axis=1)
        self.ids = np.array([[10, 11, 12, 13]])

    def __len__(self) -> int:
        return 1

    def _valid(self) -> np.ndarray:
        return np.array([[True, True, True, self.tick >= 4]])

    def present(self, rows: np.ndarray) -> Present:
        assert rows.tolist() == [0]
        states = np.where(self._valid()[..., None], self.states[None, :, self.tick], 0)
        elapsed, serials = np.array([self.tick]), np.array([self.serial])
        return Present(states, self._valid(), self.ids, elapsed, serials)

    def scene(self, rows: np.ndarray, targets: np.ndarray, history: int | None = None) -> Scene:
        del history  # There is none.
        present = self.present(rows)
        states, valid = present.states[:, :, None], present.valid[:, :, None]
        sizes = np.full((1, 4, 2), 4.0, dtype=np.float32)
        return Scene(
            states=states,
            actions=infer_actions(states, valid, sizes[..., 0], self.dt_s),
            valid=valid,
            sizes=sizes,
            classes=np.zeros((1, 4), dtype=np.int32),
            ids=self.ids,
            tick=np.array([self.tick]),
            targets=targets,
            route=np.zeros((1, 2, 2), dtype=np.float32),
            route_valid=np.ones((1, 2), dtype=bool),
            maps=(),
            map_index=np.zeros(1, dtype=np.int64),
            dt_s=self.dt_s,
        )

    def recorded_future(self, scene: Scene, horizon: int, rows: np.ndarray) -> Future:
        raise NotImplementedError


def test_ages_by_hand():
    """Every 3 ticks and 2 ticks late: at tick 5 the scene of tick 3 is shown, until tick 7."""
    roads = Roads()
    options = ForecastOptions(agents=2, every_ticks=3, latency_ticks=2)
    old = ForecastObserver("constant-velocity", options, 0.2)
    ages = []
    for tick in range(12):
        roads.tick = tick
        ages.append(old.observe(roads, np.zeros(1, dtype=int))["forecast_age"][0].tolist())
    # From tick 4 on the nearest agent is one that the forecasts of the ticks 0 and 3 leave out.
    nearest = [0, 1, 2, 3, 0, 0, 0, 0, 2, 3, 4, 2]
    second = [0, 1, 2, 3, 4, 2, 3, 4, 2, 3, 4, 2]
    expected = 0.2 * np.stack([nearest, second], axis=-1)
    np.testing.assert_allclose(ages, expected, atol=1e-6)
    assert old.spaces["forecast_age"].high[0] == np.float32(0.8)


def test_a_moved_forecast_of_a_constant_velocity_is_the_fresh_one():
    """For agents with any age, and for the one that appears later."""
    roads = Roads()
    old = ForecastObserver(
        "constant-velocity", ForecastOptions(agents=3, every_ticks=4, latency_ticks=3), 0.2
    )
    fresh = ForecastObserver("constant-velocity", ForecastOptions(agents=3), 0.2)
    seen: dict[str, np.ndarray] = {}
    for tick in range(20):
        roads.tick = tick
        seen, expected = (each.observe(roads, np.zeros(1, dtype=int)) for each in (old, fresh))
        for name in expected:
            np.testing.assert_allclose(seen[name], expected[name], atol=1e-4)
        assert expected["forecast_valid"].sum() == 2 + (tick >= 4)
    assert seen["forecast_age"].max() > 0.5


def test_a_moved_oracle_is_the_fresh_one(crossing):
    """Traffic replays the recording, so that the recorded positions do not depend on the age."""
    compared = 0
    envs = [
        ReplayEnv(
            crossing,
            **STATE,
            predictor="oracle",
            forecast={"privileged": True, "modes": 1, "at_s": (0.4, 1.0), "agents": 3, **age},
        )
        for age in ({}, {"every_ticks": 2, "latency_ticks": 3})
    ]
    for env in envs:
        env.reset(options={"scenario": 0})
    for _ in range(15):
        fresh, old = (env.step(np.zeros(2))[0] for env in envs)
        known = old["oracle_forecast_age"] > 0
        shown = [each["oracle_forecast"].reshape(3, 4)[known] for each in (fresh, old)]
        np.testing.assert_allclose(shown[0], shown[1], atol=1e-3)
        compared += int(known.sum())
    assert compared > 10


def test_number_of_predictor_calls(crossing):
    """One call a step; with a period, of the episodes that are due; restarts get one of theirs."""
    counting = Counting()
    envs = _vector(crossing, predictor=counting, autoreset_mode="Disabled")
    envs.reset(seed=0)
    envs.step(np.zeros((4, 2)))
    assert counting.situations == [4, 4]
    envs.reset(options={"reset_mask": np.array([True, False, False, False])})
    assert counting.situations == [4, 4, 1]

    counting = Counting()
    envs = _vector(crossing, predictor=counting, forecast={"every_ticks": 3})
    envs.reset(seed=0)
    for _ in range(6):
        *_, over, cut, _ = envs.step(np.zeros((4, 2)))
        assert not (over | cut).any()
    assert counting.situations == [4, 4, 4]

    counting = Counting()
    envs = _vector(crossing, predictor=counting, autoreset_mode="SameStep")
    envs.reset(seed=0)
    calls = 1
    for action in _actions(4, 25):
        *_, over, cut, _ = envs.step(action)
        restarted = int((over | cut).sum())
        calls += 1 + (restarted > 0)
        assert counting.situations[-1] == (restarted or 4)
    assert len(counting.situations) == calls


def test_predictors_are_never_copied(crossing):
    """By specifications, wrappers, vector environments and copies of environments."""
    counting = Counting()
    env = gymnasium.make("asp_env/Replay-v0", data=crossing, **STATE, predictor=counting)
    twin = gymnasium.make(copy.deepcopy(env.spec))  # pyright: ignore[reportArgumentType]
    same(env.reset(seed=1), twin.reset(seed=1))
    same(copy.deepcopy(env).step(np.zeros(2)), twin.step(np.zeros(2)))
    both = gymnasium.make(
        "asp_env/Replay-v0", data=crossing, **STATE, predictor={"a": counting, "b": counting}
    )
    gymnasium.make(copy.deepcopy(both.spec)).reset()  # pyright: ignore[reportArgumentType]
    envs = gymnasium.make_vec(
        "asp_env/Replay-v0",
        num_envs=2,
        vectorization_mode="vector_entry_point",
        data=crossing,
        **STATE,
        predictor=counting,
    )
    gymnasium.make_vec(copy.deepcopy(envs.unwrapped.spec))  # pyright: ignore[reportArgumentType]
    wrapped = PredictionFeatures(
        gymnasium.make("asp_env/Replay-v0", data=crossing, **STATE), counting
    )
    again = gymnasium.make(copy.deepcopy(wrapped.spec))  # pyright: ignore[reportArgumentType]
    same(wrapped.reset(seed=1), again.reset(seed=1))


def test_the_specification_of_named_predictors_is_json(crossing):
    """It holds the names and all options."""
    options = ForecastOptions(agents=4, every_ticks=2, latency_ticks=1, at_s=(0.6,))
    env = gymnasium.make(
        "asp_env/Replay-v0", data=crossing, **STATE, predictor="blind", forecast=options
    )
    assert env.spec is not None
    spec = EnvSpec.from_json(env.spec.to_json())
    assert spec.kwargs["predictor"] == "blind"
    assert spec.kwargs["forecast"] == dataclasses.asdict(options) | {"at_s": [0.6]}
    again = gymnasium.make(spec)
    same(env.reset(seed=2), again.reset(seed=2))
    same(env.step(np.zeros(2)), again.step(np.zeros(2)))


def test_reset_seeds_stochastic_predictors(crossing):
    """The noise of the same scenario differs between seeds, and only then."""
    options: dict[str, Any] = {"forecast": {"privileged": True}, **STATE}
    env = ReplayEnv(crossing, predictor="noisy-oracle:2", **options)

    def seen(seed: int) -> bytes:
        first, _ = env.reset(seed=seed, options={"scenario": 0})
        second, *_ = env.step(np.zeros(2))
        return first["oracle_forecast"].tobytes() + second["oracle_forecast"].tobytes()

    assert seen(0) == seen(0) != seen(1)
    exact = ReplayEnv(crossing, predictor="oracle", **options)
    assert len({exact.reset(seed=s, options={"scenario": 0})[0]["oracle_forecast"].tobytes()
                for s in range(3)}) == 1  # fmt: skip


@pytest.mark.parametrize("pickled", [False, True])
def test_snapshots_hold_the_forecasts(crossing, pickled):
    """Everything that follows has the same bits, also from a pickle."""
    options = STATE | {"forecast": OLD["forecast"] | {"privileged": True}}
    env, other = (ReplayEnv(crossing, predictor="noisy-oracle:1", **options) for _ in range(2))
    env.reset(seed=3)
    actions = np.random.default_rng(0).uniform(-0.2, 0.4, (14, 2))
    for action in actions[:7]:
        env.step(action)
    snapshot = env.snapshot()
    if pickled:
        snapshot = pickle.loads(pickle.dumps(snapshot))
    expected = [env.step(action) for action in actions[7:]]
    for each in (env, other):
        each.restore(snapshot)
        same([each.step(action) for action in actions[7:]], expected)
    envs = _vector(crossing, predictor="noisy-oracle:1", **options)
    envs.reset(seed=0)
    for _ in range(7):
        envs.step(np.zeros((4, 2)))
    state = pickle.loads(pickle.dumps(envs.snapshot()))
    following = [envs.step(np.zeros((4, 2))) for _ in range(5)]
    envs.restore(state)
    same([envs.step(np.zeros((4, 2))) for _ in range(5)], following)


def test_several_predictors_side_by_side(crossing):
    """Names start with the prefixes; each has the entries that it has alone."""
    env = ReplayEnv(
        crossing,
        **STATE,
        predictor={"cv": "constant-velocity", "now": "oracle"},
        forecast={"cv": {"agents": 2}, "now": ForecastOptions(privileged=True, modes=1)},
    )
    seen, _ = env.reset(seed=0)
    assert seen["cv_forecast"].shape == (2 * 3 * 3 * 2,)
    assert seen["oracle_now_forecast"].shape == (8 * 1 * 3 * 2,)
    alone = ReplayEnv(crossing, **STATE, predictor="constant-velocity", forecast={"agents": 2})
    first, _ = alone.reset(seed=0)
    np.testing.assert_array_equal(seen["cv_forecast"], first["forecast"])
    nested = PredictionFeatures(alone, "constant-velocity", agents=2, prefix="cv")
    np.testing.assert_array_equal(nested.reset(seed=0)[0]["cv_forecast"], first["forecast"])


def test_latent_features_stand_alone(crossing, tmp_path):
    """Without positions and probabilities, equal to those beside positions."""
    run = Case("ssp-asp", "vectors").save(tmp_path)
    seen, both = (
        ReplayEnv(
            crossing, **STATE, predictor=run, forecast={"features": features, "agents": 3}
        ).reset(options={"scenario": 1})[0]
        for features in ("latent", True)
    )
    assert set(seen) == {"state", "forecast_valid", "forecast_features"}
    assert seen["forecast_features"].any()
    np.testing.assert_array_equal(seen["forecast_features"], both["forecast_features"])


def test_agents_of_a_parallel_environment_have_forecasts(crossing):
    """One agent has those of the single environment; each of several has its own view."""
    one = ParallelReplayEnv(crossing, max_agents=1, **STATE, **OLD)
    other = ReplayEnv(crossing, **STATE, **OLD)
    for seed in range(2):
        same_alone(one, other, seed)
    env = asp_env.parallel_env(crossing, **STATE, predictor="constant-velocity")
    seen, _ = env.reset(seed=0)
    assert len(seen) > 1
    for agent, observation in seen.items():
        assert observation in env.observation_space(agent)
    assert len({observation["forecast"].tobytes() for observation in seen.values()}) == len(seen)


def test_stable_baselines3_gets_the_forecasts_of_ended_episodes(crossing):
    """`terminal_observation` is complete, and differs from the first one of the next episode."""
    envs = asp_env.sb3_vec_env(4, crossing, **STATE, **OLD)
    envs.reset()
    ends = 0
    for action in _actions(4, 60):
        seen, _, over, infos = envs.step(action)
        assert isinstance(seen, dict)
        for b in np.flatnonzero(over):
            last = infos[b]["terminal_observation"]
            assert last in envs.observation_space
            assert seen["forecast_age"][b].max() == 0.0 < last["forecast_age"].max()
            ends += 1
    assert ends


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"forecast": {"agents": 3}}, "forecast without a predictor: name one"),
        ({"predictor": "blind", "forecast": {"agent": 3}}, "unknown forecast option 'agent'"),
        ({"predictor": "blind", "forecast": {"every_ticks": 0}}, "every_ticks 0: expected a whole"),
        ({"predictor": "blind", "forecast": {"latency_ticks": -1}}, "latency_ticks -1: expected"),
        ({"predictor": "blind", "forecast": {"features": "latent"}}, "blind has no features"),
        ({"predictor": {}}, "expected a predictor or a mapping with at least one"),
        (
            {"predictor": {"a": "blind"}, "forecast": {"a": {}, "b": {}}},
            "unknown predictor in forecast 'b'",
        ),
    ],
)
def test_invalid_options_are_rejected(crossing, options, message):
    with pytest.raises(asp_env.AspEnvError, match=message):
        ReplayEnv(crossing, **STATE, **options)


def test_the_vector_wrapper_rejects_same_step(crossing):
    """The scene of an ended episode is gone; the suggested argument works."""
    with pytest.raises(asp_env.AspEnvError, match="make the environment itself with predictor="):
        asp_env.VectorPredictionFeatures(
            _vector(crossing, autoreset_mode="SameStep"), "constant-velocity"
        )
