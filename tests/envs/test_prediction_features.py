"""The wrappers that add forecasts to the observation."""

import copy
import dataclasses
import warnings
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import VectorEnv
from stable_baselines3.common.env_checker import check_env as check_env_sb3

import asp_env
from asp_env.data.predictor import Forecast, load_predictor, make_forecast
from asp_env.data.scene import Scene
from asp_env.data.snippets import Future
from asp_env.envs.forecasts import Present, nearest_agents
from asp_env.envs.replay import ReplayEnv
from asp_env.envs.wrappers import PredictionFeatures
from asp_env.geometry import to_frame
from tests.conformance.predictor_cases import Case
from tests.envs.same import same


def _env(crossing: str, **options: Any) -> gymnasium.Env[dict[str, Any], Any]:
    return gymnasium.make(
        "asp_env/Replay-v0", data=crossing, **{"observations": ("state",), **options}
    )


def _envs(crossing: str, count: int, **options: Any) -> VectorEnv:
    return gymnasium.make_vec(
        "asp_env/Replay-v0",
        num_envs=count,
        vectorization_mode="vector_entry_point",
        data=crossing,
        observations=("state",),
        **options,
    )


def _scene(env: gymnasium.Env[Any, Any]) -> Scene:
    inner = env.unwrapped
    assert isinstance(inner, ReplayEnv)
    return inner.scene()


class Fan:
    """Forecasts vehicles only: in mode m they start at the ego and move m metres left per tick."""

    name, privileged, dt_s, history, horizon = "fan", False, 0.2, 0, 20
    trained_on = None

    def __init__(self, probabilities: tuple[float, ...]) -> None:
        self.log_probs = np.log(probabilities)
        self.calls = 0
        self.metadata: dict[str, str] = {}

    def predict(self, scene: Scene, future: Future | None = None) -> Forecast:
        assert future is None
        self.calls += 1
        modes, count = len(self.log_probs), len(scene.targets)
        ego = scene.states[scene.targets[:, 0], 0, -1, None, None]
        states = np.zeros((count, modes, self.horizon, 4), dtype=np.float32)
        left = np.arange(modes)[:, None] * np.arange(1, self.horizon + 1)
        states[..., 0] = ego[..., 0] - np.sin(ego[..., 2]) * left
        states[..., 1] = ego[..., 1] + np.cos(ego[..., 2]) * left
        return make_forecast(
            scene,
            states=states,
            actions=None,
            log_probs=np.tile(self.log_probs, (count, 1)),
            valid=scene.predictable,
        )


@pytest.mark.parametrize("predictor", ["constant-velocity", "constant-turn-rate"])
def test_checkers_pass(crossing, predictor):
    """Gymnasium's checker warns of every wrapper."""
    env = _env(crossing, observations=("raster", "state"), raster_px=(90, 60),
               render_mode="rgb_array")  # fmt: skip
    env = PredictionFeatures(env.unwrapped, predictor)
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*is different from the unwrapped version")
        check_env(env, skip_close_check=True)
    check_env_sb3(env)


def test_most_probable_modes_come_first(crossing):
    """The two most probable of four modes, at 0.4 s and 2 s: 2 and 10 ticks."""
    fan = Fan((0.2, 0.4, 0.3, 0.1))
    env = PredictionFeatures(_env(crossing), fan, agents=3, modes=2, at_s=(0.4, 2.0))
    seen, _ = env.reset(options={"scenario": 0})
    scene = _scene(env)
    targets, _ = nearest_agents(scene, 3)
    known = scene.with_targets(targets).predictable
    assert known.any()
    assert seen["forecast_valid"].tolist() == [1, 1, 1]
    positions = seen["forecast"].reshape(3, 2, 2, 2)
    probabilities = seen["forecast_probabilities"].reshape(3, 2)
    for agent in np.flatnonzero(known):
        np.testing.assert_allclose(probabilities[agent], [0.4, 0.3], atol=1e-6)
        np.testing.assert_allclose(positions[agent, 0], [[0, 2], [0, 10]], atol=1e-4)
        np.testing.assert_allclose(positions[agent, 1], [[0, 4], [0, 20]], atol=1e-4)
    assert fan.calls == 1


def test_agents_without_a_forecast_get_constant_velocity(crossing):
    """In all modes, as for planners."""
    env = PredictionFeatures(_env(crossing), Fan((0.5, 0.5)), agents=8, modes=2, at_s=(1.0,))
    straight = PredictionFeatures(_env(crossing), "constant-velocity", agents=8, at_s=(1.0,))
    compared = 0
    for scenario in range(5):
        seen, _ = env.reset(options={"scenario": scenario})
        other, _ = straight.reset(options={"scenario": scenario})
        scene = _scene(env)
        targets, _ = nearest_agents(scene, 8)
        positions, expected = (
            each["forecast"].reshape(8, modes, 2) for each, modes in ((seen, 2), (other, 3))
        )
        for agent in np.flatnonzero(~scene.with_targets(targets).predictable):
            np.testing.assert_array_equal(positions[agent], expected[agent, [0, 0]])
            compared += 1
    assert compared


