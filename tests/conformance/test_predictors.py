"""What every registered predictor keeps to. Learned ones are tried with random weights."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from asp_env import registry
from asp_env.data.classes import PREDICTED
from asp_env.data.forecast import Forecast
from asp_env.data.predictor import Predictor, load_predictor
from asp_env.data.recording import Recording
from asp_env.data.road_map import Ragged, RoadMap
from asp_env.data.scene import Scene
from asp_env.data.snippets import Future, gather_future, gather_scene, index_snippets
from asp_env.dynamics import MAX_ACCELERATION_MPS2, MAX_STEERING_RAD, wrap_angle
from asp_env.errors import AspEnvError
from predictors.recipes import RECIPES
from tests.builders import make_recording
from tests.predictors.tiny import save_random

NAMES = registry.names("predictors")
PHYSICAL = tuple(name for name in NAMES if name not in RECIPES)
LEARNED = tuple(name for name in NAMES if name in RECIPES)
HORIZON = 15

RECORDING = make_recording()
INDEX = index_snippets([RECORDING], dt_s=0.2, horizon_s=3.0)


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """A folder with random weights for every learned predictor."""
    folder = tmp_path_factory.mktemp("runs")
    return {name: save_random(folder / name) for name in LEARNED}


@pytest.fixture
def predictor(request: pytest.FixtureRequest, runs: dict[str, Path]) -> Predictor:
    """The predictor of a name."""
    name: str = request.param
    full = f"{name}:{runs[name]}" if name in runs else name
    return load_predictor(full, horizon=HORIZON, dt_s=0.2)


every = pytest.mark.parametrize("predictor", NAMES, indirect=True)
physical = pytest.mark.parametrize("predictor", PHYSICAL, indirect=True)
learned = pytest.mark.parametrize("predictor", LEARNED, indirect=True)


def situations(recording: Recording = RECORDING) -> tuple[Scene, Future]:
    """Scene and future of all snippets."""
    return gather_scene([recording], INDEX), gather_future([recording], INDEX)


def everybody() -> tuple[Scene, Future]:
    """Scene and future with every slot of every situation as a target, absent ones too."""
    scene, _ = situations()
    targets = np.argwhere(np.ones(scene.ids.shape, dtype=bool))
    states = np.zeros((len(targets), HORIZON, 4), dtype=np.float32)
    valid = np.ones((len(targets), HORIZON), dtype=bool)
    return scene.with_targets(targets), Future(states=states, valid=valid)


def ask(predictor: Predictor, scene: Scene, future: Future) -> Forecast:
    """The forecast; only privileged predictors are handed a future."""
    return predictor.predict(scene, future if predictor.privileged else None)


def assert_same(one: Forecast, other: Forecast, rows: np.ndarray | None = None) -> None:
    """Equal bit for bit, where the second one's rows are in another order if given."""
    order = np.arange(len(one.ids)) if rows is None else rows
    for field in ("states", "actions", "actions_valid", "log_probs", "valid", "ids", "tick"):
        np.testing.assert_array_equal(getattr(one, field)[order], getattr(other, field), field)


@every
def test_forecast_has_the_shapes_that_it_promises(predictor: Predictor) -> None:
    """(N, M, T, 4) float32 states, M log-probabilities, and rows that say whom and when."""
    scene, future = situations()
    forecast = ask(predictor, scene, future)
    n, m = len(scene.targets), forecast.log_probs.shape[1]
    assert predictor.horizon == HORIZON
    assert forecast.states.shape == (n, m, HORIZON, 4)
    assert forecast.actions.shape == (n, m, HORIZON, 2)
    assert forecast.states.dtype == forecast.actions.dtype == forecast.log_probs.dtype == np.float32
    assert np.isfinite(forecast.states).all()
    assert forecast.valid.all()
    assert forecast.dt_s == scene.dt_s
    at = (scene.targets[:, 0], scene.targets[:, 1])
    np.testing.assert_array_equal(forecast.ids, scene.ids[at])
    np.testing.assert_array_equal(forecast.tick, scene.tick[scene.targets[:, 0]])
    np.testing.assert_array_equal(forecast.targets, scene.targets)


@every
def test_probabilities_sum_to_one(predictor: Predictor) -> None:
    """For every target, also those that are not forecast, to 1e-6."""
    forecast = ask(predictor, *everybody())
    np.testing.assert_allclose(np.exp(forecast.log_probs).sum(axis=-1), 1, atol=1e-6)


