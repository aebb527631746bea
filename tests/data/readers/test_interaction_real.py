"""TAF-BW as published, compared with the same recordings in the inD layout, smoothed by others."""

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from asp_env.data.classes import AgentClass
from asp_env.data.recording import Recording
from asp_env.data.snippets import find_snippets
from asp_env.data.source import Recordings, open_data
from asp_env.evaluation.inspect import drift_m
from asp_env.geometry import wrap_angle
from tests.real_data import real_data

SAME_RECORDINGS = {
    "k733_2020-09-15/000": "00",
    "k729_2022-03-16/004": "05",
    "k729_2022-03-16/013": "14",
}
"""Names of recordings in TAF-BW's own layout, and their ids in the inD layout."""

VULNERABLE = (AgentClass.BICYCLE, AgentClass.PEDESTRIAN)


@pytest.fixture(scope="module")
def published() -> Recordings:
    """The recordings as published."""
    return open_data(real_data("taf_bw"))


@pytest.fixture(scope="module")
def smoothed() -> Recordings:
    """All recordings of the same location, in the inD layout."""
    return open_data(real_data("karlsruhe"))


def matching_states(recording: Recording, other: Recording) -> tuple[np.ndarray, np.ndarray]:
    """The vehicles' states in both, row by row, where tracks run within 1 m of each other."""
    states, other_states = [], []
    for j in np.flatnonzero(~np.isin(other.classes, VULNERABLE)).tolist():
        pairs = []
        for i in np.flatnonzero(~np.isin(recording.classes, VULNERABLE)).tolist():
            first = max(recording.first_frames[i], other.first_frames[j])
            end = min(recording.last_frames[i], other.last_frames[j]) + 1
            if end - first > 5:
                one = recording.track(i)[first - recording.first_frames[i] :][: end - first]
                two = other.track(j)[first - other.first_frames[j] :][: end - first]
                pairs.append((float(np.median(np.hypot(*(one - two)[:, :2].T))), one, two))
        apart, one, two = min(pairs, key=lambda pair: pair[0])
        assert apart < 1.0
        states.append(one)
        other_states.append(two)
    return np.concatenate(states).astype(float), np.concatenate(other_states).astype(float)


@pytest.mark.parametrize("name", SAME_RECORDINGS)
def test_states_agree_with_smoothed_recordings(
    published: Recordings, smoothed: Recordings, name: str
) -> None:
    """Positions to centimetres, speeds and headings of moving vehicles to their noise."""
    recording = published[published.names.index(name)]
    other = smoothed[smoothed.names.index(SAME_RECORDINGS[name])]
    assert recording.frame_rate_hz == other.frame_rate_hz == 10
    assert recording.speed_limit_mps == pytest.approx(other.speed_limit_mps)
    np.testing.assert_allclose(
        recording.road_map.lanes.points, other.road_map.lanes.points, atol=1e-3
    )
    one, two = matching_states(recording, other)
    apart_m = np.hypot(*(one - two)[:, :2].T)
    apart_mps = np.abs(np.abs(one[:, 3]) - np.abs(two[:, 3]))
    moves = np.abs(one[:, 3]) > 1
    apart_deg = np.degrees(np.abs(wrap_angle(one[moves, 2] - two[moves, 2])))
    assert (np.percentile(apart_m, [50, 90, 99]) < [0.01, 0.08, 0.3]).all()
    assert (np.percentile(apart_mps, [50, 90]) < [0.02, 0.5]).all()
    assert (np.percentile(apart_deg, [50, 90]) < [0.6, 5.0]).all()


def test_inferred_actions_lead_along_the_tracks(published: Recordings) -> None:
    """After 6 s, 90 % of the moving targets have drifted by less than 0.2 m.

    In the inD layout 90 % drift by less than 4.3 m.
    """
    metres, moves = [], []
    for recording in published:
        index = find_snippets(recording, dt_s=0.2, history=15, horizon_ticks=30, interval_ticks=3)
        apart, moving = drift_m(recording, *index, dt_s=0.2, horizon=30)
        metres.append(apart)
        moves.append(moving)
    moving_m = np.concatenate(metres)[np.concatenate(moves)]
    assert len(moving_m) > 200
    assert np.percentile(moving_m, 90) < 0.2


def test_jumps_are_repaired(published: Recordings) -> None:
    """Tracker jumps of k733 are reported; no vehicle is reversed, though velocities are scaled."""
    repairs = " ".join(published[published.names.index("k733_2020-09-15/000")].repairs)
    assert "jumps of over 1.5 m in tracks, split there: 34 after 28000 ms" in repairs
    assert "point backwards" not in repairs
    for recording in published:
        assert (recording.states[:, 3] > -1.0).all()
        assert (np.abs(recording.states[:, 3]) < 30).all()


def test_the_environment_passes_gymnasiums_checker(published: Recordings) -> None:
    env = gym.make("asp_env/Replay-v0", data=published.source)
    check_env(env.unwrapped, skip_render_check=True)
    env.close()
