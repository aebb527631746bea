"""Paths of recorded tracks."""

import numpy as np
import pytest

from asp_env.data.source import open_data
from asp_env.dynamics.car_following import IDM, speed_limits
from asp_env.geometry import route_along
from asp_env.sim.episodes import ROUTE_EXTENSION_M
from asp_env.sim.traffic.paths import Paths
from tests.builders import make_recording
from tests.real_data import real_data

RECORDINGS = [make_recording(), make_recording(name="01", seed=4, frame_rate_hz=10.0)]


def _path(paths: Paths, track: int) -> np.ndarray:
    starts = paths.table.point_starts
    return paths.table.points[starts[track] : starts[track + 1]]


@pytest.mark.parametrize(
    "source",
    ["synthetic", "sample:roundabout", pytest.param("karlsruhe", marks=pytest.mark.data)],
)
def test_every_path_is_the_route_of_its_track(source):
    """The kernel and `route_along` yield the same points within 1 mm."""
    recordings = RECORDINGS
    if source != "synthetic":
        folder = real_data(source) if source == "karlsruhe" else source
        recordings = open_data(folder).subset(range(2 if source == "karlsruhe" else 1))
    paths = Paths(IDM())
    for number, recording in enumerate(recordings):
        first = paths.first_path(recordings, number)
        for track in range(len(recording)):
            route = route_along(recording.track(track), beyond_m=ROUTE_EXTENSION_M)
            assert _path(paths, first + track)[:, :2] == pytest.approx(route, abs=1e-3)
            assert paths.table.ends_m[first + track] == len(route) - 1 - ROUTE_EXTENSION_M


def test_the_paths_of_a_recording_are_added_once():
    paths = Paths(IDM())
    first = paths.first_path(RECORDINGS, 0)
    points = paths.table.points.copy()
    second = paths.first_path(RECORDINGS, 1)
    assert (first, second) == (0, len(RECORDINGS[0]))
    assert paths.first_path(RECORDINGS, 0) == first
    assert paths.table.points[: len(points)].tobytes() == points.tobytes()
    assert len(paths.table.ends_m) == sum(len(recording) for recording in RECORDINGS)


def test_headings_and_arc_lengths_are_those_of_the_track():
    """At each recorded frame the path has the position and the heading of the track."""
    paths = Paths(IDM())
    paths.first_path(RECORDINGS, 0)
    turning = 2  # the third track turns left by a quarter
    states = RECORDINGS[0].track(turning)
    rows = paths.table.row_starts
    arcs = paths.table.log_arcs_m[rows[turning] : rows[turning + 1]]
    path = _path(paths, turning)
    assert (np.diff(arcs) >= 0).all()
    index = np.minimum(arcs.astype(int), len(path) - 2)
    share = (arcs - index)[:, None]
    positions = path[index, :2] * (1 - share) + path[index + 1, :2] * share
    assert np.linalg.norm(positions - states[:, :2], axis=-1).max() < 0.3
    heading = np.arctan2(path[index, 3], path[index, 2])
    turned = (heading - states[:, 2] + np.pi) % (2 * np.pi) - np.pi
    assert np.abs(turned).max() < 0.15


def test_speed_limits_of_every_path():
    """`speed_limits` of the highest recorded speed, at least 3 m/s; 0 where a vehicle stops."""
    paths = Paths(IDM())
    paths.first_path(RECORDINGS, 0)
    table = paths.table
    for track in range(len(RECORDINGS[0])):
        speeds = np.abs(RECORDINGS[0].track(track)[:, 3])
        stop = table.ends_m[track] if table.halts[track] else np.inf
        assert table.halts[track] == (speeds[-1] < 0.5)
        desired_mps = max(float(speeds.max()), 3.0)
        expected = speed_limits(_path(paths, track)[:, :2], desired_mps, IDM(), stop_m=float(stop))
        starts = table.point_starts
        limits = table.speed_limits[starts[track] : starts[track + 1]]
        assert limits == pytest.approx(expected, abs=1e-4)
