"""Writes folders in the INTERACTION layout: agents on a road of two lanes."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np
import pandas as pd
from pyproj import Transformer

from asp_env.dynamics import rollout
from tests.data.levelx_files import two_lane_road

LENGTH_M, WIDTH_M = 4.5, 1.8
PLACE = "DR_ABC_Road_X"
LATITUDE_DEG, LONGITUDE_DEG = 49.0053, 8.4374
"""The origin in `meta_data.csv`."""


def attributes_in_degrees(
    latitude_deg: float = 0.0, longitude_deg: float = 0.0
) -> Callable[[np.ndarray], list[str]]:
    """A function that formats the positions of map nodes, relative to an origin in degrees."""
    zone = int((longitude_deg + 180) // 6) + 1
    utm = Transformer.from_crs(4326, 32600 + zone, always_xy=True)
    back = Transformer.from_crs(32600 + zone, 4326, always_xy=True)
    x_m, y_m = utm.transform(longitude_deg, latitude_deg)

    def write(points: np.ndarray) -> list[str]:
        longitudes, latitudes = back.transform(points[:, 0] + x_m, points[:, 1] + y_m)
        pairs = zip(latitudes, longitudes, strict=True)
        return [f"lat='{latitude:.12f}' lon='{longitude:.12f}'" for latitude, longitude in pairs]

    return write


def attributes_in_metres(points: np.ndarray) -> list[str]:
    """Formats the positions of nodes of an `.osm_xy` file."""
    return [f"x='{x:.6f}' y='{y:.6f}'" for x, y in points.tolist()]


def drive(
    start: Sequence[float], actions: Sequence[tuple[float, float, float]], rate_hz: float
) -> np.ndarray:
    """States (frames, 4) of the bicycle model with each (seconds, acceleration, steering) held."""
    held = np.concatenate(
        [
            np.tile([float(a), steering], (round(seconds * rate_hz), 1))
            for seconds, a, steering in actions
        ]
    )
    begin = np.array(start, dtype=np.float64)
    after = rollout(begin, held, np.float64(LENGTH_M), 1 / rate_hz)
    return np.concatenate([begin[None], np.asarray(after)])


def rows(
    track: int,
    states: np.ndarray,
    *,
    first_frame: int = 0,
    rate_hz: float = 10.0,
    kind: str = "car",
) -> pd.DataFrame:
    """A vehicle's rows of an exact file."""
    frames = first_frame + np.arange(len(states))
    return pd.DataFrame(
        {
            "track_id": track,
            "frame_id": frames + 1,
            "timestamp_ms": np.round(frames * 1000 / rate_hz).astype(int),
            "agent_type": kind,
            "x": states[:, 0],
            "y": states[:, 1],
            "vx": states[:, 3] * np.cos(states[:, 2]),
            "vy": states[:, 3] * np.sin(states[:, 2]),
            "psi_rad": states[:, 2],
            "length": LENGTH_M,
            "width": WIDTH_M,
        }
    )


def walk(
    track: str, start: tuple[float, float], velocity: tuple[float, float], count: int
) -> pd.DataFrame:
    """A pedestrian's rows at 10 Hz, without heading and size."""
    table = rows(0, np.zeros((count, 4)), kind="pedestrian/bicycle")
    path = np.outer(np.arange(count) / 10, velocity) + start
    table["track_id"], table["x"], table["y"] = track, path[:, 0], path[:, 1]
    return table.drop(columns=["psi_rad", "length", "width"])


def some_cars() -> pd.DataFrame:
    """Three cars on the road of `two_lane_road`: one passes, one brakes, one waits, then drives."""
    return pd.concat(
        [
            rows(1, drive((5, -21.75, 0, 8), [(9, 0, 0)], 10)),
            rows(2, drive((110, -18.25, np.pi, 9), [(3, 0, 0), (3, -2, 0), (3, 0, 0)], 10)),
            rows(7, drive((20, -21.75, 0, 0), [(3, 0, 0), (6, 1.5, 0)], 10), first_frame=5),
        ]
    )


def write_recording(
    folder: Path,
    *,
    number: str = "000",
    place: str = PLACE,
    vehicles: pd.DataFrame | None = None,
    pedestrians: pd.DataFrame | None = None,
) -> Path:
    """Writes one recording as in INTERACTION, and returns the location's folder."""
    location = folder / "recorded_trackfiles" / place
    location.mkdir(parents=True, exist_ok=True)
    table = some_cars() if vehicles is None else vehicles
    table.to_csv(location / f"vehicle_tracks_{number}.csv", index=False)
    if pedestrians is not None:
        pedestrians.to_csv(location / f"pedestrian_tracks_{number}.csv", index=False)
    return location


def write_map(
    folder: Path, *, place: str = PLACE, suffix: str = ".osm", text: str | None = None
) -> Path:
    """Writes a map as in INTERACTION."""
    path = folder / "maps" / f"{place}{suffix}"
    path.parent.mkdir(parents=True, exist_ok=True)
    attributes = attributes_in_metres if suffix == ".osm_xy" else attributes_in_degrees()
    path.write_text(two_lane_road(attributes) if text is None else text)
    return path


def write_folder(folder: Path, *, recordings: int = 1, place: str = PLACE) -> Path:
    """Writes recordings of one location, whose clocks begin at other times, and its map."""
    for number in range(recordings):
        vehicles = some_cars()
        vehicles["timestamp_ms"] += 100 * number
        write_recording(folder, number=f"{number:03d}", place=place, vehicles=vehicles)
    write_map(folder, place=place)
    return folder


def write_taf_bw(folder: Path, *, place: str = "k1_2020", **meta: object) -> Path:
    """Writes one recording as in TAF-BW, and returns the location's folder."""
    location = folder / place
    location.mkdir(parents=True)
    some_cars().to_csv(location / "vehicle_tracks_004.csv", index=False)
    row: Mapping[str, object] = {
        "id": "004",
        "frameRate_hz": 10,
        "locationId": "k1",
        "speedLimit_kmh": 50,
        "originLat": LATITUDE_DEG,
        "originLon": LONGITUDE_DEG,
        **meta,
    }
    pd.DataFrame([row]).to_csv(location / "meta_data.csv", index=False)
    write_map(
        folder, place=place, text=two_lane_road(attributes_in_degrees(LATITUDE_DEG, LONGITUDE_DEG))
    )
    return location