def test_nearest_agents_come_first(crossing):
    """For any order of slots and number of agents."""
    env = _env(crossing)
    env.reset(options={"scenario": 2})
    scene = _scene(env)
    targets, rank = nearest_agents(scene, 100)
    assert rank.tolist() == list(range(len(targets))) == list(range(len(scene.targets)))
    away = np.hypot(*(scene.states[0, targets[:, 1], -1, :2] - scene.states[0, 0, -1, :2]).T)
    assert (np.diff(away) >= 0).all()
    order = np.concatenate([[0], np.random.default_rng(0).permutation(scene.ids.shape[1] - 1) + 1])
    names = ("states", "actions", "valid", "sizes", "classes", "ids")
    mixed = dataclasses.replace(scene, **{name: getattr(scene, name)[:, order] for name in names})
    again, _ = nearest_agents(mixed, 100)
    np.testing.assert_array_equal(mixed.ids[0, again[:, 1]], scene.ids[0, targets[:, 1]])
    few, _ = nearest_agents(scene, 2)
    np.testing.assert_array_equal(few, targets[:2])


def test_without_agents_the_forecasts_are_zero(crossing, monkeypatch):
    """The predictor is not called."""
    fan = Fan((1.0,))
    features = PredictionFeatures(_env(crossing), fan)
    inner = features.unwrapped
    assert isinstance(inner, ReplayEnv)
    present = inner.episodes.present

    def alone(rows: np.ndarray) -> Present:
        now = present(rows)
        return now._replace(valid=now.valid & (np.arange(now.valid.shape[1]) == 0))

    monkeypatch.setattr(inner.episodes, "present", alone)
    seen, _ = features.reset(seed=0)
    assert not any(seen[name].any() for name in seen if name.startswith("forecast"))
    assert fan.calls == 0


def test_forecasts_of_a_trained_predictor(crossing, tmp_path):
    """Loaded by name, with random weights."""
    name = Case("ssp-asp", "vectors").save(tmp_path)
    env = PredictionFeatures(_env(crossing), name, agents=4, at_s=(1.0, 3.0))
    predictor = load_predictor(name, horizon=15, dt_s=0.2)
    seen, _ = env.reset(options={"scenario": 1})
    for _ in range(3):
        assert seen in env.observation_space
        scene = _scene(env)
        targets, _ = nearest_agents(scene, 4)
        scene = scene.with_targets(targets)
        forecast = predictor.predict(scene)
        best = forecast.states[np.arange(len(targets)), forecast.most_probable][:, [4, 14], :2]
        expected = to_frame(best, scene.states[0, 0, -1])
        shown = seen["forecast"].reshape(4, 3, 2, 2)[:, 0]
        known = forecast.valid
        assert known.any()
        np.testing.assert_allclose(shown[known], expected[known], atol=1e-5)
        seen, *_ = env.step(np.array([0.2, 0.0]))


@pytest.mark.parametrize("mode", ["NextStep", "Disabled"])
@pytest.mark.parametrize("predictor", ["constant-turn-rate", "oracle"])
def test_vector_forecasts_have_the_bits_of_single_ones(crossing, mode, predictor):
    """Through resets."""
    options: dict[str, Any] = {"agents": 5, "privileged": predictor == "oracle"}
    singles = [PredictionFeatures(_env(crossing), predictor, **options) for _ in range(3)]
    envs = asp_env.VectorPredictionFeatures(
        _envs(crossing, 3, autoreset_mode=mode), predictor, **options
    )
    seen, _ = envs.reset(seed=5)
    expected = [env.reset(seed=5 + b)[0] for b, env in enumerate(singles)]
    rng, over = np.random.default_rng(0), np.zeros(3, dtype=bool)
    for _ in range(60):
        assert seen in envs.observation_space
        for b in range(3):
            same({name: part[b] for name, part in seen.items()}, expected[b])
        if mode == "Disabled" and over.any():
            seen, _ = envs.reset(options={"reset_mask": over})
            expected = [env.reset()[0] if over[b] else expected[b] for b, env in enumerate(singles)]
            over[:] = False
            continue
        actions = rng.uniform((0.0, -0.4), (1.0, 0.4), (3, 2))
        seen, _, terminated, truncated, _ = envs.step(actions)
        expected = [
            env.reset()[0] if over[b] else env.step(actions[b])[0] for b, env in enumerate(singles)
        ]
        over = terminated | truncated


def test_one_predictor_call_for_all_environments(crossing):
    """A reset and three steps of five environments make four calls."""
    fan = Fan((1.0,))
    envs = asp_env.VectorPredictionFeatures(_envs(crossing, 5), fan)
    envs.reset(seed=0)
    for _ in range(3):
        envs.step(np.zeros((5, 2)))
    assert fan.calls == 4


