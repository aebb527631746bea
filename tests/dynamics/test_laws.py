"""Laws of the bicycle model on generated motions."""

import math
from typing import Literal

import hypothesis.strategies as st
import numpy as np
import pytest
import torch
from hypothesis import given

from asp_env.dynamics import MAX_STEERING_RAD, forward, inverse, rollout
from tests.dynamics.motions import ROWS, Motion, apart, between, extremes, motions

Integrator = Literal["heun", "euler"]
INTEGRATORS: tuple[Integrator, ...] = ("heun", "euler")

both = pytest.mark.parametrize("integrator", INTEGRATORS)


def step(motion: Motion, integrator: Integrator = "heun", *, reverse: bool = True) -> np.ndarray:
    """States one tick later."""
    return forward(
        motion.states,
        motion.actions,
        motion.lengths_m,
        motion.dt_s,
        integrator=integrator,
        reverse=reverse,
    )


@both
@given(motion=motions())
def test_inverse_undoes_forward(integrator: Integrator, motion: Motion) -> None:
    """Away from standstill, forwards or backwards, actions are recovered to 1e-9."""
    after = step(motion, integrator)
    found = inverse(motion.states, after, motion.lengths_m, motion.dt_s, integrator=integrator)
    np.testing.assert_allclose(found, motion.actions, atol=1e-9, rtol=0)


@given(motion=motions(), elsewhere=between(-500, 500, ROWS, 2))
def test_inverse_ignores_positions(motion: Motion, elsewhere: np.ndarray) -> None:
    after = step(motion)
    moved = np.concatenate([elsewhere, after[:, 2:]], axis=1)
    actions, others = (
        inverse(motion.states, states, motion.lengths_m, motion.dt_s) for states in (after, moved)
    )
    np.testing.assert_array_equal(actions, others)


@both
@pytest.mark.parametrize("reverse", [False, True])
@given(motion=extremes(), dtype=st.sampled_from([np.float32, np.float64]))
def test_never_nan(integrator: Integrator, reverse: bool, motion: Motion, dtype: type) -> None:
    """Finite inputs give finite outputs, in NumPy and torch."""
    states, actions = motion.states.astype(dtype), motion.actions.astype(dtype)
    lengths = motion.lengths_m.astype(dtype)
    after = forward(states, actions, lengths, motion.dt_s, integrator=integrator, reverse=reverse)
    assert np.isfinite(after).all()
    assert reverse or (after[:, 3] >= np.minimum(states[:, 3], 0)).all()
    back = inverse(states, states[::-1], lengths, motion.dt_s, integrator=integrator)
    assert np.isfinite(back).all()
    assert (np.abs(back[:, 1]) <= MAX_STEERING_RAD * (1 + 1e-6)).all()
    now, chosen, sizes = (torch.from_numpy(array) for array in (states, actions, lengths))
    later = forward(now, chosen, sizes, motion.dt_s, integrator=integrator, reverse=reverse)
    assert later.isfinite().all()
    undone = inverse(now, now.flip(0), sizes, motion.dt_s, integrator=integrator)
    assert undone.isfinite().all()


@both
@pytest.mark.parametrize("reverse", [False, True])
@given(states=between(-20, 20, 3, 4), actions=between(-5, 5, 3, 12, 2), lengths=between(1, 18, 3))
def test_rollout_is_repeated_forward(
    integrator: Integrator,
    reverse: bool,
    states: np.ndarray,
    actions: np.ndarray,
    lengths: np.ndarray,
) -> None:
    """Cumulative sums give the same as stepping, also through standstill."""
    at_once = rollout(states, actions, lengths, 0.2, integrator=integrator, reverse=reverse)
    for k in range(actions.shape[1]):
        states = forward(
            states, actions[:, k], lengths, 0.2, integrator=integrator, reverse=reverse
        )
        assert apart(at_once[:, k], states) < 1e-8


