"""Writer of the tables of one recording in the inD layout."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from asp_env.errors import AspEnvError

RECORDING_META_COLUMNS = (
    "recordingId", "locationId", "frameRate", "speedLimit", "weekday", "startTime", "duration",
    "numTracks", "numVehicles", "numVRUs", "latLocation", "lonLocation", "xUtmOrigin",
    "yUtmOrigin", "orthoPxToMeter",
)  # fmt: skip
TRACKS_META_COLUMNS = (
    "recordingId", "trackId", "initialFrame", "finalFrame", "numFrames", "width", "length", "class",
)  # fmt: skip
TRACKS_COLUMNS = (
    "recordingId", "trackId", "frame", "trackLifetime", "xCenter", "yCenter", "heading", "width",
    "length", "xVelocity", "yVelocity", "xAcceleration", "yAcceleration", "lonVelocity",
    "latVelocity", "lonAcceleration", "latAcceleration",
)  # fmt: skip
DERIVED_COLUMNS = ("trackLifetime", "lonVelocity", "latVelocity", "latAcceleration")
"""Columns that follow from the others and that the reader does not use; compressed tables, whose
purpose is to be small, leave them out."""
VULNERABLE = ("pedestrian", "bicycle")
"""Classes whose size is written as zero."""
XZ_PRESET = 6 | 1 << 31
"""`xz -6e`. Reading takes 9 MiB; higher presets do not make a table of a few minutes smaller."""
MAX_RECORDINGS = 10_000
"""Largest number of recordings of one command. Chosen by hand."""
_ROW = "%d,%d,%d,%d,%.4f,%.4f,%.4f,%s,%s,%.4f,%.4f,%.3f,%.3f,%.4f,%.4f,%.3f,%.3f\n"


def check_numbers(*, recordings: int, seed: int) -> None:
    """Checks the number of recordings to generate, and the seed.

    Raises:
        AspEnvError: one of them is out of range.
    """
    if not 1 <= recordings <= MAX_RECORDINGS:
        raise AspEnvError(f"--recordings {recordings}: expected 1 to {MAX_RECORDINGS:,}")
    if seed < 0:
        raise AspEnvError(f"--seed {seed}: expected at least 0")


@dataclass(frozen=True, slots=True, kw_only=True)
class Track:
    """The frames of one agent that are written, in the recording's frame."""

    kind: str
    length_m: float
    width_m: float
    first_frame: int
    xy: Float[np.ndarray, "frames 2"]
    heading_rad: Float[np.ndarray, " frames"]
    velocity_mps: Float[np.ndarray, "frames 2"]
    acceleration_mps2: Float[np.ndarray, "frames 2"]

    @property
    def last_frame(self) -> int:
        return self.first_frame + len(self.xy) - 1

    @property
    def written_size_m(self) -> tuple[float, float]:
        """(length, width) as written: zero for pedestrians and bicycles, as in inD."""
        return (0.0, 0.0) if self.kind in VULNERABLE else (self.length_m, self.width_m)


@dataclass(frozen=True, slots=True, kw_only=True)
class Meta:
    """The metadata of a recording."""

    recording: int
    location: int
    frame_rate_hz: float
    speed_limit_mps: float
    weekday: str
    start_hour: int
    num_frames: int
    lat_deg: float
    lon_deg: float
    utm_origin_m: tuple[float, float]
    metres_per_ortho_pixel: float


def write_recording_meta(path: Path, meta: Meta, tracks: list[Track]) -> None:
    """Writes `XX_recordingMeta.csv`."""
    vulnerable = sum(track.kind in VULNERABLE for track in tracks)
    values = (
        meta.recording, meta.location, meta.frame_rate_hz, f"{meta.speed_limit_mps:.2f}",
        meta.weekday, meta.start_hour, f"{meta.num_frames / meta.frame_rate_hz:.2f}", len(tracks),
        len(tracks) - vulnerable, vulnerable, f"{meta.lat_deg:.6f}", f"{meta.lon_deg:.6f}",
        *(f"{value:.2f}" for value in meta.utm_origin_m), f"{meta.metres_per_ortho_pixel:.5f}",
    )  # fmt: skip
    rows = (RECORDING_META_COLUMNS, values)
    path.write_text("".join(",".join(map(str, row)) + "\n" for row in rows), encoding="utf-8")


def write_tracks_meta(path: Path, recording: int, tracks: list[Track]) -> None:
    """Writes `XX_tracksMeta.csv`; the id of a track is its index."""
    rows = [",".join(TRACKS_META_COLUMNS)]
    for number, track in enumerate(tracks):
        length, width = track.written_size_m
        frames = f"{track.first_frame},{track.last_frame},{len(track.xy)}"
        rows.append(f"{recording},{number},{frames},{width:.2f},{length:.2f},{track.kind}")
    path.write_text("\n".join(rows) + "\n", encoding="utf-8")


def write_tracks(path: Path, recording: int, tracks: list[Track]) -> None:
    """Writes `XX_tracks.csv`; equal tracks, equal bytes.

    If the name ends in `.xz`, the table is compressed and lacks the `DERIVED_COLUMNS`.
    """
    text = ",".join(TRACKS_COLUMNS) + "\n"
    text += "".join(_rows(recording, number, track) for number, track in enumerate(tracks))
    if path.suffix == ".xz":
        import lzma  # Python may be built without it

        path.write_bytes(lzma.compress(_without_derived(text).encode(), preset=XZ_PRESET))
    else:
        path.write_text(text, encoding="utf-8")


def _without_derived(text: str) -> str:
    kept = [i for i, name in enumerate(TRACKS_COLUMNS) if name not in DERIVED_COLUMNS]
    rows = (line.split(",") for line in text.splitlines())
    return "".join(",".join(cells[i] for i in kept) + "\n" for cells in rows)


def _rows(recording: int, number: int, track: Track) -> str:
    count = len(track.xy)
    ahead = np.stack([np.cos(track.heading_rad), np.sin(track.heading_rad)], axis=1)
    left = np.stack([-ahead[:, 1], ahead[:, 0]], axis=1)
    velocity, acceleration = track.velocity_mps, track.acceleration_mps2
    heading = np.round(np.degrees(track.heading_rad), 4) % 360.0
    along = [np.sum(a * b, axis=1) for a in (velocity, acceleration) for b in (ahead, left)]
    columns = [
        *track.xy.T.round(4), heading, *velocity.T.round(4), *acceleration.T.round(3),
        *(np.round(along[:2], 4)), *(np.round(along[2:], 3)),
    ]  # fmt: skip
    numbers = (np.stack(columns) + 0.0).T.tolist()  # adding zero turns -0 into 0
    length, width = (f"{value:.2f}" for value in track.written_size_m)
    return "".join(
        _ROW % (recording, number, track.first_frame + i, i, *row[:3], width, length, *row[3:])
        for i, row in zip(range(count), numbers, strict=True)
    )
