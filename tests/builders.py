"""Small synthetic recordings in memory, so that tests need no files."""

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from asp_env.data.classes import FOOTPRINTS_M, AgentClass
from asp_env.data.recording import Recording
from asp_env.data.road_map import LineType, Ragged, RoadMap
from asp_env.dynamics import rollout

ARM_M = 100.0
"""Length of each arm of the crossing."""

LANE_M = 3.5


@dataclass(frozen=True, slots=True, kw_only=True)
class Drive:
    """The motion of one agent."""

    kind: AgentClass
    start: tuple[float, float, float, float]
    """[x m, y m, heading rad, speed m/s]."""
    phases: tuple[tuple[float, float, float], ...] = ()
    """(duration s, acceleration m/s², steering rad) in succession; no action afterwards."""
    appears_s: float = 0.0
    leaves_s: float = math.inf


DRIVES = (
    Drive(kind=AgentClass.CAR, start=(-90.0, -1.75, 0.0, 8.0)),
    Drive(
        kind=AgentClass.CAR,
        start=(80.0, 1.75, math.pi, 9.0),
        phases=((4.0, -1.5, 0.0), (2.0, 0.0, 0.0), (4.0, 1.5, 0.0)),
    ),
    Drive(  # turns left by 90° at a radius of 12 m
        kind=AgentClass.CAR,
        start=(1.75, -50.0, math.pi / 2, 6.0),
        phases=((6.0, 0.0, 0.0), (math.pi, 0.0, 0.2227)),
    ),
    Drive(  # turns right by 90° at a radius of 8 m
        kind=AgentClass.VAN,
        start=(-1.75, 60.0, -math.pi / 2, 5.0),
        phases=((10.0, 0.0, 0.0), (2.513, 0.0, -0.399)),
    ),
    Drive(  # stops, waits and starts again
        kind=AgentClass.TRUCK,
        start=(-60.0, -1.75, 0.0, 7.0),
        phases=((4.0, 0.0, 0.0), (3.5, -2.0, 0.0), (4.0, 0.0, 0.0), (5.0, 1.2, 0.0)),
    ),
    Drive(  # drives in circles of 15 m
        kind=AgentClass.CAR,
        start=(40.0, 25.0, 0.0, 5.0),
        phases=((600.0, 0.0, 0.18),),
    ),
    Drive(  # appears late and leaves early
        kind=AgentClass.MOTORCYCLE,
        start=(1.75, -80.0, math.pi / 2, 11.0),
        phases=((3.0, 0.5, 0.0),),
        appears_s=4.0,
        leaves_s=14.0,
    ),
    Drive(kind=AgentClass.PEDESTRIAN, start=(-12.0, -10.0, math.pi / 2, 1.2), appears_s=2.0),
    Drive(kind=AgentClass.BICYCLE, start=(-70.0, -4.5, 0.0, 4.0)),
    Drive(kind=AgentClass.CAR, start=(25.0, -6.0, 0.0, 0.0)),  # parked
)
"""Vehicles that drive straight, brake, turn, stop and circle, a pedestrian, a bicycle and a parked
car."""


def make_recording(
    *,
    name: str = "00",
    location: str = "crossing",
    frame_rate_hz: float = 25.0,
    duration_s: float = 20.0,
    drives: tuple[Drive, ...] = DRIVES,
    seed: int | None = None,
    road_map: RoadMap | None = None,
) -> Recording:
    """A recording of a crossing of two roads.

    Args:
        name: id of the recording.
        location: name of the place.
        frame_rate_hz: frames per second; motion is integrated frame by frame.
        duration_s: length of the recording.
        drives: the agents, with track ids 1, 2, 3, … in this order.
        seed: varies the speeds of moving agents by up to 20 % and their starts by up to 10 m along
            their heading; by default nothing varies.
        road_map: the map, by default `make_map()`.
    """
    frames = round(duration_s * frame_rate_hz) + 1
    rng = None if seed is None else np.random.default_rng(seed)
    tracks, first_frames = [], []
    for drive in drives:
        first = round(drive.appears_s * frame_rate_hz)
        last = round(min(duration_s, drive.leaves_s) * frame_rate_hz)
        first_frames.append(first)
        tracks.append(_drive(drive, num_frames=last - first + 1, rate_hz=frame_rate_hz, rng=rng))
    classes = np.array([drive.kind for drive in drives], dtype=np.int32)
    return Recording(
        name=name,
        location=location,
        frame_rate_hz=frame_rate_hz,
        num_frames=frames,
        speed_limit_mps=13.89,
        track_ids=np.arange(1, len(drives) + 1, dtype=np.int64),
        classes=classes,
        sizes=FOOTPRINTS_M[classes],
        first_frames=np.array(first_frames, dtype=np.int64),
        starts=np.cumsum([0, *(len(track) for track in tracks)], dtype=np.int64),
        states=np.concatenate(tracks),
        road_map=make_map() if road_map is None else road_map,
    )


