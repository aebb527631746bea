"""Writes the crossing of `tests.builders` to disk in the inD layout."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pandas as pd

from asp_env.data.classes import AgentClass
from asp_env.data.recording import Recording
from tests.builders import ARM_M, DRIVES, LANE_M, Drive, make_recording
from tests.data.levelx_files import osm, write_map, write_recording

ON_ROAD = tuple(drive for number, drive in enumerate(DRIVES) if number not in (5, 8))
"""All drives except the two beside the road."""


def write_crossing(
    folder: Path, *, drives: Sequence[Sequence[Drive]] = (ON_ROAD,), seconds: float = 20.0
) -> Path:
    """A folder with one recording of the same place for each sequence of drives."""
    for number, each in enumerate(drives):
        recording = make_recording(drives=tuple(each), duration_s=seconds)
        write_recording(
            folder,
            number=number,
            classes=[AgentClass(kind).name.lower() for kind in recording.classes.tolist()],
            num_frames=recording.num_frames,
            tracks=_rows(recording),
        )
    write_map(folder, text=_two_roads())
    return folder


def _rows(recording: Recording) -> pd.DataFrame:
    tables = []
    for track in range(len(recording)):
        x, y, heading, speed = recording.track(track).astype(np.float64).T
        frames = recording.first_frames[track] + np.arange(len(x))
        length, width = recording.sizes[track]
        v_x, v_y, zeros = speed * np.cos(heading), speed * np.sin(heading), np.zeros_like(x)
        columns = {
            "recordingId": int(recording.name),
            "trackId": int(recording.track_ids[track]),
            "frame": frames,
            "trackLifetime": frames - frames[0],
            "xCenter": x,
            "yCenter": y,
            "heading": np.degrees(heading) % 360,
            "width": width,
            "length": length,
            "xVelocity": v_x,
            "yVelocity": v_y,
            "xAcceleration": zeros,
            "yAcceleration": zeros,
            "lonVelocity": speed,
            "latVelocity": zeros,
            "lonAcceleration": zeros,
            "latAcceleration": zeros,
        }
        tables.append(pd.DataFrame(columns).round(6))
    return pd.concat(tables)


def _two_roads() -> str:
    """The crossing as four lanelets from end to end."""
    curb, line = {"type": "curbstone"}, {"type": "line_thin", "subtype": "dashed"}
    ways, lanelets = {}, {}
    for axis, names in enumerate((("s", "x", "n"), ("w", "y", "e"))):
        for name, offset in zip(names, (-LANE_M, 0.0, LANE_M), strict=True):
            ends = [(-ARM_M, offset), (0.0, offset), (ARM_M, offset)]
            points = ends if axis == 0 else [(y, x) for x, y in ends]
            ways[name] = (points, line if offset == 0 else curb)
        for number, side in enumerate((names[0], names[2])):
            road = {"type": "lanelet", "subtype": "road"}
            lanelets[f"{axis + 1}0{number}"] = ({"left": names[1], "right": side}, road)
    return osm(ways, lanelets)