@both
@given(motion=motions())
def test_numpy_equals_torch(integrator: Integrator, motion: Motion) -> None:
    after = step(motion, integrator)
    states, actions, lengths = (
        torch.from_numpy(array) for array in (motion.states, motion.actions, motion.lengths_m)
    )
    tensor = forward(states, actions, lengths, motion.dt_s, integrator=integrator, reverse=True)
    assert apart(after, tensor.numpy()) < 1e-9
    back = inverse(states, tensor, lengths, motion.dt_s, integrator=integrator)
    again = inverse(motion.states, after, motion.lengths_m, motion.dt_s, integrator=integrator)
    np.testing.assert_allclose(back.numpy(), again, atol=1e-9, rtol=0)


@given(motion=motions())
def test_float32_stays_float32(motion: Motion) -> None:
    """Outputs have the dtype of the inputs, and float32 agrees with float64 to a millimetre."""
    narrow = Motion(
        states=motion.states.astype(np.float32),
        actions=motion.actions.astype(np.float32),
        lengths_m=motion.lengths_m.astype(np.float32),
        dt_s=motion.dt_s,
    )
    after = step(narrow)
    assert after.dtype == np.float32
    assert apart(after.astype(np.float64), step(motion)) < 1e-3
    assert inverse(narrow.states, after, narrow.lengths_m, motion.dt_s).dtype == np.float32
    states, actions, lengths = (
        torch.from_numpy(array) for array in (narrow.states, narrow.actions, narrow.lengths_m)
    )
    assert forward(states, actions, lengths, motion.dt_s).dtype == torch.float32


@given(motion=motions(forwards=True), shift=between(-300, 300, 2), turn=st.floats(-7, 7))
def test_equivariance(motion: Motion, shift: np.ndarray, turn: float) -> None:
    """Rotating and translating the states, then driving, equals driving, then doing so."""
    cos, sin = math.cos(turn), math.sin(turn)

    def moved(states: np.ndarray) -> np.ndarray:
        xy = states[:, :2] @ np.array([(cos, sin), (-sin, cos)]) + shift
        return np.concatenate([xy, states[:, 2:3] + turn, states[:, 3:]], axis=1)

    elsewhere = Motion(
        states=moved(motion.states),
        actions=motion.actions,
        lengths_m=motion.lengths_m,
        dt_s=motion.dt_s,
    )
    assert apart(step(elsewhere), moved(step(motion))) < 1e-9


@given(motion=motions(), other=motions())
def test_rows_are_independent(motion: Motion, other: Motion) -> None:
    """A vehicle's motion does not depend on the other rows of the batch."""
    mixed = Motion(
        states=np.concatenate([motion.states[:1], other.states[1:]]),
        actions=np.concatenate([motion.actions[:1], other.actions[1:]]),
        lengths_m=np.concatenate([motion.lengths_m[:1], other.lengths_m[1:]]),
        dt_s=motion.dt_s,
    )
    assert apart(step(mixed)[0], step(motion)[0]) < 1e-12


@pytest.mark.parametrize("shape", [(), (0,), (8,), (2, 4), (2, 1, 4)])
def test_any_batch_axes(shape: tuple[int, ...]) -> None:
    """Leading axes only arrange the rows."""
    rng = np.random.default_rng(0)
    motion = Motion(
        states=rng.uniform(-3, 3, (ROWS, 4)),
        actions=rng.uniform(-0.7, 0.7, (ROWS, 2)),
        lengths_m=rng.uniform(3, 18, ROWS),
        dt_s=0.2,
    )
    count = math.prod(shape)

    def arranged(array: np.ndarray) -> np.ndarray:
        return np.reshape(array[:count], shape + array.shape[1:])

    states, actions, lengths = map(arranged, (motion.states, motion.actions, motion.lengths_m))
    after = forward(states, actions, lengths, 0.2, reverse=True)
    assert after.shape == (*shape, 4)
    assert apart(after, arranged(step(motion))) < 1e-12
    several = np.repeat(actions[..., None, :], 3, axis=-2)
    assert rollout(states, several, lengths, 0.2).shape == (*shape, 3, 4)
    assert inverse(states, after, lengths, 0.2).shape == (*shape, 2)