def _drive(
    drive: Drive, *, num_frames: int, rate_hz: float, rng: np.random.Generator | None
) -> Float[np.ndarray, "frames 4"]:
    start = np.array(drive.start, dtype=np.float64)
    if rng is not None and start[3] > 0:
        start[:2] += rng.uniform(-10, 10) * np.array([np.cos(start[2]), np.sin(start[2])])
        start[3] *= rng.uniform(0.8, 1.2)
    actions = np.zeros((num_frames - 1, 2))
    begin_s = 0.0
    for duration_s, *action in drive.phases:
        end_s = begin_s + duration_s
        actions[round(begin_s * rate_hz) : round(end_s * rate_hz)] = action
        begin_s = end_s
    length = np.array(FOOTPRINTS_M[int(drive.kind), 0], dtype=np.float64)
    states = rollout(start, actions, length, 1 / rate_hz)
    return np.concatenate([start[None], states]).astype(np.float32)


def make_map() -> RoadMap:
    """Two roads of two lanes along x and y that cross at the origin, and one left turn."""
    lane, half = LANE_M, LANE_M / 2
    curbs = [
        np.array([(sx * ARM_M, sy * lane), (sx * lane, sy * lane), (sx * lane, sy * ARM_M)])
        for sx in (-1, 1)
        for sy in (-1, 1)
    ]
    dashes = [
        np.array([(ARM_M * x, ARM_M * y), (lane * x, lane * y)], dtype=np.float64)
        for x, y in ((1, 0), (-1, 0), (0, 1), (0, -1))
    ]
    roads = [
        np.array([(-ARM_M, -lane), (ARM_M, -lane), (ARM_M, lane), (-ARM_M, lane)]),
        np.array([(-lane, -ARM_M), (lane, -ARM_M), (lane, ARM_M), (-lane, ARM_M)]),
    ]
    arc = np.linspace(0.0, math.pi / 2, 9)
    radius = lane + half
    lanes = [
        np.array([(-ARM_M, -half), (-lane, -half)]),  # 0 eastbound, before the crossing
        np.array([(-lane, -half), (lane, -half)]),  # 1 across it
        np.array([(lane, -half), (ARM_M, -half)]),  # 2 after it
        np.array([(ARM_M, half), (-ARM_M, half)]),  # 3 westbound
        np.array([(half, lane), (half, ARM_M)]),  # 4 northbound, after the crossing
        np.array([(-half, ARM_M), (-half, -ARM_M)]),  # 5 southbound
        np.stack(  # 6 left turn from 0 to 4
            [-lane + radius * np.sin(arc), -half + radius * (1 - np.cos(arc))], axis=-1
        ),
        np.array([(half, -ARM_M), (half, lane)]),  # 7 northbound, up to the far side
    ]
    return RoadMap(
        name="crossing",
        lines=Ragged.pack(curbs + dashes),
        line_types=np.array([LineType.CURB] * len(curbs) + [LineType.DASHED] * len(dashes)),
        drivable=Ragged.pack(roads),
        lanes=Ragged.pack(lanes),
        successors=np.array([(0, 1), (1, 2), (0, 6), (6, 4), (7, 4)], dtype=np.int64),
    )
