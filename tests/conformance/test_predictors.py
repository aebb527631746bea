"""What every registered predictor keeps to in what it says."""

import dataclasses

import numpy as np
import pytest

from asp_env.data.classes import PREDICTED
from asp_env.data.predictor import Predictor
from asp_env.data.snippets import Future
from asp_env.dynamics import MAX_ACCELERATION_MPS2, MAX_STEERING_RAD, rollout
from asp_env.dynamics.bicycle import Integrator
from asp_env.errors import AspEnvError
from asp_env.geometry import wrap_angle
from tests.conformance.predictor_cases import (
    LEARNED,
    SEGMENT,
    ask,
    assert_same,
    every,
    everybody,
    situations,
    tried,
)


@every
def test_forecast_has_the_shapes_that_it_promises(predictor: Predictor) -> None:
    """(N, M, T, 4) float32 states, M log-probabilities, and rows that say whom and when."""
    scene, future = situations(predictor)
    forecast = ask(predictor, scene, future)
    n, m = len(scene.targets), forecast.log_probs.shape[1]
    assert forecast.states.shape == (n, m, predictor.horizon, 4)
    assert forecast.actions.shape == (n, m, predictor.horizon, 2)
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
    forecast = ask(predictor, *everybody(predictor))
    np.testing.assert_allclose(np.exp(forecast.log_probs).sum(axis=-1), 1, atol=1e-6)


@every
def test_only_whom_it_can_forecast_is_valid(predictor: Predictor) -> None:
    """Absent agents and other classes are not valid and their rows are zeros.

    The oracle repeats what was recorded, whatever the class.
    """
    scene, future = everybody(predictor)
    forecast = ask(predictor, scene, future)
    at = (scene.targets[:, 0], scene.targets[:, 1])
    seen = scene.valid[at][:, scene.history - predictor.history :].all(axis=-1)
    known = np.isin(scene.classes[at], [int(kind) for kind in PREDICTED])
    np.testing.assert_array_equal(forecast.valid, seen & (known | (predictor.name == "oracle")))
    assert 0 < forecast.valid.sum() < len(forecast.valid)
    assert not forecast.states[~forecast.valid].any()
    assert not forecast.actions[~forecast.valid].any()


@every
def test_garbage_in_invalid_slots_changes_nothing(predictor: Predictor) -> None:
    """NaN in what is not valid leaves every forecast as it was, bit for bit."""
    scene, future = everybody(predictor)
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
def test_more_empty_slots_change_nothing(predictor: Predictor) -> None:
    """Five more slots that hold nothing but NaN leave every forecast as it was, to 1e-5."""
    scene, future = situations(predictor)
    before = ask(predictor, scene, future)

    def padded(array: np.ndarray, value: float) -> np.ndarray:
        return np.pad(array, ((0, 0), (0, 5), *((0, 0),) * (array.ndim - 2)), constant_values=value)

    roomy = dataclasses.replace(
        scene,
        states=padded(scene.states, np.nan),
        actions=padded(scene.actions, np.nan),
        valid=padded(scene.valid, False),
        sizes=padded(scene.sizes, np.nan),
        classes=padded(scene.classes, 0),
        ids=padded(scene.ids, -1),
    )
    after = ask(predictor, roomy, future)
    np.testing.assert_allclose(after.states, before.states, atol=1e-5)
    np.testing.assert_allclose(after.log_probs, before.log_probs, atol=1e-5)


@every
def test_order_of_slots_does_not_matter(predictor: Predictor) -> None:
    """With the agents of each situation shuffled, every target is forecast the same."""
    scene, future = situations(predictor)
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
    scene, future = situations(predictor)
    together = ask(predictor, scene, future)
    for rows in (np.array([17]), np.array([40, 3, 99])):
        some = Future(states=future.states[rows], valid=future.valid[rows])
        alone = ask(predictor, scene.with_targets(scene.targets[rows]), some)
        found, expected = alone.states, together.states[rows]
        np.testing.assert_allclose(found[..., :2], expected[..., :2], atol=1e-5, rtol=1e-6)
        # Headings and speeds of positions are those of steps, and magnify what rounding does.
        np.testing.assert_allclose(found[..., 2:], expected[..., 2:], atol=1e-4)
        np.testing.assert_allclose(alone.log_probs, together.log_probs[rows], atol=1e-5)