@given(motion=motions(forwards=True))
def test_braking_ends_at_rest(motion: Motion) -> None:
    """28 m/s end within 5.6 s at -5 m/s²; then nothing changes, braking or not."""
    braking = np.broadcast_to([-5.0, 0.1], (ROWS, 28, 2))
    stopped = rollout(motion.states, braking, motion.lengths_m, 0.2)[:, -1]
    assert (stopped[:, 3] == 0).all()
    for held in (braking, 0.0 * braking):
        later = rollout(stopped, held, motion.lengths_m, 0.2)
        assert (later[..., 3] == 0).all()
        assert apart(later, np.broadcast_to(stopped[:, None], later.shape)) < 1e-12


@both
@given(states=between(0, 20, 3, 4), actions=between(-5, 5, 3, 12, 2), lengths=between(1, 18, 3))
def test_a_reversing_neighbour_changes_no_bit(
    integrator: Integrator, states: np.ndarray, actions: np.ndarray, lengths: np.ndarray
) -> None:
    """Rollouts of forward starts are the same beside one that drives backwards, also in torch."""
    alone = rollout(states, actions, lengths, 0.2, integrator=integrator)
    backwards = np.concatenate([states, [[0.0, 0.0, 0.0, -2.0]]])
    both_actions, sizes = np.concatenate([actions, actions[:1]]), np.append(lengths, 4.0)
    together = rollout(backwards, both_actions, sizes, 0.2, integrator=integrator)
    assert together[:3].tobytes() == alone.tobytes()
    start, held, lengths_m = (torch.from_numpy(array) for array in (backwards, both_actions, sizes))
    in_torch = rollout(start, held, lengths_m, 0.2, integrator=integrator)
    assert apart(in_torch.numpy(), together) < 1e-9


@both
@pytest.mark.parametrize("reverse", [False, True])
def test_gradient_at_zero(integrator: Integrator, reverse: bool) -> None:
    """At standstill with straight wheels every derivative is finite."""
    states = torch.zeros(2, 4, dtype=torch.float64, requires_grad=True)
    actions = torch.zeros(2, 5, 2, dtype=torch.float64, requires_grad=True)
    lengths = torch.full((2,), 4.0, dtype=torch.float64)
    after = rollout(states, actions, lengths, 0.2, integrator=integrator, reverse=reverse)
    back = inverse(after[:, :-1], after[:, 1:], lengths[:, None], 0.2, integrator=integrator)
    for result in (after, back):
        gradients = torch.autograd.grad(result.sum(), (states, actions), retain_graph=True)
        assert all(gradient.isfinite().all() for gradient in gradients)


def test_gradient_by_hand() -> None:
    """In a tick of 0.2 s at 10 m/s, dx/da = 0.2²/2 = 0.02 and dθ/dδ = 10·0.2·0.5/1.2 = 5/6."""
    states = torch.tensor([0.0, 0.0, 0.0, 10.0], dtype=torch.float64)
    actions = torch.zeros(2, dtype=torch.float64, requires_grad=True)
    after = forward(states, actions, torch.tensor(4.0, dtype=torch.float64), 0.2)
    by_acceleration = torch.autograd.grad(after[0], actions, retain_graph=True)[0][0]
    by_steering = torch.autograd.grad(after[2], actions)[0][1]
    assert float(by_acceleration) == pytest.approx(0.02, abs=1e-12)
    assert float(by_steering) == pytest.approx(5 / 6, abs=1e-12)


@pytest.mark.parametrize(("integrator", "order"), [("heun", 2), ("euler", 1)])
@given(
    acceleration=st.floats(0.5, 2.0),
    steering=st.floats(0.1, 0.4),
    side=st.sampled_from([-1.0, 1.0]),
)
def test_order_of_convergence(
    integrator: Integrator, order: int, acceleration: float, steering: float, side: float
) -> None:
    """Halving the step divides the error after 2 s by 4 with Heun, by 2 with Euler."""

    def end(steps: int, by: Integrator) -> np.ndarray:
        actions = np.broadcast_to([acceleration, side * steering], (steps, 2))
        start = np.array([0.0, 0.0, 0.0, 5.0])
        return rollout(start, actions, np.array(4.5), 2 / steps, integrator=by)[-1, :2]

    truth = end(8_000, "heun")
    coarse, fine = (np.hypot(*(end(steps, integrator) - truth)) for steps in (40, 80))
    assert math.log2(coarse / fine) == pytest.approx(order, abs=0.15)
