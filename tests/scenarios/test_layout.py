"""Synthetic traffic is written in the inD layout."""

from pathlib import Path

import cv2
import numpy as np
import pandas as pd
import pytest

from asp_env.data.classes import AgentClass
from asp_env.data.source import open_data
from asp_env.geometry import wrap_angle
from asp_env.metrics.drivable import off_road_m

RECORDINGS = ("00", "01")
FRAMES = 3000


def table(site: Path, name: str) -> pd.DataFrame:
    """One of the folder's CSV files."""
    return pd.read_csv(site / "data" / f"{name}.csv")


@pytest.mark.parametrize(
    ("name", "columns"),
    [
        (
            "00_recordingMeta",
            "recordingId,locationId,frameRate,speedLimit,weekday,startTime,duration,numTracks,"
            "numVehicles,numVRUs,latLocation,lonLocation,xUtmOrigin,yUtmOrigin,orthoPxToMeter",
        ),
        (
            "00_tracksMeta",
            "recordingId,trackId,initialFrame,finalFrame,numFrames,width,length,class",
        ),
        (
            "00_tracks",
            "recordingId,trackId,frame,trackLifetime,xCenter,yCenter,heading,width,length,"
            "xVelocity,yVelocity,xAcceleration,yAcceleration,lonVelocity,latVelocity,"
            "lonAcceleration,latAcceleration",
        ),
    ],
)
def test_columns_are_the_formats_in_order(site: Path, name: str, columns: str) -> None:
    """The columns are exactly those that the description of the format lists."""
    with (site / "data" / f"{name}.csv").open() as lines:
        assert next(lines) == columns + "\n"


def test_metadata_count_the_tracks(site: Path) -> None:
    """Numbers of tracks, vehicles and VRUs, and first and last frames, are those of the tracks."""
    for name in RECORDINGS:
        meta, tracks = table(site, f"{name}_tracksMeta"), table(site, f"{name}_tracks")
        whole = table(site, f"{name}_recordingMeta").iloc[0]
        vulnerable = int(np.isin(meta["class"], ["pedestrian", "bicycle"]).sum())
        assert (whole.numTracks, whole.numVRUs) == (len(meta), vulnerable)
        assert whole.numVehicles == len(meta) - vulnerable
        assert (whole.frameRate, whole.duration) == (25, 120)
        frames = tracks.groupby("trackId").frame.agg(["min", "max", "size"])
        assert np.array_equal(
            frames.to_numpy(), meta[["initialFrame", "finalFrame", "numFrames"]].to_numpy()
        )
        assert frames["min"].min() == 0
        assert frames["max"].max() == FRAMES - 1
        assert np.array_equal(frames["max"] - frames["min"] + 1, frames["size"])


def test_axes_and_units(site: Path) -> None:
    """Origin top left, x right, y up; degrees in [0, 360); VRUs have no size."""
    for name in RECORDINGS:
        tracks, meta = table(site, f"{name}_tracks"), table(site, f"{name}_tracksMeta")
        assert np.isfinite(tracks.select_dtypes("number").to_numpy()).all()
        assert tracks.xCenter.min() > 0
        assert tracks.yCenter.max() < 0
        assert tracks.heading.between(0.0, 360.0, inclusive="left").all()
        feet = meta["class"].isin(["pedestrian", "bicycle"])
        assert (meta.loc[feet, ["width", "length"]] == 0).all(axis=None)
        assert (meta.loc[~feet, ["width", "length"]] > 0.5).all(axis=None)


def test_velocities_are_those_of_the_positions(site: Path) -> None:
    """Central differences of positions give the velocity within rounding, 4 mm/s."""
    tracks = table(site, "00_tracks")
    for _, track in tracks.groupby("trackId"):
        xy = track[["xCenter", "yCenter"]].to_numpy()
        velocity = track[["xVelocity", "yVelocity"]].to_numpy()
        assert np.abs((xy[2:] - xy[:-2]) * 12.5 - velocity[1:-1]).max() < 0.004
        ahead = np.radians(track.heading.to_numpy())
        along = velocity[:, 0] * np.cos(ahead) + velocity[:, 1] * np.sin(ahead)
        assert np.abs(along - track.lonVelocity).max() < 0.001


def test_parked_cars_span_the_recording(site: Path) -> None:
    """Some cars stand at one position from the first frame to the last."""
    for recording in open_data(site):
        parked = np.flatnonzero(recording.parked)
        still = [i for i in parked if np.ptp(recording.track(int(i)), axis=0).max() == 0.0]
        assert still
        assert all(recording.classes[i] == AgentClass.CAR for i in still)


def test_the_background_shows_asphalt_under_the_cars(site: Path) -> None:
    """Pixels at moving vehicles' middles are grey (grass is green); not so if y were flipped."""
    for recording in open_data(site):
        assert recording.background is not None
        assert recording.background.path.stat().st_size < 150_000
        image = cv2.imread(str(recording.background.path))
        assert image is not None
        rows = np.concatenate(
            [recording.track(int(i))[:, :2] for i in np.flatnonzero(recording.predicted)]
        )
        column, row = (rows / recording.background.metres_per_pixel).T.astype(int)
        spread = np.ptp(image.astype(int), axis=2)
        assert np.mean(spread[-row, column] < 20) > 0.99
        assert np.mean(spread[row % len(image), column] < 20) < 0.9


def test_vehicles_stay_on_the_map(site: Path) -> None:
    """Fewer than 0.5 % of moving vehicles' boxes have a corner 0.3 m off the lanelets."""
    for recording in open_data(site):
        tracks = np.flatnonzero(recording.predicted)
        states = np.concatenate([recording.track(int(i)) for i in tracks])
        sizes = np.concatenate(
            [np.tile(recording.sizes[i], (len(recording.track(int(i))), 1)) for i in tracks]
        )
        assert np.mean(off_road_m(recording.road_map, states, sizes) > 0.3) < 0.005


def test_the_map_needs_no_repair(site: Path) -> None:
    """The reader repairs nothing, and every lane but those at the rim has a successor."""
    for recording in open_data(site):
        assert recording.repairs == ()
        assert recording.road_map.repairs == ()
        lanes = len(recording.road_map.lanes)
        assert len(np.unique(recording.road_map.successors[:, 0])) >= lanes - 5
        assert len(np.unique(recording.road_map.successors[:, 1])) >= lanes - 6


def test_the_map_lies_under_the_tracks(site: Path) -> None:
    """A moving car's heading is that of the nearest lane, and the lane is within 1 m, mostly."""
    for recording in open_data(site):
        lanes = [recording.road_map.lanes[i] for i in range(len(recording.road_map.lanes))]
        points = np.concatenate([0.5 * (lane[1:] + lane[:-1]) for lane in lanes])
        steps = np.concatenate([np.diff(lane, axis=0) for lane in lanes])
        cars = [int(i) for i in np.flatnonzero(recording.predicted)]
        states = np.concatenate([recording.track(i)[::25] for i in cars]).astype(np.float64)
        states = states[states[:, 3] > 2.0]
        gaps = np.hypot(*(states[:, None, :2] - points).transpose(2, 0, 1))
        course = np.arctan2(steps[:, 1], steps[:, 0])
        turned = np.abs(wrap_angle(states[:, 2:3] - course))
        matching = np.where(turned < np.radians(25.0), gaps, np.inf).min(axis=1)
        assert np.mean(matching < 2.0) > 0.95
