"""Manoeuvres of targets, from synthetic motions."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from asp_env.dynamics import rollout
from asp_env.metrics.forecast.errors import Manoeuvre, manoeuvres, moving

NOW, DT_S, LENGTH_M = 15, 0.2, np.array(4.5)


def drive(speed_mps: float, *phases: tuple[float, float]) -> np.ndarray:
    """31 states; the phases (acceleration m/s², yaw rate rad/s) are equally long."""
    parts = [np.tile(phase, (30 // len(phases), 1)) for phase in phases]
    acceleration, yaw_rate = np.concatenate(parts).T
    speed = np.maximum(speed_mps + np.cumsum(acceleration) * DT_S, 0)
    heading = np.cumsum(yaw_rate) * DT_S
    xy = np.cumsum(np.stack([np.cos(heading), np.sin(heading)]) * speed * DT_S, axis=1)
    after = np.stack([*xy, heading, speed], axis=-1)
    return np.concatenate([[(0.0, 0.0, 0.0, speed_mps)], after])


RATE = np.radians(40) / 6.0
"""40° over the 6 s of past and future."""


@pytest.mark.parametrize(
    ("states", "expected"),
    [
        (drive(0.0, (0, 0)), Manoeuvre.STANDING),
        (drive(0.6, (0, 0)), Manoeuvre.STANDING),
        (drive(0.9, (0, 0)), Manoeuvre.STARTING),
        (drive(0.0, (0, 0), (1.5, 0)), Manoeuvre.STARTING),
        (drive(0.0, (0, 0), (1.5, 0.4)), Manoeuvre.STARTING),
        (drive(6.0, (0, 0), (-2, 0)), Manoeuvre.STOPPING),
        (drive(6.0, (0, 0.4), (-2, 0)), Manoeuvre.STOPPING),
        (drive(1.0, (0, 0)), Manoeuvre.STARTING),
        (drive(4.0, (0, 0), (-1, 0)), Manoeuvre.STOPPING),
        (drive(6.0, (0, 0), (-1, 0)), Manoeuvre.STRAIGHT),
        (drive(8.0, (0, RATE)), Manoeuvre.LEFT),
        (drive(8.0, (0, -RATE)), Manoeuvre.RIGHT),
        (drive(8.0, (0, 2 * RATE), (0, 0)), Manoeuvre.LEFT),
        (drive(8.0, (0, 2 * RATE), (0, -2 * RATE)), Manoeuvre.STRAIGHT),
        (drive(8.0, (0, 0.7 * RATE)), Manoeuvre.STRAIGHT),
        (drive(8.0, (0, 8 * RATE)), Manoeuvre.LEFT),
    ],
    ids=[
        *("stands", "creeps 1.8 m", "creeps 2.7 m", "starts", "starts into a turn", "stops"),
        *(
            "turns, then stops",
            "1 m/s, 3 m",
            "brakes to 1 m/s",
            "brakes to 3 m/s",
            "left",
            "right",
            "left before now",
        ),
        *("turns and turns back", "28 degrees", "320 degrees on a roundabout"),
    ],
)
def test_manoeuvres_by_hand(states: np.ndarray, expected: Manoeuvre) -> None:
    known = np.ones((1, len(states)), dtype=bool)
    assert manoeuvres(states[None], known, now=NOW) == [expected]


def test_unknown_ticks_are_neither_a_stop_nor_a_turn() -> None:
    states = drive(8.0, (0, 0))
    states[:, 2] = 2.0
    known = np.ones((1, len(states)), dtype=bool)
    states[-3:], known[:, -3:] = 0, False
    assert manoeuvres(states[None], known, now=NOW) == [Manoeuvre.STRAIGHT]


@given(seed=st.integers(0, 10**6))
def test_standing_is_the_complement_of_moving_and_left_mirrors_right(seed: int) -> None:
    rng = np.random.default_rng(seed)
    count = 50
    actions = np.stack(
        [rng.uniform(-3, 3, (count, 30)), np.repeat(rng.uniform(-0.3, 0.3, (count, 1)), 30, 1)],
        axis=-1,
    )
    start = np.zeros((count, 4))
    start[:, 3] = rng.uniform(0, 6, count)
    states = np.concatenate([start[:, None], rollout(start, actions, LENGTH_M, DT_S)], axis=1)
    known = np.ones(states.shape[:2], dtype=bool)
    found = manoeuvres(states, known, now=NOW)
    assert set(found.tolist()) <= {int(kind) for kind in Manoeuvre}
    moves = moving(states[:, NOW], states[:, NOW + 1 :, :2], known[:, NOW + 1 :])
    np.testing.assert_array_equal(found == Manoeuvre.STANDING, ~moves)
    mirrored = manoeuvres(states * np.array([1, -1, -1, 1]), known, now=NOW)
    swap = {int(Manoeuvre.LEFT): int(Manoeuvre.RIGHT), int(Manoeuvre.RIGHT): int(Manoeuvre.LEFT)}
    assert mirrored.tolist() == [swap.get(kind, kind) for kind in found.tolist()]