@every
def test_only_whom_it_can_forecast_is_valid(predictor: Predictor) -> None:
    """Absent agents and other classes are not valid and their rows are zeros.

    A privileged predictor repeats what was recorded, whatever the class.
    """
    scene, future = everybody()
    forecast = ask(predictor, scene, future)
    at = (scene.targets[:, 0], scene.targets[:, 1])
    seen = scene.valid[at][:, scene.history - predictor.history :].all(axis=-1)
    known = np.isin(scene.classes[at], [int(kind) for kind in PREDICTED])
    np.testing.assert_array_equal(forecast.valid, seen & (known | predictor.privileged))
    assert 0 < forecast.valid.sum() < len(forecast.valid)
    assert not forecast.states[~forecast.valid].any()
    assert not forecast.actions[~forecast.valid].any()


@every
def test_garbage_in_invalid_slots_changes_nothing(predictor: Predictor) -> None:
    """NaN in what is not valid leaves every forecast as it was, bit for bit."""
    scene, future = everybody()
    before = ask(predictor, scene, future)
    states, sizes, actions = scene.states.copy(), scene.sizes.copy(), scene.actions.copy()
    states[~scene.valid] = np.nan
    actions[~(scene.valid[..., 1:] & scene.valid[..., :-1])] = np.nan
    absent = ~scene.valid.any(axis=-1)
    assert absent.any()
    sizes[absent] = np.nan
    dirty = dataclasses.replace(scene, states=states, sizes=sizes, actions=actions)
    assert_same(before, ask(predictor, dirty, future))


@every
def test_order_of_slots_does_not_matter(predictor: Predictor) -> None:
    """With the agents of each situation shuffled, every target is forecast the same."""
    scene, future = situations()
    order = np.random.default_rng(0).permutation(scene.ids.shape[1])
    where = np.argsort(order)
    shuffled = dataclasses.replace(
        scene,
        states=scene.states[:, order],
        actions=scene.actions[:, order],
        valid=scene.valid[:, order],
        sizes=scene.sizes[:, order],
        classes=scene.classes[:, order],
        ids=scene.ids[:, order],
        targets=np.stack([scene.targets[:, 0], where[scene.targets[:, 1]]], axis=-1),
    )
    assert_same(ask(predictor, scene, future), ask(predictor, shuffled, future))


@every
def test_targets_do_not_influence_each_other(predictor: Predictor) -> None:
    """Any target alone, or a few in another order, is forecast as among all others to 1e-5."""
    scene, future = situations()
    together = ask(predictor, scene, future)
    for rows in (np.array([17]), np.array([40, 3, 99])):
        some = Future(states=future.states[rows], valid=future.valid[rows])
        alone = ask(predictor, scene.with_targets(scene.targets[rows]), some)
        np.testing.assert_allclose(alone.states, together.states[rows], atol=1e-5, rtol=1e-6)
        np.testing.assert_allclose(alone.log_probs, together.log_probs[rows], atol=1e-5)


@every
def test_what_it_tells_of_itself_cannot_be_changed(predictor: Predictor) -> None:
    """Trained ones name data, view, preset and weights, others nothing; nobody can set it."""
    fields = {"trained_on", "view", "preset", "weights"} if predictor.trained_on else set()
    assert set(predictor.about) == fields
    assert all(predictor.about.values())
    with pytest.raises(AttributeError):
        vars(type(predictor))["about"].__set__(predictor, {})


@every
def test_no_targets_give_an_empty_forecast(predictor: Predictor) -> None:
    """A scene that asks for nobody gets a forecast of nobody."""
    scene, future = situations()
    nobody = np.zeros((0, 2), dtype=scene.targets.dtype)
    nothing = Future(states=future.states[:0], valid=future.valid[:0])
    forecast = ask(predictor, scene.with_targets(nobody), nothing)
    assert forecast.states.shape[0] == forecast.log_probs.shape[0] == 0


@every
def test_same_scene_gives_the_same_forecast(predictor: Predictor) -> None:
    """Asked twice, bit for bit, and the scene is not written to."""
    scene, future = situations()
    copies = [scene.states.copy(), scene.actions.copy(), scene.valid.copy()]
    assert_same(ask(predictor, scene, future), ask(predictor, scene, future))
    for copy, array in zip(copies, (scene.states, scene.actions, scene.valid), strict=True):
        np.testing.assert_array_equal(copy, array)


