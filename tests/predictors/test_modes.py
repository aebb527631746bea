"""The best mode and its losses, worked out by hand."""

import math

import pytest
import torch

from predictors.modes import Assignment, best_mode, classification_loss, regression_loss


def straight_line(end: tuple[float, float], steps: int = 2) -> list[tuple[float, float]]:
    """Positions on the way from the agent to `end`."""
    return [(end[0] * k / steps, end[1] * k / steps) for k in range(1, steps + 1)]


def at(distance_m: float, angle_deg: float) -> tuple[float, float]:
    """A point seen from the agent."""
    angle = math.radians(angle_deg)
    return (distance_m * math.cos(angle), distance_m * math.sin(angle))


CASES = {
    # label end, mode ends, by angle, by distance
    "within 5 degrees wins over nearer": (at(10, 0), (at(10, 6), at(6, 4)), 1, 0),
    "of two within 5 degrees the nearer": (at(10, 0), (at(6, 1), at(9, 4)), 1, 1),
    "none within 5 degrees": (at(10, 0), (at(10, 40), at(10, -20)), 1, 1),
    "exactly behind is far in angle": (at(3, 180), (at(1, 0), at(30, 179)), 1, 0),
    "label of 1.9 m has no direction": (at(1.9, 0), (at(1.9, 6), at(1.0, 0)), 0, 0),
    "label of 2.1 m has one": (at(2.1, 0), (at(2.1, 6), at(1.0, 0)), 1, 0),
    "of equal modes the first": (at(10, 0), (at(9, 0), at(9, 0)), 0, 0),
}


@pytest.mark.parametrize("case", CASES, ids=list(CASES))
@pytest.mark.parametrize("assignment", ["angle", "distance"])
def test_best_mode_of_hand_drawn_cases(case: str, assignment: Assignment) -> None:
    """The mode that the rule names, also when it stands in a batch with all other cases."""
    order = [case, *(name for name in CASES if name != case)]
    positions = torch.tensor([[straight_line(end) for end in CASES[name][1]] for name in order])
    label = torch.tensor([straight_line(CASES[name][0]) for name in order])
    expected = CASES[case][2 if assignment == "angle" else 3]
    assert int(best_mode(positions, label, assignment)[0]) == expected


def test_regression_loss_is_huber_with_h_one() -> None:
    """Errors 0.5, 0, 2, 0 of the best mode: (0.125 + 0 + 1.5 + 0) / 4; other modes do not count."""
    label = torch.zeros(1, 2, 2)
    positions = torch.tensor([[[[9.0, 9.0], [9.0, 9.0]], [[0.5, 0.0], [-2.0, 0.0]]]])
    loss = regression_loss(positions, label, torch.tensor([1]))
    assert float(loss) == pytest.approx(0.40625)


def test_cross_entropy_of_equal_logits_is_log_of_modes() -> None:
    """Three equal modes cost ln 3."""
    loss = classification_loss(torch.zeros(2, 3), torch.tensor([0, 2]))
    assert float(loss) == pytest.approx(math.log(3))


def test_literal_classification_is_minus_the_probability() -> None:
    """Logits (ln 3, 0) give the second mode -1/4, and a hopeless mode no gradient to learn from."""
    logits = torch.tensor([[math.log(3.0), 0.0]])
    assert float(classification_loss(logits, torch.tensor([1]), "softmax")) == pytest.approx(-0.25)
    hopeless = torch.tensor([[30.0, 0.0]], requires_grad=True)
    (literal,) = torch.autograd.grad(
        classification_loss(hopeless, torch.tensor([1]), "softmax"), hopeless
    )
    (real,) = torch.autograd.grad(classification_loss(hopeless, torch.tensor([1])), hopeless)
    assert literal.abs().max() < 1e-9
    assert float(real[0, 1]) == pytest.approx(-1.0)
