"""The ways of all tracks, laid at once."""

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
    return paths.points[paths.firsts[track] : paths.firsts[track + 1]]


@pytest.mark.parametrize(
    "source",
    ["made up", "sample:roundabout", pytest.param("karlsruhe", marks=pytest.mark.data)],
)
def test_every_path_is_the_route_of_its_track(source):
    """The kernel and `route_along` lay the same points, to a millimetre."""
    recordings = RECORDINGS
    if source != "made up":
        folder = real_data(source) if source == "karlsruhe" else source
        recordings = open_data(folder).subset(range(2 if source == "karlsruhe" else 1))
    paths = Paths(IDM())
    for number, recording in enumerate(recordings):
        base = paths.base(recordings, number)
        for track in range(len(recording)):
            route = route_along(recording.track(track), beyond_m=ROUTE_EXTENSION_M)
            assert _path(paths, base + track)[:, :2] == pytest.approx(route, abs=1e-3)
            assert paths.ends[base + track] == len(route) - 1 - ROUTE_EXTENSION_M


def test_a_recording_is_laid_once():
    """Asked again, or for another one, what is there stays where it is."""
    paths = Paths(IDM())
    first = paths.base(RECORDINGS, 0)
    points = paths.points.copy()
    second = paths.base(RECORDINGS, 1)
    assert (first, second) == (0, len(RECORDINGS[0]))
    assert paths.base(RECORDINGS, 0) == first
    assert paths.points[: len(points)].tobytes() == points.tobytes()
    assert len(paths.ends) == sum(len(recording) for recording in RECORDINGS)


def test_headings_and_arcs_are_the_logs():
    """Where the log is at a frame its path says the same heading, and its position is there."""
    paths = Paths(IDM())
    paths.base(RECORDINGS, 0)
    turning = 2  # the third track turns left by a quarter
    states = RECORDINGS[0].track(turning)
    arcs = paths.arcs[paths.rows[turning] : paths.rows[turning + 1]]
    path = _path(paths, turning)
    assert (np.diff(arcs) >= 0).all()
    at = np.minimum(arcs.astype(int), len(path) - 2)
    share = (arcs - at)[:, None]
    there = path[at, :2] * (1 - share) + path[at + 1, :2] * share
    assert np.linalg.norm(there - states[:, :2], axis=-1).max() < 0.3
    heading = np.arctan2(path[at, 3], path[at, 2])
    turned = (heading - states[:, 2] + np.pi) % (2 * np.pi) - np.pi
    assert np.abs(turned).max() < 0.15


def test_limits_are_those_of_each_path():
    """As `speed_limits` says for the highest logged speed, at least 3 m/s; 0 where a log halts."""
    paths = Paths(IDM())
    paths.base(RECORDINGS, 0)
    for track in range(len(RECORDINGS[0])):
        speeds = np.abs(RECORDINGS[0].track(track)[:, 3])
        stop = paths.ends[track] if paths.halts[track] else np.inf
        assert paths.halts[track] == (speeds[-1] < 0.5)
        wanted_mps = max(float(speeds.max()), 3.0)
        expected = speed_limits(_path(paths, track)[:, :2], wanted_mps, IDM(), stop_m=float(stop))
        limits = paths.limits[paths.firsts[track] : paths.firsts[track + 1]]
        assert limits == pytest.approx(expected, abs=1e-4)
