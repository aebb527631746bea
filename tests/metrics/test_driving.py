"""Scores of drives, composed by hand."""

import dataclasses
import math

import numpy as np
import pytest

from asp_env.data.geometry import from_frame
from asp_env.metrics.boxes import Contact
from asp_env.metrics.driving import Drives, driving_metrics

TICKS = 8
NAMES = {
    *("score", "no collision", "no at-fault collision", "on road"),
    *("progress", "TTC", "log divergence", "comfort"),
}


def drive(*, lasted: int = TICKS, **changes: object) -> Drives:
    """One episode at 5 m/s that is perfect but for its progress of 40 m out of 50 m.

    Fields are given as values for all ticks, or as arrays.
    """
    states = np.zeros((1, TICKS, 4))
    states[0, :, 0] = np.arange(TICKS)
    states[0, :, 3] = 5.0
    fields = {
        "states": states,
        "log_states": states,
        "contacts": np.zeros((1, TICKS, 3), dtype=np.int8),
        "off_road_m": np.zeros((1, TICKS)),
        "ttc_s": np.full((1, TICKS), math.inf),
        "route_m": np.linspace(33, 40, TICKS)[None],
        "goal_m": np.array([50.0]),
    }
    for name, change in changes.items():
        fields[name] = np.broadcast_to(np.asarray(change), fields[name].shape)
    return Drives(**fields, lasted=np.arange(TICKS)[None] < lasted, dt_s=0.2)


def at_tick(tick: int, value: float, otherwise: float = 0.0) -> np.ndarray:
    """(1, ticks) with one value at one tick."""
    return np.where(np.arange(TICKS) == tick, value, otherwise)[None]


def contact(tick: int, kind: Contact) -> np.ndarray:
    """(1, ticks, 3) with one contact at one tick, with the third agent."""
    found = np.zeros((1, TICKS, 3), dtype=np.int8)
    found[0, tick, 2] = kind
    return found


def values(drives: Drives) -> dict[str, float]:
    """The metrics of one episode; NaN where missing."""
    metrics = driving_metrics(drives)
    assert set(metrics) == NAMES
    return {
        name: float(metric.value[0]) if metric.valid[0] else math.nan
        for name, metric in metrics.items()
    }


def test_good_drive() -> None:
    """(5·0.8 + 5·1 + 2·1)/12 = 11/12."""
    assert values(drive()) == pytest.approx(
        {
            "score": 11 / 12,
            "no collision": 1,
            "no at-fault collision": 1,
            "on road": 1,
            "progress": 0.8,
            "TTC": 1,
            "log divergence": 0,
            "comfort": 1,
        }
    )


@pytest.mark.parametrize(
    ("kind", "no_fault"),
    [
        (Contact.EGO_STANDS, 1),
        (Contact.OTHER_STANDS, 0),
        (Contact.FRONT, 0),
        (Contact.REAR, 1),
        (Contact.SIDE, 0),
    ],
)
def test_collision(kind: Contact, no_fault: int) -> None:
    """Every contact is a collision; only one at fault costs the score, and then all of it."""
    found = values(drive(contacts=contact(3, kind)))
    assert (found["no collision"], found["no at-fault collision"]) == (0, no_fault)
    assert found["score"] == pytest.approx(no_fault * 11 / 12)


@pytest.mark.parametrize(("outside_m", "on_road"), [(0.3, 1), (0.31, 0)])
def test_off_road(outside_m: float, on_road: int) -> None:
    """0.3 m outside is on the road, more is off it and costs the whole score."""
    found = values(drive(off_road_m=at_tick(5, outside_m)))
    assert found["on road"] == on_road
    assert found["score"] == pytest.approx(on_road * 11 / 12)


@pytest.mark.parametrize(("ttc_s", "fine"), [(0.95, 1), (0.94, 0)])
def test_ttc(ttc_s: float, fine: int) -> None:
    """Below 0.95 s once costs 5 of 12."""
    found = values(drive(ttc_s=at_tick(0, ttc_s, math.inf)))
    assert found["TTC"] == fine
    assert found["score"] == pytest.approx((4 + 5 * fine + 2) / 12)


