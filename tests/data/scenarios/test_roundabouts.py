"""Roundabouts of maps, and the scenarios in them."""

import math
from itertools import pairwise

import numpy as np
import pytest

from asp_env.data.classes import AgentClass
from asp_env.data.road_map import Ragged, RoadMap
from asp_env.data.scenarios.scenario import ScenarioSet, find_scenarios
from asp_env.data.scenarios.tags import TAGS, roundabout_points
from asp_env.data.source import open_data
from tests.builders import Drive, make_map, make_recording
from tests.real_data import real_data

RADIUS_M = 15.0


RING = [TAGS.index(tag) for tag in ("roundabout", "roundabout-entry", "roundabout-exit")]


def lanes_map(lanes: list[np.ndarray], successors: list[tuple[int, int]]) -> RoadMap:
    """A map with lanes only."""
    nothing = Ragged.pack([])
    return RoadMap(
        name="lanes",
        lines=nothing,
        line_types=np.zeros(0, dtype=np.int64),
        drivable=nothing,
        lanes=Ragged.pack(lanes),
        successors=np.array(successors, dtype=np.int64).reshape(-1, 2),
    )


def loop(points: np.ndarray, pieces: int = 4) -> RoadMap:
    """A closed line in several lanes, with a lane that leads in and one that leads out."""
    cuts = np.linspace(0, len(points) - 1, pieces + 1).round().astype(int)
    lanes = [points[a : b + 1] for a, b in pairwise(cuts.tolist())]
    beside = [points[0] - np.array([[40.0, 0.0], [0.0, 0.0]]), points[0] + np.eye(2) * 20]
    edges = [(i, (i + 1) % pieces) for i in range(pieces)]
    return lanes_map(lanes + beside, [*edges, (pieces, 0), (0, pieces + 1)])


def ellipse(ratio: float = 1.0, radius_m: float = RADIUS_M) -> np.ndarray:
    """Counter-clockwise around the origin, from its lowest point on."""
    angle = np.linspace(-math.pi / 2, 1.5 * math.pi, 201)
    return radius_m * np.stack([ratio * np.cos(angle), np.sin(angle)], axis=-1)


@pytest.mark.parametrize("pieces", [1, 2, 7])
@pytest.mark.parametrize("turned", [False, True])
def test_circle(pieces: int, turned: bool) -> None:
    """In any number of lanes and both directions, without the lanes that lead in and out."""
    circle = ellipse()[::-1] if turned else ellipse()
    ring = roundabout_points(loop(circle, pieces))
    assert len(ring) == pytest.approx(2 * math.pi * RADIUS_M, abs=pieces + 1)
    np.testing.assert_allclose(np.hypot(ring[:, 0], ring[:, 1]), RADIUS_M, rtol=0.01)
    sense = ring[:, 0] * np.sin(ring[:, 2]) - ring[:, 1] * np.cos(ring[:, 2])
    assert (np.sign(sense) == (-1 if turned else 1)).all()


@pytest.mark.parametrize(
    ("points", "is_ring"),
    [
        (ellipse(1.5), True),
        (ellipse(3.2), False),
        (ellipse(radius_m=99.0), True),
        (ellipse(radius_m=101.0), False),
        (np.array([(0, 0), (90, 0), (90, 90), (0, 90), (0, 0)], dtype=float), False),
        (np.array([(0, 0), (80, 0), (80, 6), (0, 6), (0, 0)], dtype=float), False),
    ],
    ids=["oval", "long", "wide", "too wide", "round a block", "up and down a road"],
)
def test_other_loops(points: np.ndarray, is_ring: bool) -> None:
    """Only round loops are roundabouts."""
    assert bool(len(roundabout_points(loop(points)))) == is_ring


def test_maps_without_loops() -> None:
    """An arc, the lanes of a crossing, and no lanes at all."""
    assert not len(roundabout_points(lanes_map([ellipse()[:150]], [])))
    assert not len(roundabout_points(make_map()))
    assert not len(roundabout_points(lanes_map([], [])))


@pytest.mark.parametrize(("data", "has_ring"), [("intersection", False), ("roundabout", True)])
def test_samples(data: str, has_ring: bool) -> None:
    """The sample roundabout has one; the sample intersection has none."""
    recordings = open_data(f"sample:{data}")
    found = find_scenarios(recordings, source=data, dt_s=0.2, history=15)
    for tag in ("roundabout", "roundabout-entry", "roundabout-exit"):
        share = found.has(tag).mean()
        assert 0.3 < share < 0.9 if has_ring else share == 0
    assert bool(len(roundabout_points(recordings[0].road_map))) == has_ring


@pytest.mark.data
def test_real_intersections() -> None:
    """The maps of Karlsruhe's intersections have no roundabout."""
    for recording in open_data(real_data("karlsruhe")):
        assert not len(roundabout_points(recording.road_map))


def driven(*drives: Drive, duration_s: float = 14.0) -> ScenarioSet:
    """Scenarios at a roundabout with a radius of 15 m around the origin."""
    recording = make_recording(
        drives=drives, duration_s=duration_s, frame_rate_hz=10.0, road_map=loop(ellipse())
    )
    return find_scenarios([recording], source="made up", dt_s=0.2, history=15)


@pytest.mark.parametrize(
    ("y", "heading", "expected"),
    [(-16.0, 0.0, True), (-16.3, 0.0, False), (-16.0, math.pi, False)],
)
def test_along_the_ring(y: float, heading: float, expected: bool) -> None:
    """Straight past it, within 2 m for 11.5 m and for 9.7 m; against its direction."""
    start = (-40.0 if heading == 0 else 40.0, y, heading, 5.0)
    found = driven(Drive(kind=AgentClass.CAR, start=start))
    assert found.tags[0, RING].tolist() == [expected] * 3


def test_vehicle_that_enters_and_circles() -> None:
    """An entry, no exit, and no U-turn."""
    angle = math.atan(2 * math.tan(math.asin(1.35 / RADIUS_M)))  # steers a circle of 15 m
    enters = Drive(kind=AgentClass.CAR, start=(-40, -15, 0, 5), phases=((8, 0, 0), (60, 0, angle)))
    found = driven(enters, duration_s=20.0)
    assert found.tags[0, RING].tolist() == [True, True, False]
    assert found.column("turn_deg")[0] > 180
    assert not found.has("u-turn")[0]
    later = found.select(found.start_tick > 40)
    assert not len(later)
