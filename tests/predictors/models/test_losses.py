"""The best mode and its losses, against numbers derived by hand."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from asp_env.geometry import from_frame
from predictors.models import losses
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
    """Positions on the line from the target to `end`."""
    return [(end[0] * k / steps, end[1] * k / steps) for k in range(1, steps + 1)]


def polar(distance_m: float, angle_deg: float) -> tuple[float, float]:
    """A point at a distance and an angle from the target."""
    angle = math.radians(angle_deg)
    return (distance_m * math.cos(angle), distance_m * math.sin(angle))


CASES = {
    # end of the label, ends of the modes, best mode by angle, best mode by distance
    "within 5 degrees wins over nearer": (polar(10, 0), (polar(10, 6), polar(6, 4)), 1, 0),
    "of two within 5 degrees the nearer": (polar(10, 0), (polar(6, 1), polar(9, 4)), 1, 1),
    "none within 5 degrees": (polar(10, 0), (polar(10, 40), polar(10, -20)), 1, 1),
    "exactly behind is far in angle": (polar(3, 180), (polar(1, 0), polar(30, 179)), 1, 0),
    "label of 1.9 m has no direction": (polar(1.9, 0), (polar(1.9, 6), polar(1.0, 0)), 0, 0),
    "label of 2.1 m has one": (polar(2.1, 0), (polar(2.1, 6), polar(1.0, 0)), 1, 0),
    "of equal modes the first": (polar(10, 0), (polar(9, 0), polar(9, 0)), 0, 0),
}


@pytest.mark.parametrize("case", CASES, ids=list(CASES))
@pytest.mark.parametrize("assignment", ["angle", "distance"])
def test_best_mode_of_hand_drawn_cases(case: str, assignment: Assignment) -> None:
    """The best mode does not depend on the other targets of the batch."""
    order = [case, *(name for name in CASES if name != case)]
    positions = torch.tensor([[straight_line(end) for end in CASES[name][1]] for name in order])
    label = torch.tensor([straight_line(CASES[name][0]) for name in order])
    expected = CASES[case][2 if assignment == "angle" else 3]
    assert int(best_mode(positions, label, assignment)[0]) == expected


def test_regression_loss_is_huber_with_h_one() -> None:
    """Errors 0.5, 0, 2, 0 of the best mode: (0.125 + 0 + 1.5 + 0) / 4; no other mode counts."""
    label = torch.zeros(1, 2, 2)
    positions = torch.tensor([[[[9.0, 9.0], [9.0, 9.0]], [[0.5, 0.0], [-2.0, 0.0]]]])
    loss = regression_loss(positions, label, torch.tensor([1]))
    assert float(loss) == pytest.approx(0.40625)


def test_cross_entropy_of_equal_logits_is_log_of_modes() -> None:
    loss = classification_loss(torch.zeros(2, 3), torch.tensor([0, 2]))
    assert float(loss) == pytest.approx(math.log(3))


def test_literal_classification_is_minus_the_probability() -> None:
    """Logits (ln 3, 0) give -1/4 for the second mode; an improbable mode gets no gradient."""
    logits = torch.tensor([[math.log(3.0), 0.0]])
    assert float(classification_loss(logits, torch.tensor([1]), "softmax")) == pytest.approx(-0.25)
    improbable = torch.tensor([[30.0, 0.0]], requires_grad=True)
    (literal,) = torch.autograd.grad(
        classification_loss(improbable, torch.tensor([1]), "softmax"), improbable
    )
    (cross_entropy,) = torch.autograd.grad(
        classification_loss(improbable, torch.tensor([1])), improbable
    )
    assert literal.abs().max() < 1e-9
    assert float(cross_entropy[0, 1]) == pytest.approx(-1.0)


def two_modes() -> tuple[torch.Tensor, torch.Tensor]:
    """One tick, a label at (10, 0), and modes at an offset of (1, 0) and (3, 4).

    Distances are 1 and 5; Huber losses are (0.5 + 0) / 2 = 0.25 and (2.5 + 3.5) / 2 = 3.
    """
    return torch.tensor([[[[11.0, 0.0]], [[13.0, 4.0]]]]), torch.tensor([[[10.0, 0.0]]])


@pytest.mark.parametrize(
    ("share", "temperature_m", "expected"),
    [(0.0, 8.0, 1.288237), (0.25, 4.0, 0.989588), (0.375, 2.0, 0.577808), (0.4, 1.6, 0.458610)],
)
def test_annealed_loss_by_hand(share: float, temperature_m: float, expected: float) -> None:
    """Weights are sigmoids of 4 m over the temperature, which falls from 8 m to 0 at half-way."""
    nearer = 1 / (1 + math.exp(-4 / temperature_m))
    assert nearer * 0.25 + (1 - nearer) * 3 == pytest.approx(expected, abs=1e-5)
    positions, label = two_modes()
    loss = annealed_loss(positions, label, torch.tensor([0]), share)
    assert float(loss) == pytest.approx(expected, abs=1e-5)


@pytest.mark.parametrize("share", [0.499, 0.5, 0.8, 1.0])
def test_annealing_ends_with_only_the_best_mode(share: float) -> None:
    """From half of the training on the loss is that of the best mode, even if it is not nearest."""
    positions, label = two_modes()
    best = torch.tensor([1])
    expected = regression_loss(positions, label, best)
    assert torch.equal(annealed_loss(positions, label, best, share), expected)


def test_both_regression_losses_have_the_same_cut_off(monkeypatch: pytest.MonkeyPatch) -> None:
    """With h = 2 m, offsets of 1 m cost 0.5, of 3 m 2 (3 - 1) = 4, and of 4 m 2 (4 - 1) = 6.

    The modes cost (0.5 + 0) / 2 = 0.25 and (4 + 6) / 2 = 5, and at 4 m the nearer one has the
    weight 1 / (1 + 1/e) = 0.731059.
    """
    monkeypatch.setattr(losses, "HUBER_M", 2.0)
    positions, label = two_modes()
    assert float(regression_loss(positions, label, torch.tensor([1]))) == pytest.approx(5.0)
    loss = annealed_loss(positions, label, torch.tensor([0]), 0.25)
    assert float(loss) == pytest.approx(0.731059 * 0.25 + 0.268941 * 5, abs=1e-5)


def test_annealing_trains_every_mode_at_first() -> None:
    """At the start the farther mode gets a gradient; without annealing it gets none."""
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
    """Mode 0 is the best: regression 0.25, classification -ln(1/4) or -1/4."""
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
    """From (1, 2) heading north, (1, 5) is 3 m ahead and (0, 2) is 1 m to the left."""
    points = torch.tensor([[[1.0, 5.0], [0.0, 2.0]]])
    local = into_frame(points, torch.tensor([[1.0, 2.0, math.pi / 2, 7.0]]))
    torch.testing.assert_close(local, torch.tensor([[[3.0, 0.0], [0.0, 1.0]]]), atol=1e-6, rtol=0)


@given(
    x=st.floats(-50, 50),
    y=st.floats(-50, 50),
    heading=st.floats(-3, 3),
    ahead=st.floats(-50, 50),
    left=st.floats(-50, 50),
)
def test_into_frame_inverts_from_frame(
    x: float, y: float, heading: float, ahead: float, left: float
) -> None:
    origin = np.array([x, y, heading, 0.0])
    point = from_frame(np.array([[ahead, left]]), origin[None])
    local = into_frame(torch.tensor(point)[None], torch.tensor(origin)[None])
    np.testing.assert_allclose(local[0, 0], [ahead, left], atol=1e-4)


def test_random_mode_only_where_none_is_within_5_degrees() -> None:
    """Of 300 labels at 40° each of three modes gets about a third; other labels are by angle."""
    ends = [polar(10, 0), polar(9, 1), polar(5, -10)]
    count = 300
    positions = torch.tensor([[straight_line(end) for end in ends]]).repeat(count, 1, 1, 1)
    aside = torch.tensor([straight_line(polar(8 + 0.01 * k, 40)) for k in range(count)])
    shares = best_or_random_mode(positions, aside).bincount(minlength=3) / count
    np.testing.assert_allclose(shares, 1 / 3, atol=0.1)
    assert torch.equal(best_or_random_mode(positions, aside), best_or_random_mode(positions, aside))
    near = torch.tensor([straight_line(polar(9, 2))]).repeat(count, 1, 1)
    assert torch.equal(best_or_random_mode(positions, near), best_mode(positions, near))
    standing = torch.tensor([straight_line(polar(1, 120))]).repeat(count, 1, 1)
    assert torch.equal(best_or_random_mode(positions, standing), best_mode(positions, standing))


def test_random_mode_by_hand() -> None:
    """Modes 2, 3 and 1 m beside the label are hashed to 0, 0x4000 and 0x8000.

    The bits of these float32 are 128 · 2²³, 257 · 2²² and 127 · 2²³. The factor of the hash is 1
    modulo 4, so the products are 0, 2²² and 2²³ modulo 2²⁴, of which bits 8 to 23 are compared.
    """
    positions = torch.tensor([[[[10.0, 2.0]], [[10.0, 3.0]], [[10.0, 1.0]]]])
    label = torch.tensor([[[10.0, 0.0]]])
    assert best_or_random_mode(positions, label).tolist() == [2]
    assert best_or_random_mode(positions[:, :2], label).tolist() == [1]


def test_only_losses_choose_random_modes() -> None:
    """`best_mode` treats `angle-random` as `angle`; `mode_terms` takes the random mode."""
    positions = torch.tensor([[straight_line(polar(10, 0)), straight_line(polar(9, 10))]])
    for k in range(8):
        label = torch.tensor([straight_line(polar(8 + k, 40))])
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
        chosen = best_or_random_mode(positions, label)
        assert torch.equal(terms["regression"], regression_loss(positions, label, chosen))
