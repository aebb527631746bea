"""Contacts of boxes placed by hand, and laws on generated boxes."""

import math

import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis.strategies import SearchStrategy

from asp_env.data.classes import AgentClass
from asp_env.geometry import box_corners, from_frame, overlaps
from asp_env.metrics.boxes import AT_FAULT, Contact, ego_contacts, is_behind, touching_trailers

CAR = (4.0, 2.0)
State = tuple[float, float, float, float]
Box = tuple[float, float, float, float, float]

EGO: State = (0.0, 0.0, 0.0, 10.0)


def placed(*others: State, ego: State = EGO, at: State = (0.0, 0.0, 0.0, 0.0)) -> np.ndarray:
    """One situation of the ego and other agents, in the frame of a pose."""
    states = np.array([ego, *others])
    xy = from_frame(states[:, :2], np.array(at))
    return np.concatenate([xy, states[:, 2:3] + at[2], states[:, 3:]], axis=1)[None]


def contacts(
    *others: State, ego: State = EGO, size: tuple[float, float] = CAR, at: State = (0, 0, 0, 0)
) -> list[Contact]:
    """The contacts of the ego, a car, with other agents of one size."""
    states = placed(*others, ego=ego, at=at)
    sizes = np.array([[CAR, *[size] * len(others)]])
    found = ego_contacts(states, sizes, np.ones(states.shape[:2], dtype=bool))
    assert found[0, 0] == Contact.NONE  # the ego has no contact with itself
    return [Contact(kind) for kind in found[0, 1:]]


@pytest.mark.parametrize("at", [(0.0, 0.0, 0.0, 0.0), (100.0, -30.0, 2.0, 0.0)])
@pytest.mark.parametrize(
    ("x", "y", "size", "expected"),
    [
        (3.5, 0.0, CAR, Contact.FRONT),  # its rear at 1.5 m, the ego's front at 2 m
        (3.5, 1.9, CAR, Contact.FRONT),  # only the ego's front left corner
        (-3.5, 0.0, CAR, Contact.REAR),
        (0.0, 1.8, (1.0, 2.0), Contact.SIDE),  # 1 m long beside the ego
        (0.0, 0.0, (6.0, 1.0), Contact.FRONT),  # longer than the ego
        (-3.5, 1.3, CAR, Contact.REAR),  # 1.3 / 2.3 m: 150.5° off the heading
        (-3.5, 1.35, CAR, Contact.SIDE),  # 149.6°
        (-3.5, -1.35, CAR, Contact.SIDE),
        (-3.0, 1.7, CAR, Contact.SIDE),  # at the rear left corner: 136.6°
        (-2.2, 0.5, (9.0, 1.0), Contact.REAR),  # 153°: behind takes precedence over front
        (-1.9, 0.5, (9.0, 1.0), Contact.FRONT),  # 144.5°
        (3.99, 0.0, CAR, Contact.FRONT),
        (4.01, 0.0, CAR, Contact.NONE),
        (0.0, 2.01, CAR, Contact.NONE),
        (3.99, 2.01, CAR, Contact.NONE),
        (3.4, 0.0, (3.0, 3.0), Contact.FRONT),  # 2 m and 1.5 m from centre to side
        (3.4, 0.0, (2.0, 8.0), Contact.NONE),
        (0.0, 4.9, (2.0, 8.0), Contact.SIDE),  # 1 m and 4 m
    ],
)
def test_contact(
    x: float, y: float, size: tuple[float, float], expected: Contact, at: State
) -> None:
    """The ego's front is at 2 m, its sides at 1 m and its rear axle at -1.2 m, in any pose."""
    assert contacts((x, y, 0.0, 5.0), size=size, at=at) == [expected]


@pytest.mark.parametrize(
    ("x", "y", "behind"),
    [
        (-1.2, 0.0, False),  # the rear axle itself
        (-1.3, 0.0, True),
        (-2.2, 0.577, True),  # 150.02° off the heading, tan 30° = 0.5774
        (-2.2, -0.578, False),  # 149.97°
    ],
)
def test_behind_is_seen_from_the_rear_axle(x: float, y: float, behind: bool) -> None:
    """It is 0.3 · 4 m behind the centre."""
    assert is_behind(0.0, 0.0, 0.0, 4.0, x, y) == behind


def test_boxes_that_only_touch_have_no_contact() -> None:
    assert contacts((4.0, 0.0, 0.0, 5.0)) == [Contact.NONE]


@pytest.mark.parametrize(
    ("ego_mps", "other_mps", "expected"),
    [
        (0.05, 5.0, Contact.EGO_STANDS),
        (0.0, 0.0, Contact.EGO_STANDS),
        (-0.05, 5.0, Contact.EGO_STANDS),
        (5.0, 0.05, Contact.OTHER_STANDS),
        (5.0, -0.05, Contact.OTHER_STANDS),
        (0.06, 0.06, Contact.FRONT),
        (-0.06, 5.0, Contact.FRONT),
    ],
)
def test_standing(ego_mps: float, other_mps: float, expected: Contact) -> None:
    """Up to 0.05 m/s agents stand; this takes precedence over where they touch."""
    assert contacts((3.5, 0.0, 0.0, other_mps), ego=(0.0, 0.0, 0.0, ego_mps)) == [expected]


