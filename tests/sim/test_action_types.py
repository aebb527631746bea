"""Laws of the action types."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from asp_env import ReplayEnv, ReplayVectorEnv
from asp_env.dynamics import MAX_ACCELERATION_MPS2, MAX_STEERING_RAD, forward
from asp_env.errors import AspEnvError
from asp_env.sim.action_types import (
    ACTION_TYPES,
    following_steering,
    from_physical,
    to_physical,
)

NUMBERS = st.floats(-1.0, 1.0, width=32)


@given(NUMBERS, NUMBERS, NUMBERS, NUMBERS, st.sampled_from(ACTION_TYPES))
def test_from_physical_inverts_to_physical(
    first: float, second: float, acceleration: float, steering: float, kind: str
) -> None:
    actions = np.array([[first, second]], dtype=np.float32)
    last = np.array([[2.0 * acceleration, 0.2 * steering]], dtype=np.float32)
    context = last, np.array([0.3 * steering]), 0.2
    physical = to_physical(kind, actions, *context)
    assert (np.abs(physical) <= [[MAX_ACCELERATION_MPS2, MAX_STEERING_RAD + 1e-6]]).all()
    np.testing.assert_allclose(from_physical(kind, physical, *context), actions, atol=2e-5)


def test_numbers_by_hand() -> None:
    actions, last = np.array([[0.5, -0.5]]), np.array([[1.0, 0.1]])
    following = np.array([0.2])
    np.testing.assert_allclose(to_physical("jerk", actions, last, following, 0.2), [[2.0, 0.0]])
    np.testing.assert_allclose(
        to_physical("route", actions, last, following, 0.2), [[2.5, 0.125]], rtol=1e-6
    )


@pytest.mark.parametrize("radius_m", [20.0, -30.0])
def test_following_steering_stays_on_a_circle(radius_m: float) -> None:
    """After 100 m the car is at most 0.3 m beside a circle of that radius."""
    angle = np.arange(0.0, 150.0) / radius_m
    route = np.stack([radius_m * np.sin(angle), radius_m * (1 - np.cos(angle))], axis=-1)[None]
    valid = np.ones(route.shape[:2], dtype=bool)
    state, length = np.array([[0.0, 0.0, 0.0, 5.0]]), np.array([4.5])
    for tick in range(100):
        steering = following_steering(state, length, route, valid, np.array([tick * 1.0]))
        state = forward(state, np.array([[0.0, steering[0]]]), length, 0.2)
    distance = np.hypot(state[0, 0], state[0, 1] - radius_m)
    assert abs(distance - abs(radius_m)) < 0.3


def test_unknown_type() -> None:
    with pytest.raises(AspEnvError, match="route"):
        ReplayEnv(action_type="rout")  # pyright: ignore[reportArgumentType]
    with pytest.raises(AspEnvError, match="action_repeat 0"):
        ReplayEnv(action_repeat=0)


@pytest.mark.parametrize("kind", ACTION_TYPES)
def test_a_held_action_is_the_same_action_in_several_steps(kind: str) -> None:
    options = {"data": "sample:roundabout", "observations": ("state", "route")}
    held = ReplayEnv(action_type=kind, action_repeat=3, **options)  # pyright: ignore[reportArgumentType]
    single = ReplayEnv(action_type=kind, **options)  # pyright: ignore[reportArgumentType]
    held.reset(seed=5)
    single.reset(seed=5)
    rng = np.random.default_rng(0)
    for _ in range(4):
        action = rng.uniform(-0.3, 0.3, 2)
        seen, reward, *_, info = held.step(action)
        rewards, last, last_seen = 0.0, {}, {}
        for _ in range(3):
            last_seen, each, terminated, truncated, last = single.step(action)
            rewards += each
            if terminated or truncated:
                break
        assert reward == pytest.approx(rewards, abs=1e-12)
        assert info["ending"] == last["ending"]
        assert info["progress"] == last["progress"]
        if last["ending"] != "RUNNING":
            return
        for name, value in seen.items():
            np.testing.assert_array_equal(value, last_seen[name])


def test_vector_and_single_environments_agree() -> None:
    options = {
        "data": "sample:roundabout",
        "observations": ("state",),
        "action_type": "route",
        "action_repeat": 2,
    }
    vector = ReplayVectorEnv(3, autoreset_mode="Disabled", **options)  # pyright: ignore[reportArgumentType]
    vector.reset(seed=0)
    actions = np.random.default_rng(1).uniform(-0.2, 0.2, (5, 3, 2))
    singles = [ReplayEnv(**options) for _ in range(3)]  # pyright: ignore[reportArgumentType]
    for b, each in enumerate(singles):
        each.reset(seed=b)
    for action in actions:
        seen, rewards, terminated, truncated, _ = vector.step(action)
        for b, each in enumerate(singles):
            one, reward, *_ = each.step(action[b])
            np.testing.assert_array_equal(seen["state"][b], one["state"])
            assert reward == rewards[b]
        if (terminated | truncated).any():
            return