def test_comfort() -> None:
    """Braking from 15 m/s at 5 m/s² costs 2 of 12."""
    states = drive().states.copy()
    states[0, :, 3] = 15 - np.arange(TICKS)
    found = values(drive(states=states))
    assert found["comfort"] == 0
    assert found["score"] == pytest.approx(9 / 12)


def test_short_drive() -> None:
    """Under five ticks comfort is missing and the rest counts for 10: 36 of 50 m give 8.6/10.

    Whatever stands behind the last tick counts for nothing.
    """
    found = values(
        drive(
            lasted=4,
            contacts=contact(4, Contact.FRONT),
            off_road_m=at_tick(5, 9.0),
            ttc_s=at_tick(6, 0.0, math.inf),
        )
    )
    assert math.isnan(found["comfort"])
    assert found["progress"] == pytest.approx(0.72)
    for name in ("no collision", "no at-fault collision", "on road", "TTC"):
        assert found[name] == 1
    assert found["score"] == pytest.approx((5 * 0.72 + 5) / 10)


def test_five_ticks_are_enough() -> None:
    """With the fifth tick comfort counts again."""
    assert values(drive(lasted=5))["comfort"] == 1


def test_too_short_at_other_ticks() -> None:
    """Eight ticks of 0.1 s are under the window of eleven: 5·0.8 + 5 of 10."""
    found = values(dataclasses.replace(drive(), dt_s=0.1))
    assert math.isnan(found["comfort"])
    assert found["score"] == pytest.approx(0.9)


@pytest.mark.parametrize(
    ("reached_m", "goal_m", "progress"),
    [(25.0, 50.0, 0.5), (60.0, 50.0, 1.0), (-3.0, 50.0, 0.0), (0.25, 0.0, 0.25), (0.0, 0.5, 0.0)],
)
def test_progress(reached_m: float, goal_m: float, progress: float) -> None:
    """A share from 0 to 1; a goal nearer than 1 m counts as 1 m."""
    found = values(drive(route_m=at_tick(TICKS - 1, reached_m), goal_m=[goal_m]))
    assert found["progress"] == pytest.approx(progress)


def test_log_divergence() -> None:
    """Off by (3, 4) at two of four ticks is 5·2/4 = 2.5 m; later ticks are left out."""
    log_states = drive().states.copy()
    log_states[0, 2:, :2] += (3.0, 4.0)
    log_states[0, 4:] = math.nan
    assert values(drive(log_states=log_states, lasted=4))["log divergence"] == pytest.approx(2.5)


def test_no_tick() -> None:
    """Of an episode that never was, nothing is known."""
    assert all(math.isnan(value) for value in values(drive(lasted=0)).values())


def test_invariance() -> None:
    """Episodes keep their values in any order; agents too; turning the scene changes nothing."""
    episodes = [
        drive(),
        drive(contacts=contact(2, Contact.SIDE)),
        drive(lasted=3, ttc_s=0.5),
        drive(off_road_m=0.4),
    ]
    fields = [field.name for field in dataclasses.fields(Drives) if field.name != "dt_s"]

    def joined(order: list[int]) -> Drives:
        parts = [episodes[number] for number in order]
        stacked = {name: np.concatenate([getattr(part, name) for part in parts]) for name in fields}
        return Drives(**stacked, dt_s=0.2)

    metrics, shuffled = driving_metrics(joined([0, 1, 2, 3])), joined([2, 0, 3, 1])

    def moved(states: np.ndarray) -> np.ndarray:
        xy = from_frame(states[..., :2], np.array([100.0, -50.0, 2.5]))
        return np.concatenate([xy, states[..., 2:3] + 2.5, states[..., 3:]], axis=-1)

    elsewhere = dataclasses.replace(
        shuffled,
        contacts=shuffled.contacts[:, :, ::-1],
        states=moved(shuffled.states),
        log_states=moved(shuffled.log_states),
    )
    for name, metric in driving_metrics(elsewhere).items():
        np.testing.assert_allclose(metric.value, metrics[name].value[[2, 0, 3, 1]], atol=1e-9)
        np.testing.assert_array_equal(metric.valid, metrics[name].valid[[2, 0, 3, 1]])
