"""Conversion between actions in m/s² and rad and the action space [-1, 1]."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from asp_env.dynamics import (
    MAX_ACCELERATION_MPS2,
    MAX_STEERING_RAD,
    denormalize_actions,
    normalize_actions,
)

LIMITS = (MAX_ACCELERATION_MPS2, MAX_STEERING_RAD)


def test_conversion_by_hand():
    """±5 m/s² and ±π/4 rad are ±1."""
    physical = np.array([[5.0, -math.pi / 4], [-2.5, math.pi / 8], [0.0, 0.0]])
    normalized = np.array([[1.0, -1.0], [-0.5, 0.5], [0.0, 0.0]])
    assert normalize_actions(physical).tolist() == normalized.tolist()
    assert denormalize_actions(normalized).tolist() == physical.tolist()


def test_actions_beyond_the_limits_are_not_clipped():
    assert normalize_actions(np.array([10.0, -math.pi / 2])).tolist() == [2.0, -2.0]


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@given(acceleration=st.floats(-20, 20), steering=st.floats(-1.5, 1.5))
def test_round_trip(dtype, acceleration, steering):
    """Back within rounding, and of the same type."""
    actions = np.array([acceleration, steering], dtype=dtype)
    back = denormalize_actions(normalize_actions(actions))
    assert back.dtype == dtype
    precision = np.finfo(dtype)
    np.testing.assert_allclose(back, actions, rtol=4 * precision.eps, atol=precision.tiny)


@given(actions=st.lists(st.tuples(st.floats(-1, 1), st.floats(-1, 1)), min_size=1, max_size=5))
def test_bits_of_both_conversions(actions):
    """A product in the type of the actions; a quotient in float64, rounded to that type."""
    normalized = np.array(actions, dtype=np.float32)
    physical = denormalize_actions(normalized)
    assert physical.tobytes() == (normalized * np.array(LIMITS, dtype=np.float32)).tobytes()
    expected = (physical / np.array(LIMITS)).astype(np.float32)
    assert normalize_actions(physical).tobytes() == expected.tobytes()


def test_tensors_are_converted_with_gradients():
    actions = torch.tensor([[2.5, 0.1]], requires_grad=True)
    normalized = normalize_actions(actions)
    assert normalized.dtype == torch.float32
    assert normalized[0, 0].item() == 0.5
    assert denormalize_actions(normalized).tolist()[0] == pytest.approx([2.5, 0.1])
    normalized.sum().backward()
    assert actions.grad is not None
    assert actions.grad[0].tolist() == pytest.approx([0.2, 4 / math.pi])
