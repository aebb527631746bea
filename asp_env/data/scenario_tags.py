"""What happens in a scenario, as the recording shows it: tags and measures, by exact rules.

All rules look at the ticks of the drive alone, the first observation and the last tick included.
The ego's way is where it went until its track ends, then straight on (`route_along`). Others are
road users that are not parked. One is on the way while its centre is nearer to it than half of both
widths together, and a leader if it is a vehicle or bicycle on the way ahead that heads within 45°
of it or stands. One comes onto the way from the side if it was not on it one tick before and is
now, ahead of the ego's front, where the way is a recorded one, at 0.5 m/s or more and at an angle
of at least 20° to it, in either sense.

`left`, `right`, `straight`: the heading turns by over 30° in all to the left, to the right, or by
    less; every scenario has one of them. Headings below 0.5 m/s do not count.
`u-turn`: it turns by over 150° in all, and the scenario is no `roundabout`.
`standing-start`: below 0.5 m/s at the first tick.
`stopping`: stands, below 0.5 m/s, for at least 1 s in a row after having driven at 2 m/s or more.
`following`: at over half of the ticks at which the ego drives at 0.5 m/s or more there is a leader,
    and the gap to it is at most 3 s at the ego's speed, or at most 5 m.
`yielding`: somebody comes onto the way from the side at most 20 m ahead of the ego's front, with no
    leader in between, and the ego's front gets to that place within 5 s after the other was last on
    the way at an angle of at least 20° to it. From 3 s before the other came until it gets there
    the ego is slowest no later than 1 s after that, below 0.5 m/s or at 0.6 or less of its highest
    speed in the 5 s before, and it gets there at least 1 m/s faster.
`crossing-vru`: a pedestrian, bicycle or animal passes over the middle of the way at most 30 m ahead
    of the ego's front, where the way is a recorded one, at 0.5 m/s or more and at an angle of at
    least 30° to it, in either sense.
`roundabout`: drives at least 10 m along a ring of the map (`asp_env.data.scenario_rings`), within
    2 m of the middle of one of its lanes and heading within 45° of it.
`roundabout-entry`, `roundabout-exit`: a `roundabout` in which it comes onto the ring; leaves it.

Signals are in no recording, so who waits at one while others cross is `yielding`, too.
"""

import numpy as np
from jaxtyping import Bool, Float, Int

from asp_env.data import scenario_rules as rules
from asp_env.data.classes import PREDICTED, VULNERABLE, AgentClass
from asp_env.data.geometry import route_along
from asp_env.data.recording import Recording
from asp_env.data.scenario_rings import ring_points

TAGS = (
    *("left", "right", "straight", "u-turn"),
    *("standing-start", "stopping", "following", "yielding", "crossing-vru"),
    *("roundabout", "roundabout-entry", "roundabout-exit"),
)
"""In the order of the rules' columns."""

COLUMNS = {
    "length_s": "how long the recording goes on after the first observation",
    "distance_m": "how far the ego goes",
    "max_speed_mps": "its highest speed",
    "turn_deg": "by how much its heading turns in all while it does not stand, left positive",
    "density": "how many others are within 30 m of it, on average over the ticks",
    "agents": "how many others are there at any tick",
}
"""Measures and what they are, in the order of the rules' columns."""


def describe(
    recording: Recording,
    tracks: Int[np.ndarray, " n"],
    start_ticks: Int[np.ndarray, " n"],
    lengths: Int[np.ndarray, " n"],
    *,
    stride: int,
) -> tuple[Bool[np.ndarray, "n tags"], Float[np.ndarray, "n columns"]]:
    """(n, `TAGS`) and (n, `COLUMNS`) of some drives of a recording.

    Args:
        recording: where they are.
        tracks: indices of the egos' tracks.
        start_ticks: of the first observations.
        lengths: in ticks; all of these must be within the egos' tracks.
        stride: frames per tick.
    """
    tags = np.zeros((len(tracks), len(TAGS)), dtype=bool)
    values = np.zeros((len(tracks), len(COLUMNS)))
    first = recording.first_frames.astype(np.int64)
    ways = [np.zeros((0, 2), dtype=np.float32)]
    for track, tick in zip(tracks.tolist(), start_ticks.tolist(), strict=True):
        ahead = recording.track(track)[tick * stride - first[track] :: stride]
        ways.append(route_along(ahead, beyond_m=rules.BEYOND_M))
    rules.describe_all(
        np.array(recording.states),  # copies of what may be read-only: one kernel for all
        recording.starts.astype(np.int64),
        first,
        recording.last_frames.astype(np.int64),
        np.array(recording.sizes),
        _roles(recording),
        tracks.astype(np.int64),
        start_ticks.astype(np.int64),
        lengths.astype(np.int64),
        stride,
        stride / recording.frame_rate_hz,
        np.concatenate(ways),
        np.cumsum([len(way) for way in ways]),
        ring_points(recording.road_map),
        tags,
        values,
    )
    return tags, values


def _roles(recording: Recording) -> Int[np.ndarray, " tracks"]:
    """What each track may be to an ego, as bits; 0 for parked vehicles."""
    leads = [int(kind) for kind in PREDICTED | {AgentClass.BICYCLE, AgentClass.TRAILER}]
    vulnerable = [int(kind) for kind in VULNERABLE]
    roles = np.full(len(recording), rules.PRESENT, dtype=np.int64)
    roles[np.isin(recording.classes, leads)] |= rules.LEADS
    roles[np.isin(recording.classes, vulnerable)] |= rules.VULNERABLE
    roles[recording.parked] = 0
    return roles
