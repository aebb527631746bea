"""Laws of every registered predictor: its forecasts, and what it must learn and store."""

import dataclasses
import inspect
from pathlib import Path

import numpy as np
import pytest
import torch

from asp_env.data.classes import PREDICTED
from asp_env.data.predictor import Predictor, load_predictor
from asp_env.data.snippets import Future, gather_future, gather_scene
from asp_env.dynamics import MAX_ACCELERATION_MPS2, MAX_STEERING_RAD, rollout
from asp_env.dynamics.bicycle import Integrator
from asp_env.errors import AspEnvError
from asp_env.geometry import wrap_angle
from predictors.models.network import TrainingProgress
from predictors.training.recipes import RECIPES
from tests.conformance.predictor_cases import (
    RECORDING,
    SEGMENT,
    TRAINED,
    Case,
    all_slots,
    assert_same,
    every,
    forecasts_all_classes,
    has_inferred_actions,
    predict,
    situations,
    snippets,
    with_predictors,
)
from tests.predictors.tiny import draw_samples, make_network, tiny_network, tiny_shape


@every
def test_shapes_and_types_of_a_forecast(predictor: Predictor) -> None:
    """(N, M, T, 4) float32 states, M log-probabilities, and the target and tick of each row."""
    scene, future = situations(predictor)
    forecast = predict(predictor, scene, future)
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
    """For every target, also for those that are not forecast, to 1e-6."""
    forecast = predict(predictor, *all_slots(predictor))
    np.testing.assert_allclose(np.exp(forecast.log_probs).sum(axis=-1), 1, atol=1e-6)


@every
def test_only_predictable_agents_are_valid(predictor: Predictor) -> None:
    """Absent agents and other classes are not valid, and their rows are zeros.

    The oracle and the controls forecast agents of all classes.
    """
    scene, future = all_slots(predictor)
    forecast = predict(predictor, scene, future)
    at = (scene.targets[:, 0], scene.targets[:, 1])
    seen = scene.valid[at][:, scene.history - predictor.history :].all(axis=-1)
    known = np.isin(scene.classes[at], [int(kind) for kind in PREDICTED])
    np.testing.assert_array_equal(forecast.valid, seen & (known | forecasts_all_classes(predictor)))
    assert 0 < forecast.valid.sum() < len(forecast.valid)
    assert not forecast.states[~forecast.valid].any()
    assert not forecast.actions[~forecast.valid].any()


@every
def test_garbage_in_invalid_slots_changes_nothing(predictor: Predictor) -> None:
    """NaN where the scene is not valid does not change the bits of the forecast."""
    scene, future = all_slots(predictor)
    before = predict(predictor, scene, future)
    states, sizes, actions = scene.states.copy(), scene.sizes.copy(), scene.actions.copy()
    states[~scene.valid] = np.nan
    actions[~(scene.valid[..., 1:] & scene.valid[..., :-1])] = np.nan
    absent = ~scene.valid.any(axis=-1)
    assert absent.any()
    sizes[absent] = np.nan
    filled = dataclasses.replace(scene, states=states, sizes=sizes, actions=actions)
    assert_same(before, predict(predictor, filled, future))


@every
def test_more_empty_slots_change_nothing(predictor: Predictor) -> None:
    """Five more slots with NaN do not change the forecast, to 1e-5."""
    scene, future = situations(predictor)
    before = predict(predictor, scene, future)

    def padded(array: np.ndarray, value: float) -> np.ndarray:
        return np.pad(array, ((0, 0), (0, 5), *((0, 0),) * (array.ndim - 2)), constant_values=value)

    larger = dataclasses.replace(
        scene,
        states=padded(scene.states, np.nan),
        actions=padded(scene.actions, np.nan),
        valid=padded(scene.valid, False),
        sizes=padded(scene.sizes, np.nan),
        classes=padded(scene.classes, 0),
        ids=padded(scene.ids, -1),
    )
    after = predict(predictor, larger, future)
    np.testing.assert_allclose(after.states, before.states, atol=1e-5)
    np.testing.assert_allclose(after.log_probs, before.log_probs, atol=1e-5)


@every
def test_order_of_slots_does_not_matter(predictor: Predictor) -> None:
    """Shuffling the agents of each situation does not change the forecasts."""
    scene, future = situations(predictor)
    order = np.random.default_rng(0).permutation(scene.ids.shape[1])
    slots = np.argsort(order)
    shuffled = dataclasses.replace(
        scene,
        states=scene.states[:, order],
        actions=scene.actions[:, order],
        valid=scene.valid[:, order],
        sizes=scene.sizes[:, order],
        classes=scene.classes[:, order],
        ids=scene.ids[:, order],
        targets=np.stack([scene.targets[:, 0], slots[scene.targets[:, 1]]], axis=-1),
    )
    assert_same(predict(predictor, scene, future), predict(predictor, shuffled, future))


@every
def test_targets_do_not_influence_each_other(predictor: Predictor) -> None:
    """One target alone, or a few in another order, is forecast as among all targets, to 1e-5.

    The shuffled oracle is the exception.
    """
    if predictor.name == "shuffled-oracle":
        return
    scene, future = situations(predictor)
    together = predict(predictor, scene, future)
    for rows in (np.array([17]), np.array([40, 3, 99])):
        some = Future(states=future.states[rows], valid=future.valid[rows])
        alone = predict(predictor, scene.with_targets(scene.targets[rows]), some)
        found, expected = alone.states, together.states[rows]
        np.testing.assert_allclose(found[..., :2], expected[..., :2], atol=1e-5, rtol=1e-6)
        # Headings and speeds derived from positions amplify rounding errors.
        np.testing.assert_allclose(found[..., 2:], expected[..., 2:], atol=1e-4)
        np.testing.assert_allclose(alone.log_probs, together.log_probs[rows], atol=1e-5)