def test_privileged_predictors_need_permission_and_rename_the_keys(crossing):
    """The oracle's forecasts are the positions that the agents then reach."""
    with pytest.raises(asp_env.AspEnvError, match=r"oracle uses the recorded future.*privileged=T"):
        PredictionFeatures(_env(crossing), "oracle")
    with pytest.raises(asp_env.AspEnvError, match="interactive-oracle simulates the ego's plan"):
        PredictionFeatures(_env(crossing), "interactive-oracle", privileged=True)
    env = PredictionFeatures(_env(crossing), "oracle", privileged=True, agents=2, at_s=(1.0,))
    assert {"oracle_forecast", "oracle_forecast_probabilities", "oracle_forecast_valid"} < set(
        env.observation_space.keys()  # pyright: ignore[reportAttributeAccessIssue]
    )
    seen, _ = env.reset(options={"scenario": 0})
    ego, ids = _nearest(env)
    for _ in range(5):
        env.step(np.zeros(2))
    scene = _scene(env)
    slots = [int(np.flatnonzero(scene.ids[0] == number)[0]) for number in ids]
    expected = to_frame(scene.states[0, slots, -1, :2], ego)
    shown = seen["oracle_forecast"].reshape(2, 3, 1, 2)[:, 0, 0]
    np.testing.assert_allclose(shown, expected, atol=1e-4)


def _nearest(env: PredictionFeatures) -> tuple[np.ndarray, list[int]]:
    scene = _scene(env)
    targets, _ = nearest_agents(scene, 2)
    return scene.states[0, 0, -1], scene.ids[0, targets[:, 1]].tolist()


def test_copy_and_spec_give_the_same_environment(crossing):
    env = PredictionFeatures(_env(crossing), "constant-velocity", agents=2)
    env.reset(seed=0)
    twin = copy.deepcopy(env)
    same(env.step(np.zeros(2)), twin.step(np.zeros(2)))
    assert env.spec is not None
    again = gymnasium.make(env.spec)
    same(env.reset(seed=3), again.reset(seed=3))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"predictor": "constant"}, "unknown predictor 'constant'"),
        (
            {"predictor": "constant-velocity", "agents": 0},
            "agents 0: expected a whole number",
        ),
        (
            {"predictor": "constant-velocity", "modes": 0},
            "modes 0: expected a whole number",
        ),
        ({"predictor": "constant-velocity", "at_s": ()}, "at_s \\(\\): expected at least one time"),
        ({"predictor": "constant-velocity", "at_s": (0.3,)}, "0.3 s is no whole number of ticks"),
        ({"predictor": Fan((1.0,)), "at_s": (5.0,)}, "fan forecasts 4 s: at_s has times up to 5 s"),
    ],
)
def test_invalid_arguments_are_rejected(crossing, arguments, message):
    with pytest.raises(asp_env.AspEnvError, match=message):
        PredictionFeatures(_env(crossing), **arguments)


def test_unsuitable_environments_are_rejected(crossing):
    """Without scenes, with another time step, and with forecasts already."""
    with pytest.raises(asp_env.AspEnvError, match="has no scenes to forecast"):
        PredictionFeatures(gymnasium.make("CartPole-v1"), "constant-velocity")
    with pytest.raises(asp_env.AspEnvError, match=r"of 0\.2 s, the environment has 0\.12 s"):
        PredictionFeatures(_env(crossing, dt_s=0.12), Fan((1.0,)), at_s=(0.6,))
    env = PredictionFeatures(_env(crossing), "constant-velocity")
    with pytest.raises(asp_env.AspEnvError, match="has an entry 'forecast' already"):
        PredictionFeatures(env, "constant-turn-rate")


@pytest.mark.parametrize("name", ["ssp-asp", "mtp"])
def test_features_of_a_trained_predictor(crossing, tmp_path, name):
    """Those of the forecast, at the rank of each agent; zeros where there is no forecast."""
    run = Case(name, "vectors").save(tmp_path)
    env = PredictionFeatures(_env(crossing), run, agents=4, features=True)
    size = 16 if name == "ssp-asp" else 8
    box = env.observation_space["forecast_features"]  # pyright: ignore[reportIndexIssue]
    assert (box.shape, box.dtype) == ((4 * size,), np.float32)
    predictor = load_predictor(run, horizon=15, dt_s=0.2)
    seen, _ = env.reset(options={"scenario": 1})
    assert seen in env.observation_space
    targets, _ = nearest_agents(_scene(env), 4)
    forecast = predictor.predict(_scene(env).with_targets(targets))
    shown = seen["forecast_features"].reshape(4, size)
    assert forecast.features is not None
    assert forecast.features.any()
    np.testing.assert_array_equal(shown[: len(targets)], forecast.features)
    assert not shown[: len(targets)][~forecast.valid].any()
    envs = asp_env.VectorPredictionFeatures(_envs(crossing, 1), run, agents=4, features=True)
    together, _ = envs.reset(options={"scenario": [1]})
    np.testing.assert_array_equal(together["forecast_features"][0], seen["forecast_features"])


def test_features_need_a_trained_predictor(crossing):
    with pytest.raises(
        asp_env.AspEnvError, match="constant-velocity has no features, only trained"
    ):
        PredictionFeatures(_env(crossing), "constant-velocity", features=True)
    space = PredictionFeatures(_env(crossing), Fan((1.0,))).observation_space
    assert isinstance(space, gymnasium.spaces.Dict)
    assert "forecast_features" not in space.spaces
