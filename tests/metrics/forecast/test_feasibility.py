"""Modes off the road, into other agents and beyond physical bounds, by hand."""

import dataclasses

import numpy as np
import pytest

from asp_env.data.road_map import Ragged
from asp_env.metrics.forecast.feasibility import (
    infeasible_modes,
    off_road_modes,
    overlapping_modes,
)
from tests.builders import make_map

DT_S = 0.2
TICKS = 5


@pytest.mark.parametrize(("y_m", "off"), [(0.0, False), (3.7, False), (3.95, True), (-3.95, True)])
def test_off_road(y_m: float, off: bool) -> None:
    """The road along x ends at 3.5 m: 0.2 m outside is within the tolerance, 0.45 m is not.

    A single tick decides.
    """
    points = np.zeros((1, 2, TICKS, 2))
    points[..., 0] = 50.0
    points[0, 1, 3, 1] = y_m
    found, known = off_road_modes((make_map(),), np.zeros(1, dtype=np.int64), points)
    assert found.tolist() == [[False, off]]
    assert known.all()


def test_off_road_is_unknown_without_a_drivable_area() -> None:
    empty = dataclasses.replace(make_map(), drivable=Ragged.pack([]))
    points = np.full((2, 1, TICKS, 2), 500.0)
    off, known = off_road_modes((make_map(), empty), np.array([0, 1]), points)
    assert off.tolist() == [[True], [False]]
    assert known.tolist() == [True, False]


def driven(speeds: list[float], headings: list[float]) -> np.ndarray:
    """One mode with the given speeds and headings; positions are not read."""
    states = np.zeros((1, 1, len(speeds), 4))
    states[0, 0, :, 2], states[0, 0, :, 3] = headings, speeds
    return states


@pytest.mark.parametrize(
    ("speeds", "headings", "infeasible"),
    [
        ([5.0, 5.0, 5.0], [0.0, 0.0, 0.0], False),
        ([7.08, 7.08, 7.08], [0.0, 0.0, 0.0], False),
        ([7.1, 7.1, 7.1], [0.0, 0.0, 0.0], True),
        ([5.0, 5.0, 2.9], [0.0, 0.0, 0.0], True),
        ([5.0, 5.0, 5.0], [0.3, 0.6, 0.3], False),
        ([5.0, 5.0, 5.0], [0.31, 0.31, 0.31], True),
        ([5.0, 5.0, 5.0], [0.0, 0.0, -0.31], True),
        ([4.0, 2.0, 0.5], [0.0, 0.0, 3.0], False),
        ([-5.0, -5.0, -5.0], [0.0, 0.0, 0.0], True),
    ],
    ids=[
        *("steady", "10.4 m/s2", "10.5 m/s2", "-10.5 m/s2", "0.3 1/m", "0.31 1/m"),
        *("-0.31 1/m", "too slow for a curvature", "reversing at once"),
    ],
)
def test_infeasible(speeds: list[float], headings: list[float], infeasible: bool) -> None:
    """From 5 m/s along x: 1 m per tick, so the curvature equals the turn."""
    now = np.array([[0.0, 0.0, 0.0, 5.0]])
    assert infeasible_modes(now, driven(speeds, headings), dt_s=DT_S).tolist() == [[infeasible]]


def test_turns_are_wrapped() -> None:
    """From 3.1 to -3.1 rad is a turn of 0.083 rad, not 6.2."""
    now = np.array([[0.0, 0.0, 3.1, 5.0]])
    assert not infeasible_modes(now, driven([5.0], [-3.1]), dt_s=DT_S).any()


def straight(x_m: float, y_m: float, speed_mps: float) -> np.ndarray:
    """Future states of a vehicle that drives along x."""
    states = np.zeros((TICKS, 4))
    states[:, 0] = x_m + speed_mps * DT_S * np.arange(1, TICKS + 1)
    states[:, 1], states[:, 3] = y_m, speed_mps
    return states


CAR = np.array([4.0, 2.0])
WAITING = straight(9.0, 0.0, 0.0)
"""Its rear is 7 m ahead of the target's centre, 5 m ahead of its front."""


def overlaps(
    modes: list[np.ndarray],
    truth: np.ndarray,
    others: list[np.ndarray],
    *,
    present: bool | list[list[bool]] = True,
    slot: int = -1,
) -> list[bool]:
    """Which modes of one target overlap another agent."""
    tracks = np.stack(others)[None]
    found = overlapping_modes(
        np.stack(modes)[None],
        truth[None],
        CAR[None],
        situation=np.zeros(1, dtype=np.int64),
        slot=np.array([slot]),
        others=tracks,
        others_valid=np.broadcast_to(np.array(present), tracks.shape[:3]).copy(),
        others_sizes=np.tile(CAR, (1, len(others), 1)),
    )
    return found[0].tolist()


STOPS = straight(0.0, 0.0, 0.0)


@pytest.mark.parametrize(
    ("mode", "expected"),
    [
        (straight(0.0, 0.0, 4.9), False),
        (straight(0.0, 0.0, 5.1), True),
        (straight(0.0, 2.0, 20.0), False),
        (straight(0.0, 1.9, 20.0), True),
        (STOPS, False),
    ],
    ids=["stops before", "hits", "passes", "touches the side", "stands"],
)
def test_overlap(mode: np.ndarray, expected: bool) -> None:
    """After 1 s at 5 m/s the front reaches the other rear; 2 m aside the boxes just pass."""
    assert overlaps([STOPS, mode], STOPS, [WAITING]) == [False, expected]


def test_absent_agents_and_the_target_itself_do_not_count() -> None:
    through = straight(0.0, 0.0, 40.0)
    # after the first tick the target is at 8 m, after the second at 16 m
    assert overlaps([through], STOPS, [WAITING], present=[[True, False, False, False, False]]) == [
        True
    ]
    assert overlaps([through], STOPS, [WAITING], present=[[False, True, True, True, True]]) == [
        False
    ]
    assert overlaps([through], STOPS, [WAITING], slot=0) == [False]


def test_agents_that_overlap_in_the_recording_are_left_out() -> None:
    """A car's own trailer does not count; other agents still do."""
    truth = straight(0.0, 0.0, 5.0)
    trailer = straight(-3.0, 0.0, 5.0)
    assert overlaps([STOPS], truth, [trailer]) == [False]
    assert overlaps(
        [STOPS, straight(0.0, 0.0, 8.0)], truth, [trailer, straight(10.0, 0.0, 5.0)]
    ) == [
        False,
        False,
    ]
    assert overlaps([straight(0.0, 0.0, 15.0)], truth, [trailer, straight(9.0, 0.0, 5.0)]) == [True]