@every
def test_metadata_is_complete_and_read_only(predictor: Predictor) -> None:
    """Trained predictors name data, view, preset and weights, others nothing.

    Those that the command `train` made also name their histories.
    """
    fields = {"trained_on", "view", "preset", "weights"} if predictor.trained_on else set()
    chained = {"chaining"} if predictor.trained_on and predictor.horizon > SEGMENT else set()
    assert set(predictor.metadata) - {"history"} == fields | chained
    assert all(predictor.metadata.values())
    with pytest.raises(AttributeError):
        inspect.getattr_static(predictor, "metadata").__set__(predictor, {})


@every
def test_a_longer_history_changes_nothing(predictor: Predictor) -> None:
    """Ticks before the predictor's own history do not matter, to 1e-5."""
    longer = snippets(predictor.horizon, predictor.history + 4)
    needed = dataclasses.replace(longer, history=predictor.history)
    assert len(longer) > 20
    forecasts = [
        predict(predictor, gather_scene([RECORDING], index), gather_future([RECORDING], index))
        for index in (longer, needed)
    ]
    found, expected = (each.states for each in forecasts)
    np.testing.assert_allclose(found, expected, atol=1e-5, rtol=1e-6)
    np.testing.assert_allclose(forecasts[0].log_probs, forecasts[1].log_probs, atol=1e-5)


@every
def test_no_targets_give_an_empty_forecast(predictor: Predictor) -> None:
    scene, future = situations(predictor)
    no_targets = np.zeros((0, 2), dtype=scene.targets.dtype)
    nothing = Future(states=future.states[:0], valid=future.valid[:0])
    forecast = predict(predictor, scene.with_targets(no_targets), nothing)
    assert forecast.states.shape[0] == forecast.log_probs.shape[0] == 0


@every
def test_same_scene_gives_the_same_forecast(predictor: Predictor) -> None:
    """Called twice, bit for bit, and the scene is not modified."""
    scene, future = situations(predictor)
    copies = [scene.states.copy(), scene.actions.copy(), scene.valid.copy()]
    assert_same(predict(predictor, scene, future), predict(predictor, scene, future))
    for copy, array in zip(copies, (scene.states, scene.actions, scene.valid), strict=True):
        np.testing.assert_array_equal(copy, array)


@every
def test_actions_stay_within_limits(predictor: Predictor) -> None:
    """Actions that are inferred from recorded states may exceed the limits.

    A predictor of positions has no valid actions for any target.
    """
    scene, future = situations(predictor)
    forecast = predict(predictor, scene, future)
    if not forecast.actions_valid.any():
        assert not forecast.actions.any()
        return
    assert forecast.actions_valid.all()
    if not has_inferred_actions(predictor):
        assert np.abs(forecast.actions[..., 0]).max() <= MAX_ACCELERATION_MPS2 + 1e-6
        assert np.abs(forecast.actions[..., 1]).max() <= MAX_STEERING_RAD + 1e-6


@with_predictors(TRAINED)
def test_states_are_the_rollout_of_the_actions(predictor: Predictor) -> None:
    """Over the whole horizon, to 1e-4, under Heun or under Euler, from the present state."""
    scene, future = situations(predictor)
    forecast = predict(predictor, scene, future)
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
    scene, future = situations(predictor)
    with pytest.raises(AspEnvError, match=r"time step of 0\.2 s, the scene has 0\.1 s"):
        predict(predictor, dataclasses.replace(scene, dt_s=0.1), future)


@pytest.mark.parametrize("case", TRAINED, ids=[case.label for case in TRAINED])
def test_loading_again_yields_the_same_forecasts(case: Case, folder: Path) -> None:
    """Two loads of one folder yield the same bits; other weights do not."""
    name = case.save(folder)
    one, again = (load_predictor(name, horizon=case.horizon, dt_s=0.2) for _ in range(2))
    scene, future = situations(one)
    assert_same(predict(one, scene, future), predict(again, scene, future))
    name = case.save(folder / "other", seed=1)
    other = load_predictor(name, horizon=case.horizon, dt_s=0.2)
    difference = predict(other, scene, future).states - predict(again, scene, future).states
    assert np.abs(difference).max() > 0.01


@pytest.mark.parametrize("name", RECIPES)
def test_overfits_four_snippets(name: str) -> None:
    """After 150 steps the most probable mode is within 1 m of four labels at every tick.

    Modes are assigned by angle, since drawing them at random takes longer to converge.
    """
    sizes = {"features": 32, "gru_width": 32, "hidden": 64}
    config = tiny_network(name, assignment="angle")
    config = dataclasses.replace(
        config, **{k: v for k, v in sizes.items() if getattr(config, k, 0)}
    )
    network = make_network(name, config, tiny_shape())
    batch, labels = draw_samples([8, 30, 41, 55], later_ticks=network.later_ticks)
    optimizer = torch.optim.Adam(network.parameters(), lr=1e-2)
    falling = torch.optim.lr_scheduler.LinearLR(
        optimizer, start_factor=1.0, end_factor=0.0, total_iters=150
    )
    for _ in range(150):
        optimizer.zero_grad()
        network.training_loss(batch, labels, TrainingProgress())["loss"].backward()
        optimizer.step()
        network.after_step()
        falling.step()
    with torch.no_grad():
        modes = network(batch)
    chosen = modes.states[torch.arange(4), modes.logits.argmax(dim=1)]
    error = torch.linalg.vector_norm(chosen[..., :2] - labels.states[..., :2], dim=-1)
    assert float(error.max()) < 1