def test_contacts_that_may_be_at_fault() -> None:
    assert set(AT_FAULT) == {Contact.OTHER_STANDS, Contact.FRONT, Contact.SIDE}


def test_contacts_do_not_depend_on_the_order_of_agents() -> None:
    others = [(3.5, 0.0, 0.0, 5.0), (50.0, 0.0, 0.0, 5.0), (-3.5, 0.0, 0.0, 5.0)]
    expected = [Contact.FRONT, Contact.NONE, Contact.REAR]
    assert contacts(*others) == expected
    assert contacts(*others[::-1]) == expected[::-1]


@pytest.mark.parametrize(
    ("ego", "other", "x", "expected"),
    [
        (AgentClass.TRUCK, AgentClass.TRAILER, -3.5, True),
        (AgentClass.CAR, AgentClass.TRAILER, -3.5, True),
        (AgentClass.TRUCK, AgentClass.TRAILER, -4.01, False),
        (AgentClass.TRUCK, AgentClass.VAN, -3.5, False),
        (AgentClass.PEDESTRIAN, AgentClass.TRAILER, -3.5, False),
        (AgentClass.TRAILER, AgentClass.TRAILER, -3.5, False),
    ],
)
def test_touching_trailers(ego: AgentClass, other: AgentClass, x: float, expected: bool) -> None:
    """A trailer overlaps the ego, 4 m long like it; only of classes that tow, standing or not."""
    for speed in (0.0, 5.0):
        states = placed((x, 0.0, 0.0, speed), ego=(0.0, 0.0, 0.0, speed))
        sizes, valid = np.array([[CAR, CAR]]), np.ones((1, 2), dtype=bool)
        found = touching_trailers(states, sizes, np.array([[ego, other]]), valid)
        assert found.tolist() == [[False, expected]]
        valid[0, 1] = False
        assert not touching_trailers(states, sizes, np.array([[ego, other]]), valid).any()


def test_absent_agents_have_no_contact() -> None:
    states = np.repeat(placed((3.5, 0.0, 0.0, 5.0)), 2, axis=0)
    sizes = np.full((2, 2, 2), CAR)
    valid = np.array([(True, False), (False, True)])
    assert not ego_contacts(states, sizes, valid).any()


def boxes() -> SearchStrategy[Box]:
    """x, y, heading, length, width near the origin."""
    return st.tuples(
        *[st.floats(-4, 4)] * 2, st.floats(-7, 7), st.floats(0.3, 8), st.floats(0.3, 3)
    )


def gap_m(box: Box, other: Box) -> float:
    """The widest gap between the projected corners on any side's normal; negative for overlap."""
    corners = [box_corners(np.array(each[:3]), np.array(each[3:])) for each in (box, other)]
    gaps = []
    for heading in (box[2], other[2]):
        for angle in (heading, heading + math.pi / 2):
            one, two = (each @ [math.cos(angle), math.sin(angle)] for each in corners)
            gaps.append(max(one.min() - two.max(), two.min() - one.max()))
    return max(gaps)


@given(box=boxes(), other=boxes())
def test_overlap(box: Box, other: Box) -> None:
    """Boxes overlap if no line separates their corners, in either order."""
    gap = gap_m(box, other)
    assume(abs(gap) > 1e-9)
    assert overlaps(*box, *other) == (gap < 0)
    assert overlaps(*other, *box) == (gap < 0)


@given(box=boxes(), share=st.floats(0, 0.999))
def test_boxes_with_the_same_centre_overlap(box: Box, share: float) -> None:
    """This holds for a box of length 0 as well."""
    x, y, heading, length, width = box
    assert overlaps(*box, x, y, heading + share, share * length, share * width)
    assert overlaps(*box, x, y, heading, 0.0, width)


@given(kinds=st.lists(st.sampled_from(list(Contact)), min_size=2, max_size=2))
def test_lasting_contacts_retain_their_kind(kinds: list[Contact]) -> None:
    """New contacts are classified; contacts that have ended are removed."""
    touching, apart = (3.5, 0.0, 0.0, 5.0), (30.0, 0.0, 0.0, 5.0)
    states = placed(touching, apart)
    sizes, valid = np.full((1, 3, 2), CAR), np.ones((1, 3), dtype=bool)
    previous = np.array([[Contact.NONE, *kinds]], dtype=np.int8)
    (found,) = ego_contacts(states, sizes, valid, previous)
    assert found.tolist() == [0, kinds[0] or Contact.FRONT, 0]
