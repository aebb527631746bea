"""Writes folders in the inD layout: agents on sine curves on a road of two lanes."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np
import pandas as pd
from pyproj import Transformer

ORIGIN_M = (300_000.0, 5_600_000.0)
"""Easting and northing in UTM zone 32: near Aachen, at the zone's edge."""

ROAD_LENGTH_M = 120.0


def to_degrees(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(latitudes, longitudes) of local points (n, 2)."""
    utm = Transformer.from_crs(32632, 4326, always_xy=True)
    longitudes, latitudes = utm.transform(points[:, 0] + ORIGIN_M[0], points[:, 1] + ORIGIN_M[1])
    return np.asarray(latitudes), np.asarray(longitudes)


def attributes_in_degrees(points: np.ndarray) -> list[str]:
    """Formats the positions of map nodes at local points (n, 2)."""
    latitudes, longitudes = to_degrees(points)
    return [
        f"lat='{latitude:.12f}' lon='{longitude:.12f}'"
        for latitude, longitude in zip(latitudes, longitudes, strict=True)
    ]


def osm(
    ways: Mapping[str, tuple[Sequence[tuple[float, float]], Mapping[str, str]]],
    lanelets: Mapping[str, tuple[Mapping[str, str], Mapping[str, str]]],
    attributes: Callable[[np.ndarray], list[str]] = attributes_in_degrees,
) -> str:
    """The text of a map.

    Args:
        ways: (local points, tags) by id. Equal points become one node.
        lanelets: (way by role, tags) by id.
        attributes: formats the positions of nodes.
    """
    numbers: dict[tuple[float, float], int] = {}
    lines = ["<?xml version='1.0' encoding='UTF-8'?>", "<osm version='0.6'>"]
    for points, _ in ways.values():
        for point in points:
            numbers.setdefault((float(point[0]), float(point[1])), len(numbers) + 1)
    points = np.array(list(numbers), dtype=np.float64)
    for number, position in zip(numbers.values(), attributes(points), strict=True):
        lines.append(f"<node id='{number}' {position} />")
    for name, (points, tags) in ways.items():
        nodes = "".join(f"<nd ref='{numbers[float(x), float(y)]}' />" for x, y in points)
        lines.append(f"<way id='{name}'>{nodes}{_tags(tags)}</way>")
    for name, (members, tags) in lanelets.items():
        inside = "".join(
            f"<member type='way' ref='{way}' role='{role}' />" for role, way in members.items()
        )
        lines.append(f"<relation id='{name}'>{inside}{_tags(tags)}</relation>")
    return "\n".join([*lines, "</osm>"])


def two_lane_road(
    attributes: Callable[[np.ndarray], list[str]] = attributes_in_degrees,
) -> str:
    """A straight road along +x: one lane each way, 3.5 m wide, between y = -23.5 and -16.5."""
    edges = {"south": -23.5, "middle": -20.0, "north": -16.5}
    kinds = {
        "south": {"type": "curbstone", "subtype": "high"},
        "middle": {"type": "line_thin", "subtype": "dashed"},
        "north": {"type": "road_border"},
    }
    ways = {
        name: ([(0.0, y), (60.0, y), (ROAD_LENGTH_M, y)], kinds[name]) for name, y in edges.items()
    }
    road = {"type": "lanelet", "subtype": "road"}
    lanelets = {
        "101": ({"left": "middle", "right": "south"}, road),
        "102": ({"left": "middle", "right": "north"}, road),
    }
    return osm(ways, lanelets, attributes)


def track_rows(track: int, frames: np.ndarray, rate_hz: float, kind: str = "car") -> pd.DataFrame:
    """The rows of a track on a sine curve, with exact derivatives."""
    time = frames / rate_hz
    omega, amplitude, speed = 0.4, 1.0, 4.0 + track % 5
    x = 5.0 + speed * (time - time[0]) % (ROAD_LENGTH_M - 10)
    y = -20.0 - track % 3 + amplitude * np.sin(omega * time)
    v_y = amplitude * omega * np.cos(omega * time)
    v_x = np.full_like(v_y, speed)
    a_y = -amplitude * omega**2 * np.sin(omega * time)
    heading = np.degrees(np.arctan2(v_y, v_x)) % 360
    vehicle = kind not in ("pedestrian", "bicycle")
    along = np.hypot(v_x, v_y)
    zeros = np.zeros_like(x)
    return pd.DataFrame(
        {
            "recordingId": 0,
            "trackId": track,
            "frame": frames,
            "trackLifetime": frames - frames[0],
            "xCenter": x.round(5),
            "yCenter": y.round(5),
            "heading": heading.round(5) if vehicle else zeros,
            "width": 1.8 if vehicle else 0.0,
            "length": 4.5 if vehicle else 0.0,
            "xVelocity": v_x.round(5),
            "yVelocity": v_y.round(5),
            "xAcceleration": zeros,
            "yAcceleration": a_y.round(5),
            "lonVelocity": along.round(5),
            "latVelocity": zeros,
            "lonAcceleration": (v_y * a_y / along).round(5),
            "latAcceleration": (v_x * a_y / along).round(5),
        }
    )


def write_recording(
    folder: Path,
    *,
    number: int = 0,
    location: int = 1,
    rate_hz: float = 25.0,
    classes: Sequence[str] = ("car", "car", "pedestrian"),
    num_frames: int = 250,
    tracks: pd.DataFrame | None = None,
    suffix: str = "",
) -> Path:
    """Writes one recording's three tables into `folder/data` and returns that folder.

    `tracks` replaces the default rows; `suffix` may be `.gz` or `.xz`.
    """
    data = folder / "data"
    data.mkdir(parents=True, exist_ok=True)
    if tracks is None:
        tracks = pd.concat(
            [
                track_rows(track, np.arange(track, num_frames), rate_hz, kind)
                for track, kind in enumerate(classes)
            ]
        )
    ids, frames = tracks["trackId"].to_numpy(), tracks["frame"].to_numpy()
    known, first_rows = np.unique(ids, return_index=True)
    of_track = [frames[ids == track] for track in known]
    meta = pd.DataFrame(
        {
            "recordingId": number,
            "trackId": known,
            "initialFrame": [each.min() for each in of_track],
            "finalFrame": [each.max() for each in of_track],
            "numFrames": [len(each) for each in of_track],
            "width": tracks["width"].to_numpy()[first_rows],
            "length": tracks["length"].to_numpy()[first_rows],
            "class": list(classes),
        }
    )
    latitude, longitude = to_degrees(np.array([[60.0, -20.0]]))
    recording = {
        "recordingId": number,
        "locationId": location,
        "frameRate": rate_hz,
        "speedLimit": 13.9,
        "weekday": "Mon",
        "startTime": 8,
        "duration": num_frames / rate_hz,
        "numTracks": len(meta),
        "numVehicles": len(meta),
        "numVRUs": 0,
        "latLocation": latitude[0],
        "lonLocation": longitude[0],
        "xUtmOrigin": ORIGIN_M[0],
        "yUtmOrigin": ORIGIN_M[1],
        "orthoPxToMeter": 0.01,
    }
    prefix = f"{number:02d}"
    pd.DataFrame([recording]).to_csv(data / f"{prefix}_recordingMeta.csv", index=False)
    meta.to_csv(data / f"{prefix}_tracksMeta.csv", index=False)
    tracks.to_csv(data / f"{prefix}_tracks.csv{suffix}", index=False)
    return data


def write_map(folder: Path, *, location: int = 1, text: str | None = None) -> Path:
    """Writes a map as in the inD layout."""
    path = folder / "maps" / "lanelets" / f"{location:02d}_place" / f"location{location}.osm"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(two_lane_road() if text is None else text)
    return path


def write_folder(folder: Path, *, recordings: int = 1, location: int = 1) -> Path:
    """Writes recordings of one location, and its map."""
    for number in range(recordings):
        write_recording(folder, number=number, location=location)
    write_map(folder, location=location)
    return folder


def _tags(tags: Mapping[str, str]) -> str:
    return "".join(f"<tag k='{key}' v='{value}' />" for key, value in tags.items())