@every
def test_what_it_tells_of_itself_cannot_be_changed(predictor: Predictor) -> None:
    """Trained ones name data, view, preset and weights, others nothing; nobody can set it."""
    fields = {"trained_on", "view", "preset", "weights"} if predictor.trained_on else set()
    chained = {"chaining"} if predictor.trained_on and predictor.horizon > SEGMENT else set()
    assert set(predictor.metadata) == fields | chained
    assert all(predictor.metadata.values())
    with pytest.raises(AttributeError):
        vars(type(predictor))["metadata"].__set__(predictor, {})


@every
def test_no_targets_give_an_empty_forecast(predictor: Predictor) -> None:
    """A scene that asks for nobody gets a forecast of nobody."""
    scene, future = situations(predictor)
    nobody = np.zeros((0, 2), dtype=scene.targets.dtype)
    nothing = Future(states=future.states[:0], valid=future.valid[:0])
    forecast = ask(predictor, scene.with_targets(nobody), nothing)
    assert forecast.states.shape[0] == forecast.log_probs.shape[0] == 0


@every
def test_same_scene_gives_the_same_forecast(predictor: Predictor) -> None:
    """Asked twice, bit for bit, and the scene is not written to."""
    scene, future = situations(predictor)
    copies = [scene.states.copy(), scene.actions.copy(), scene.valid.copy()]
    assert_same(ask(predictor, scene, future), ask(predictor, scene, future))
    for copy, array in zip(copies, (scene.states, scene.actions, scene.valid), strict=True):
        np.testing.assert_array_equal(copy, array)


@every
def test_actions_stay_within_limits(predictor: Predictor) -> None:
    """What a predictor chooses is allowed; the oracle's actions were inferred and may exceed.

    One of positions says that it has no actions, for any of its targets.
    """
    scene, future = situations(predictor)
    forecast = ask(predictor, scene, future)
    if not forecast.actions_valid.any():
        assert not forecast.actions.any()
        return
    assert forecast.actions_valid.all()
    if predictor.name != "oracle":
        assert np.abs(forecast.actions[..., 0]).max() <= MAX_ACCELERATION_MPS2 + 1e-6
        assert np.abs(forecast.actions[..., 1]).max() <= MAX_STEERING_RAD + 1e-6


@tried(LEARNED)
def test_states_are_the_rollout_of_the_actions(predictor: Predictor) -> None:
    """Over the whole horizon, to 1e-4: under Heun or under Euler, from where the target is now."""
    scene, future = situations(predictor)
    forecast = ask(predictor, scene, future)
    if not forecast.actions_valid.any():
        return
    at = (scene.targets[:, 0], scene.targets[:, 1])
    start = scene.target_states.astype(np.float64)[:, None].repeat(forecast.states.shape[1], axis=1)
    lengths = scene.sizes[at][:, 0].astype(np.float64)[:, None]
    actions = forecast.actions.astype(np.float64)
    integrators: tuple[Integrator, ...] = ("heun", "euler")
    found = [
        rollout(start, actions, lengths, 0.2, integrator=integrator) - forecast.states
        for integrator in integrators
    ]
    for each in found:
        each[..., 2] = wrap_angle(each[..., 2])
    assert min(np.abs(each).max() for each in found) < 1e-4


@every
def test_scene_of_another_time_step_is_refused(predictor: Predictor) -> None:
    """A predictor for 0.2 s refuses a scene of 0.1 s in one line."""
    scene, future = situations(predictor)
    with pytest.raises(AspEnvError, match=r"time step of 0\.2 s, the scene has 0\.1 s"):
        ask(predictor, dataclasses.replace(scene, dt_s=0.1), future)
