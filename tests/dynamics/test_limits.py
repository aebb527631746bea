"""Limits of actions."""

import math

import numpy as np
import torch

from asp_env.dynamics import clip_actions

ACTIONS = [(0.0, 0.0), (4.9, -0.7), (5.1, 0.9), (-80.0, -3.0)]
ALLOWED = [(0.0, 0.0), (4.9, -0.7), (5.0, math.pi / 4), (-5.0, -math.pi / 4)]


def test_limits() -> None:
    """±5 m/s² and ±π/4; actions within the limits do not change."""
    np.testing.assert_array_equal(clip_actions(np.array(ACTIONS)), ALLOWED)


def test_limits_in_torch() -> None:
    """Tensors keep their dtype and pass gradients where nothing is clipped."""
    actions = torch.tensor(ACTIONS, dtype=torch.float32, requires_grad=True)
    clipped = clip_actions(actions)
    assert clipped.dtype == torch.float32
    np.testing.assert_allclose(clipped.detach().numpy(), ALLOWED, rtol=1e-6)
    (gradient,) = torch.autograd.grad(clipped.sum(), actions)
    np.testing.assert_array_equal(gradient.numpy(), [(1, 1), (1, 1), (0, 0), (0, 0)])
