"""Contacts with boxes placed by hand; laws on generated boxes."""

import math

import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis.strategies import SearchStrategy

from asp_env.data.classes import AgentClass
from asp_env.geometry import box_corners, from_frame, overlaps
from asp_env.metrics.boxes import AT_FAULT, Contact, ego_contacts, touching_trailers

CAR = (4.0, 2.0)
State = tuple[float, float, float, float]
Box = tuple[float, float, float, float, float]

EGO: State = (0.0, 0.0, 0.0, 10.0)


def placed(*others: State, ego: State = EGO, at: State = (0.0, 0.0, 0.0, 0.0)) -> np.ndarray:
    """One situation of the ego and others, with the origin at a pose."""
    states = np.array([ego, *others])
    xy = from_frame(states[:, :2], np.array(at))
    return np.concatenate([xy, states[:, 2:3] + at[2], states[:, 3:]], axis=1)[None]


def contacts(
    *others: State, ego: State = EGO, size: tuple[float, float] = CAR, at: State = (0, 0, 0, 0)
) -> list[Contact]:
    """How the ego, a car, meets others of a size."""
    states = placed(*others, ego=ego, at=at)
    sizes = np.array([[CAR, *[size] * len(others)]])
    found = ego_contacts(states, sizes, np.ones(states.shape[:2], dtype=bool))
    assert found[0, 0] == Contact.NONE  # the ego does not meet itself
    return [Contact(kind) for kind in found[0, 1:]]


@pytest.mark.parametrize("at", [(0.0, 0.0, 0.0, 0.0), (100.0, -30.0, 2.0, 0.0)])
@pytest.mark.parametrize(
    ("x", "y", "size", "expected"),
    [
        (3.5, 0.0, CAR, Contact.FRONT),  # its tail 1.5 m ahead of our centre, our front at 2 m
        (3.5, 1.9, CAR, Contact.FRONT),  # only our front left corner
        (-3.5, 0.0, CAR, Contact.REAR),
        (0.0, 1.8, (1.0, 2.0), Contact.SIDE),  # 1 m long beside our doors
        (0.0, 0.0, (6.0, 1.0), Contact.FRONT),  # from end to end of us
        (-3.5, 1.3, CAR, Contact.REAR),  # 1.3 / 2.3 m: 150.5° off our heading
        (-3.5, 1.35, CAR, Contact.SIDE),  # 149.6°
        (-3.5, -1.35, CAR, Contact.SIDE),
        (-3.0, 1.7, CAR, Contact.SIDE),  # cut in on from behind: 136.6°
        (-2.2, 0.5, (9.0, 1.0), Contact.REAR),  # 153°: behind decides before the front it reaches
        (-1.9, 0.5, (9.0, 1.0), Contact.FRONT),  # 144.5°
        (3.99, 0.0, CAR, Contact.FRONT),
        (4.01, 0.0, CAR, Contact.NONE),
        (0.0, 2.01, CAR, Contact.NONE),
        (3.99, 2.01, CAR, Contact.NONE),
    ],
)
def test_contact(
    x: float, y: float, size: tuple[float, float], expected: Contact, at: State
) -> None:
    """Our front is at 2 m, our sides at 1 m, our rear axle at -1.2 m.

    Turning and moving the scene changes nothing.
    """
    assert contacts((x, y, 0.0, 5.0), size=size, at=at) == [expected]


def test_touching_is_no_contact() -> None:
    """Bumper to bumper, to the last bit, is not yet a contact."""
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
    """Up to 0.05 m/s is standing; who stands decides before where it hit."""
    assert contacts((3.5, 0.0, 0.0, other_mps), ego=(0.0, 0.0, 0.0, ego_mps)) == [expected]


def test_fault() -> None:
    """The ego answers for hitting with its front or side, and for hitting what stands."""
    assert set(AT_FAULT) == {Contact.OTHER_STANDS, Contact.FRONT, Contact.SIDE}


def test_each_agent_by_itself() -> None:
    """Several others in any order keep their own classes."""
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
    """A trailer, 4 m long as the ego, within it; only of who may tow, standing or not."""
    for speed in (0.0, 5.0):
        states = placed((x, 0.0, 0.0, speed), ego=(0.0, 0.0, 0.0, speed))
        sizes, valid = np.array([[CAR, CAR]]), np.ones((1, 2), dtype=bool)
        found = touching_trailers(states, sizes, np.array([[ego, other]]), valid)
        assert found.tolist() == [[False, expected]]
        valid[0, 1] = False
        assert not touching_trailers(states, sizes, np.array([[ego, other]]), valid).any()


def test_the_absent_touch_nobody() -> None:
    """Neither an invalid other nor an invalid ego has a contact."""
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
    """The widest gap between the corners' shadows on any side's normal; negative for overlap."""
    corners = [box_corners(np.array(each[:3]), np.array(each[3:])) for each in (box, other)]
    gaps = []
    for heading in (box[2], other[2]):
        for angle in (heading, heading + math.pi / 2):
            one, two = (each @ [math.cos(angle), math.sin(angle)] for each in corners)
            gaps.append(max(one.min() - two.max(), two.min() - one.max()))
    return max(gaps)


@given(box=boxes(), other=boxes())
def test_overlap(box: Box, other: Box) -> None:
    """Boxes overlap where no line separates their corners; whoever is asked first."""
    gap = gap_m(box, other)
    assume(abs(gap) > 1e-9)
    assert overlaps(*box, *other) == (gap < 0)
    assert overlaps(*other, *box) == (gap < 0)


@given(box=boxes(), share=st.floats(0, 0.999))
def test_a_box_within_a_box(box: Box, share: float) -> None:
    """Boxes of the same centre overlap, also if one is a line without depth."""
    x, y, heading, length, width = box
    assert overlaps(*box, x, y, heading + share, share * length, share * width)
    assert overlaps(*box, x, y, heading, 0.0, width)


@given(kinds=st.lists(st.sampled_from(list(Contact)), min_size=2, max_size=2))
def test_a_contact_that_lasts_keeps_its_kind(kinds: list[Contact]) -> None:
    """Only where there is one still; a new one is classed anew."""
    touching, apart = (3.5, 0.0, 0.0, 5.0), (30.0, 0.0, 0.0, 5.0)
    states = placed(touching, apart)
    sizes, valid = np.full((1, 3, 2), CAR), np.ones((1, 3), dtype=bool)
    before = np.array([[Contact.NONE, *kinds]], dtype=np.int8)
    (found,) = ego_contacts(states, sizes, valid, before)
    assert found.tolist() == [0, kinds[0] or Contact.FRONT, 0]
