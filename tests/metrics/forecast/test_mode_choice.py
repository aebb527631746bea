"""The best mode by three rules, for NumPy and torch."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from asp_env.metrics.forecast.errors import MODE_RULES, ModeRule, best_mode
from predictors.models.losses import best_mode as trained_mode

STEPS = np.arange(1, 5)[:, None]


def towards(angle_deg: float, *, step_m: float = 2.0) -> np.ndarray:
    """Positions at four ticks on a straight line from the target at an angle."""
    angle = math.radians(angle_deg)
    return step_m * STEPS * np.array([math.cos(angle), math.sin(angle)])


def chosen(modes: list[np.ndarray], truth: np.ndarray, rule: ModeRule, **options) -> int:
    """The best mode of a single target."""
    return int(best_mode(np.stack(modes)[None], truth[None], rule, **options)[0])


def test_each_rule_chooses_another_mode() -> None:
    """The truth is 8 m straight on. Mode 0 ends right after a detour of 3 m, with a mean of 2.25 m.

    Mode 1 is 10° off: 8 m · 2 sin 5° = 1.39 m at the end, 0.87 m on average. Mode 2 is within 5°
    but 1 m short at every tick: 1 m at the end and on average.
    """
    detour = towards(0) + np.array([(0, 3), (0, 3), (0, 3), (0, 0)])
    short = towards(0) - np.array([1.0, 0.0])
    modes = [detour, towards(10), short]
    assert chosen(modes, towards(0), "fde") == 0
    assert chosen(modes, towards(0), "ade") == 1
    assert chosen(modes, towards(0), "paper") == 2


def test_without_a_mode_within_five_degrees_the_lowest_mean_is_chosen() -> None:
    """8° to the right is nearer than 10° to the left."""
    assert chosen([towards(10), towards(-8)], towards(0), "paper") == 1


@pytest.mark.parametrize(("angle_deg", "mode"), [(4.9, 1), (5.1, 0)])
def test_the_limit_is_five_degrees(angle_deg: float, mode: int) -> None:
    """A mode that goes 1.5 times as far is chosen for its direction, up to 5°."""
    far = towards(angle_deg, step_m=3.0)
    near = towards(20.0)
    assert chosen([near, far], towards(0), "paper") == mode


def test_short_truths_have_no_direction() -> None:
    """A truth that ends 1.6 m away, under 2 m: only the mean decides."""
    truth = towards(0, step_m=0.4)
    assert chosen([towards(0, step_m=3.0), towards(90, step_m=0.4)], truth, "paper") == 1


@pytest.mark.parametrize("rule", MODE_RULES)
def test_only_allowed_modes_are_chosen(rule: ModeRule) -> None:
    """The right mode is not allowed; of the equally good next ones the first is chosen."""
    modes = [towards(30), towards(0), towards(20), towards(20)]
    among = np.array([[True, False, True, True]])
    assert chosen(modes, towards(0), rule, among=among) == 2


@given(seed=st.integers(0, 10**6), rule=st.sampled_from(sorted(MODE_RULES)))
def test_numpy_torch_and_training_agree(seed: int, rule: ModeRule) -> None:
    rng = np.random.default_rng(seed)
    scale = rng.choice([0.2, 5.0], size=(40, 1, 1, 1))
    modes = np.cumsum(rng.normal(1, 1, (40, 3, 6, 2)), axis=2) * scale
    truth = np.cumsum(rng.normal(1, 1, (40, 6, 2)), axis=1) * scale[:, 0]
    found = best_mode(modes, truth, rule)
    tensors = torch.from_numpy(modes), torch.from_numpy(truth)
    assert best_mode(*tensors, rule).tolist() == found.tolist()
    if rule != "fde":
        assignment = "angle" if rule == "paper" else "distance"
        assert trained_mode(*tensors, assignment).tolist() == found.tolist()
