"""Invariances of tags and measures: frame of reference, order, ids, distant agents, frame rate."""

import dataclasses
import math

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from asp_env.data.classes import AgentClass
from asp_env.data.recording import Recording
from asp_env.data.road_map import Ragged
from asp_env.data.scenarios.scenario import ScenarioSet, find_scenarios
from asp_env.data.scenarios.tags import COLUMNS
from asp_env.geometry import from_frame
from tests.builders import DRIVES, Drive, make_recording
from tests.data.scenarios.test_roundabouts import ellipse, loop
from tests.data.scenarios.test_scenario_tags import WAITS, through

MADE_UP = make_recording(
    drives=(
        *DRIVES,
        Drive(kind=AgentClass.CAR, start=(-60, 200, 0, 8), phases=WAITS.phases),
        through(0, 200, 11, math.pi / 2, 8),
        through(20, 0, 14.1, -1.3, 1.2, AgentClass.PEDESTRIAN),
        Drive(kind=AgentClass.CAR, start=(-80, 200, 0, 8), phases=WAITS.phases),
        Drive(kind=AgentClass.CAR, start=(0, -200, 1, 0), phases=((5, 0, 0), (4, 2, 0.1))),
    ),
    road_map=loop(np.array([40.0, 40.0]) + ellipse()),
    duration_s=25.0,
)
"""Turns, waiting, yielding, leaders, pedestrians, and a roundabout in which a vehicle circles."""


def table(recording: Recording) -> ScenarioSet:
    """All scenarios, sorted by the ego's id, then start."""
    found = find_scenarios([recording], source="", dt_s=0.2, history=15)
    return found.select(np.lexsort((found.start_tick, found.ego_id)))


BEFORE = table(MADE_UP)


def reordered(recording: Recording, order: np.ndarray) -> Recording:
    """The same tracks in another order."""
    return dataclasses.replace(
        recording,
        **{name: getattr(recording, name)[order]
           for name in ("track_ids", "classes", "sizes", "first_frames")},
        starts=np.cumsum([0, *np.diff(recording.starts)[order]]),
        states=np.concatenate([recording.track(int(track)) for track in order]),
    )  # fmt: skip


def test_most_tags_occur() -> None:
    assert {tag for tag, count in BEFORE.counts().items() if count} >= {
        "left", "right", "straight", "standing-start", "stopping", "following", "yielding",
        "crossing-vru", "roundabout", "interactive",
    }  # fmt: skip


@settings(max_examples=25, deadline=None)
@given(angle=st.floats(-math.pi, math.pi), x=st.floats(-300, 300), y=st.floats(-300, 300))
def test_frame_of_reference(angle: float, x: float, y: float) -> None:
    """Rotation and translation change no tag and no measure."""
    pose = np.array([x, y, angle])
    states = MADE_UP.states.astype(np.float64)
    states[:, :2], states[:, 2] = from_frame(states[:, :2], pose), states[:, 2] + angle
    lanes = MADE_UP.road_map.lanes
    moved = dataclasses.replace(
        MADE_UP,
        states=states.astype(np.float32),
        road_map=dataclasses.replace(
            MADE_UP.road_map,
            lanes=Ragged(points=from_frame(lanes.points, pose), starts=lanes.starts),
        ),
    )
    after = table(moved)
    np.testing.assert_array_equal(after.tags, BEFORE.tags)
    np.testing.assert_allclose(after.values, BEFORE.values, atol=0.01)


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 1000))
def test_order_and_ids_of_tracks(seed: int) -> None:
    """Shuffled tracks give the same table; other ids change the ids only."""
    order = np.random.default_rng(seed).permutation(len(MADE_UP))
    after = table(reordered(MADE_UP, order))
    for name in ("ego_id", "start_tick", "length", "tags", "values"):
        np.testing.assert_array_equal(getattr(after, name), getattr(BEFORE, name))
    renamed = table(dataclasses.replace(MADE_UP, track_ids=MADE_UP.track_ids + 1 + seed))
    np.testing.assert_array_equal(renamed.ego_id, BEFORE.ego_id + 1 + seed)
    np.testing.assert_array_equal(renamed.tags, BEFORE.tags)


@settings(max_examples=25, deadline=None)
@given(x=st.floats(500, 2000), heading=st.floats(-3, 3), kind=st.sampled_from(AgentClass))
def test_distant_agents(x: float, heading: float, kind: AgentClass) -> None:
    """An agent at least 400 m away changes the number of agents only."""
    far = make_recording(drives=(Drive(kind=kind, start=(x, -x, heading, 3.0)),), duration_s=25.0)
    both = dataclasses.replace(
        MADE_UP,
        **{name: np.concatenate([getattr(MADE_UP, name), getattr(far, name)])
           for name in ("classes", "sizes", "first_frames", "states")},
        track_ids=np.append(MADE_UP.track_ids, 999),
        starts=np.append(MADE_UP.starts, MADE_UP.starts[-1] + len(far.states)),
    )  # fmt: skip
    after = table(both)
    after = after.select(after.ego_id != 999)
    np.testing.assert_array_equal(after.tags, BEFORE.tags)
    for column in COLUMNS:
        more = column == "agents"
        np.testing.assert_array_equal(after.column(column), BEFORE.column(column) + more)


def test_frame_rate() -> None:
    """Tracks with states at every frame or at every tick only give the same table."""
    every_tick = make_recording(drives=DRIVES, duration_s=25.0, frame_rate_hz=10.0)
    stride = 2
    rows = [every_tick.track(i)[::stride] for i in range(len(every_tick))]
    sparse = dataclasses.replace(
        every_tick,
        frame_rate_hz=5.0,
        num_frames=-(-every_tick.num_frames // stride),
        first_frames=every_tick.first_frames // stride,
        starts=np.cumsum([0, *map(len, rows)]),
        states=np.concatenate(rows),
    )
    np.testing.assert_array_equal(table(sparse).tags, table(every_tick).tags)
    np.testing.assert_allclose(table(sparse).values, table(every_tick).values, atol=1e-6)