@every
def test_unprivileged_predictors_read_no_future(predictor: Predictor) -> None:
    """Handed a false future, a predictor that is not privileged forecasts the same."""
    scene, future = situations()
    false = Future(states=future.states + 50, valid=future.valid)
    if predictor.privileged:
        moved = predictor.predict(scene, false).states - predictor.predict(scene, future).states
        np.testing.assert_allclose(moved[..., :2], 50, atol=1e-3)
    else:
        assert_same(predictor.predict(scene), predictor.predict(scene, false))


@every
def test_actions_stay_within_limits(predictor: Predictor) -> None:
    """What a predictor chooses is allowed; the oracle's actions were inferred and may exceed."""
    scene, future = situations()
    forecast = ask(predictor, scene, future)
    assert forecast.actions_valid.all()
    if not predictor.privileged:
        assert np.abs(forecast.actions[..., 0]).max() <= MAX_ACCELERATION_MPS2 + 1e-6
        assert np.abs(forecast.actions[..., 1]).max() <= MAX_STEERING_RAD + 1e-6


@every
def test_scene_of_another_time_step_is_refused(predictor: Predictor) -> None:
    """A predictor for 0.2 s refuses a scene of 0.1 s in one line."""
    scene, future = situations()
    with pytest.raises(AspEnvError, match=r"time step of 0\.2 s, the scene has 0\.1 s"):
        ask(predictor, dataclasses.replace(scene, dt_s=0.1), future)


@physical
def test_moving_the_world_moves_the_forecast(predictor: Predictor) -> None:
    """Turned by 1 rad and shifted by (30, -20) m, the forecast is turned and shifted, to 1e-4."""
    scene, future = situations()
    there, there_future = situations(moved(RECORDING, angle_rad=1.0, shift_m=(30.0, -20.0)))
    here = ask(predictor, scene, future).states
    expected = move(here, angle_rad=1.0, shift_m=(30.0, -20.0))
    found = ask(predictor, there, there_future).states
    np.testing.assert_allclose(found[..., :2], expected[..., :2], atol=1e-4)
    np.testing.assert_allclose(wrap_angle(found[..., 2] - expected[..., 2]), 0, atol=1e-4)
    np.testing.assert_allclose(found[..., 3], expected[..., 3], atol=1e-4)


@learned
def test_loaded_again_it_forecasts_the_same(predictor: Predictor, runs: dict[str, Path]) -> None:
    """Two loads of one folder are equal bit for bit; other weights are not."""
    scene, future = situations()
    again = load_predictor(f"{predictor.name}:{runs[predictor.name]}", horizon=HORIZON, dt_s=0.2)
    assert_same(ask(predictor, scene, future), ask(again, scene, future))
    other_run = save_random(runs[predictor.name].with_name("other"), seed=1)
    other = load_predictor(f"{predictor.name}:{other_run}", horizon=HORIZON, dt_s=0.2)
    assert np.abs(ask(other, scene, future).states - ask(again, scene, future).states).max() > 0.01


def move(states: np.ndarray, *, angle_rad: float, shift_m: tuple[float, float]) -> np.ndarray:
    """States [x, y, heading, speed] of a world that is turned about the origin, then shifted."""
    cos, sin = np.cos(angle_rad), np.sin(angle_rad)
    x = cos * states[..., 0] - sin * states[..., 1] + shift_m[0]
    y = sin * states[..., 0] + cos * states[..., 1] + shift_m[1]
    heading = wrap_angle(states[..., 2] + angle_rad)
    return np.stack([x, y, heading, states[..., 3]], axis=-1).astype(states.dtype)


def moved(recording: Recording, *, angle_rad: float, shift_m: tuple[float, float]) -> Recording:
    """The same recording in a world that is turned and shifted, without its map."""
    nothing = Ragged.pack([])
    empty = RoadMap(
        name="empty",
        lines=nothing,
        line_types=np.zeros(0, dtype=np.int64),
        drivable=nothing,
        lanes=nothing,
        successors=np.zeros((0, 2), dtype=np.int64),
    )
    states = move(recording.states, angle_rad=angle_rad, shift_m=shift_m)
    return dataclasses.replace(recording, states=states, road_map=empty)
