"""Conversion between highway-env's axes and those of this package."""

import numpy as np
import pytest
from hypothesis import given

from asp_env.dynamics import forward
from asp_env.dynamics.bicycle import Integrator
from asp_env.geometry import wrap_angle
from scenarios.highway.road_map import mirror_actions, mirror_points, mirror_states
from tests.dynamics.motions import Motion, motions


def test_by_hand() -> None:
    """A point below highway-env's origin is below it here, and right steering stays right."""
    np.testing.assert_array_equal(mirror_points(np.array([[3.0, 4.0]])), [[3.0, -4.0]])
    down_there = np.array([3.0, 4.0, 0.5 * np.pi, 7.0])
    np.testing.assert_array_equal(mirror_states(down_there), [3.0, -4.0, -0.5 * np.pi, 7.0])
    np.testing.assert_array_equal(mirror_actions(np.array([1.0, 0.2])), [1.0, -0.2])


def test_headings_are_wrapped() -> None:
    """highway-env's headings are not: 1.75 turns become a quarter turn the other way."""
    turned = mirror_states(np.array([0.0, 0.0, 3.5 * np.pi, 1.0]))
    assert turned[2] == pytest.approx(0.5 * np.pi)
    assert mirror_states(np.array([0.0, 0.0, -np.pi, 1.0]))[2] == -np.pi


def test_the_dtype_is_unchanged() -> None:
    """float32 gives float32, and the argument does not change."""
    states = np.ones((2, 3, 4), dtype=np.float32)
    assert mirror_states(states).dtype == np.float32
    assert mirror_points(states[..., :2]).dtype == np.float32
    assert mirror_actions(states[..., :2]).dtype == np.float32
    assert (states == 1).all()


@given(motions())
def test_mirroring_is_its_own_inverse(motion: Motion) -> None:
    again = mirror_states(mirror_states(motion.states))
    np.testing.assert_array_equal(again[:, [0, 1, 3]], motion.states[:, [0, 1, 3]])
    np.testing.assert_allclose(wrap_angle(again[:, 2] - motion.states[:, 2]), 0, atol=1e-12)
    actions = mirror_actions(mirror_actions(motion.actions))
    np.testing.assert_array_equal(actions, motion.actions)
    points = mirror_points(mirror_points(motion.states[:, :2]))
    np.testing.assert_array_equal(points, motion.states[:, :2])


@pytest.mark.parametrize("integrator", ["heun", "euler"])
@given(motions())
def test_the_motion_model_commutes_with_mirroring(integrator: Integrator, motion: Motion) -> None:
    """A step of the mirrored vehicle is the mirrored step."""
    states, actions, lengths = motion.states, motion.actions, motion.lengths_m
    stepped = forward(states, actions, lengths, motion.dt_s, integrator=integrator)
    mirrored = forward(
        mirror_states(states), mirror_actions(actions), lengths, motion.dt_s, integrator=integrator
    )
    gap = mirrored - mirror_states(stepped)
    gap[:, 2] = wrap_angle(gap[:, 2])
    np.testing.assert_allclose(gap, 0, atol=1e-9)
