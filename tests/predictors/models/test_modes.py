"""The best mode and its losses, worked out by hand."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from asp_env.geometry import from_frame
from predictors.models.losses import (
    Assignment,
    Classification,
    annealed_loss,
    best_mode,
    best_or_random_mode,
    classification_loss,
    into_frame,
    mode_terms,
    regression_loss,
)


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


def two_modes() -> tuple[torch.Tensor, torch.Tensor]:
    """One tick, label at (10, 0), modes off by (1, 0) and by (3, 4).

    Distances are 1 and 5, and Huber losses (0.5 + 0) / 2 = 0.25 and (2.5 + 3.5) / 2 = 3.
    """
    return torch.tensor([[[[11.0, 0.0]], [[13.0, 4.0]]]]), torch.tensor([[[10.0, 0.0]]])


@pytest.mark.parametrize(
    ("share", "temperature_m", "expected"),
    [(0.0, 8.0, 1.288237), (0.25, 4.0, 0.989588), (0.375, 2.0, 0.577808), (0.4, 1.6, 0.458610)],
)
def test_annealed_loss_by_hand(share: float, temperature_m: float, expected: float) -> None:
    """The temperature falls from 8 m to 0 at half-way; weights are sigmoids of 4 m over it."""
    nearer = 1 / (1 + math.exp(-4 / temperature_m))
    assert nearer * 0.25 + (1 - nearer) * 3 == pytest.approx(expected, abs=1e-5)
    positions, label = two_modes()
    loss = annealed_loss(positions, label, torch.tensor([0]), share)
    assert float(loss) == pytest.approx(expected, abs=1e-5)


@pytest.mark.parametrize("share", [0.499, 0.5, 0.8, 1.0])
def test_annealing_ends_with_the_best_mode_alone(share: float) -> None:
    """From half of the training on it is the plain loss, also where the best is not the nearest."""
    positions, label = two_modes()
    best = torch.tensor([1])
    expected = regression_loss(positions, label, best)
    assert torch.equal(annealed_loss(positions, label, best, share), expected)


def test_annealing_teaches_every_mode_at_first() -> None:
    """At the start the farther mode gets a gradient, without annealing it gets none."""
    for share, learns in ((0.0, True), (None, False)):
        positions, label = two_modes()
        positions.requires_grad_()
        terms = mode_terms(
            positions,
            torch.zeros(1, 2),
            label,
            assignment="distance",
            classification="cross-entropy",
            share=share,
        )
        (gradient,) = torch.autograd.grad(terms["regression"], positions)
        assert bool(gradient[0, 1].any()) == learns
        assert bool(gradient[0, 0].any())


def test_mode_terms_are_those_of_the_best_mode() -> None:
    """Mode 0 is the best: 0.25, and -ln or minus its probability of 1/4."""
    positions, label = two_modes()
    logits = torch.tensor([[0.0, math.log(3.0)]])
    cases: tuple[tuple[Classification, float], ...]
    cases = (("cross-entropy", math.log(4.0)), ("softmax", -0.25))
    for kind, expected in cases:
        terms = mode_terms(
            positions, logits, label, assignment="angle", classification=kind, share=None
        )
        assert float(terms["regression"]) == pytest.approx(0.25)
        assert float(terms["classification"]) == pytest.approx(expected)


def test_into_frame_by_hand() -> None:
    """Seen from (1, 2) heading north, (1, 5) lies 3 m ahead and (0, 2) lies 1 m to the left."""
    points = torch.tensor([[[1.0, 5.0], [0.0, 2.0]]])
    seen = into_frame(points, torch.tensor([[1.0, 2.0, math.pi / 2, 7.0]]))
    torch.testing.assert_close(seen, torch.tensor([[[3.0, 0.0], [0.0, 1.0]]]), atol=1e-6, rtol=0)


@given(
    x=st.floats(-50, 50),
    y=st.floats(-50, 50),
    heading=st.floats(-3, 3),
    ahead=st.floats(-50, 50),
    left=st.floats(-50, 50),
)
def test_into_frame_undoes_from_frame(
    x: float, y: float, heading: float, ahead: float, left: float
) -> None:
    """What lies ahead and to the left of a pose is found there again, to 1e-4 m."""
    origin = np.array([x, y, heading, 0.0])
    point = from_frame(np.array([[ahead, left]]), origin[None])
    seen = into_frame(torch.tensor(point)[None], torch.tensor(origin)[None])
    np.testing.assert_allclose(seen[0, 0], [ahead, left], atol=1e-4)


def test_chance_decides_only_where_no_mode_is_within_5_degrees() -> None:
    """Of 300 labels 40° aside each of three modes gets a fair share; others are as by angle."""
    ends = [at(10, 0), at(9, 1), at(5, -10)]
    count = 300
    positions = torch.tensor([[straight_line(end) for end in ends]]).repeat(count, 1, 1, 1)
    aside = torch.tensor([straight_line(at(8 + 0.01 * k, 40)) for k in range(count)])
    shares = best_or_random_mode(positions, aside).bincount(minlength=3) / count
    np.testing.assert_allclose(shares, 1 / 3, atol=0.1)
    assert torch.equal(best_or_random_mode(positions, aside), best_or_random_mode(positions, aside))
    near = torch.tensor([straight_line(at(9, 2))]).repeat(count, 1, 1)
    assert torch.equal(best_or_random_mode(positions, near), best_mode(positions, near))
    standing = torch.tensor([straight_line(at(1, 120))]).repeat(count, 1, 1)
    assert torch.equal(best_or_random_mode(positions, standing), best_mode(positions, standing))


def test_losses_alone_leave_it_to_chance() -> None:
    """Matching by `angle-random` is that by angle; its losses are those of the drawn mode."""
    positions = torch.tensor([[straight_line(at(10, 0)), straight_line(at(9, 10))]])
    for k in range(8):
        label = torch.tensor([straight_line(at(8 + k, 40))])
        assert torch.equal(
            best_mode(positions, label, "angle-random"), best_mode(positions, label, "angle")
        )
        terms = mode_terms(
            positions,
            torch.zeros(1, 2),
            label,
            assignment="angle-random",
            classification="cross-entropy",
            share=None,
        )
        drawn = best_or_random_mode(positions, label)
        assert torch.equal(terms["regression"], regression_loss(positions, label, drawn))
