"""Histories with recorded accelerations."""

import dataclasses
import pickle
from pathlib import Path

import numpy as np
import pytest

from asp_env import open_data
from asp_env.data import gather_scene, histories, index_snippets
from asp_env.data.classes import AgentClass
from asp_env.data.histories import AccelerationHistories
from asp_env.errors import DataError
from tests.builders import Drive, make_recording
from tests.data.levelx_files import write_folder, write_map, write_recording

CAR = Drive(kind=AgentClass.CAR, start=(0.0, 0.0, 0.0, 8.0))


def test_the_mean_over_a_tick_by_hand():
    """At 10 Hz, a_k = k: from frame 2 j to 2 j + 2 the trapezoids' mean is 2 j + 1.

    The steering of the straight track is 0 and stays inferred, and so do other recordings' actions.
    """
    recording = make_recording(frame_rate_hz=10.0, duration_s=12.0, drives=(CAR,))
    recording = dataclasses.replace(
        recording, accelerations=np.arange(len(recording.states), dtype=np.float32)
    )
    index = index_snippets([recording], dt_s=0.2, horizon_s=3.0)
    scene = gather_scene(histories([recording], "accelerations"), index)
    now = index.tick[:, None]
    expected = 2 * (now - 15 + np.arange(15)) + 1
    np.testing.assert_allclose(scene.actions[:, 0, :, 0], expected)
    np.testing.assert_array_equal(scene.actions[:, 0, :, 1], 0)
    inferred = gather_scene(histories([recording], "recorded"), index)
    np.testing.assert_allclose(inferred.actions, 0, atol=1e-4)


def test_an_absent_agent_has_no_acceleration():
    """A track that begins at 2 s (tick 10) has zeros before."""
    late = dataclasses.replace(CAR, start=(0.0, 4.0, 0.0, 8.0), appears_s=2.0)
    recording = make_recording(frame_rate_hz=10.0, duration_s=12.0, drives=(CAR, late))
    ones = np.ones(len(recording.states), dtype=np.float32)
    recording = dataclasses.replace(recording, accelerations=ones)
    index = index_snippets([recording], dt_s=0.2, horizon_s=3.0)
    scene = gather_scene(histories([recording], "accelerations"), index.select(index.tick == 15))
    assert scene.actions[0, :, :, 0].tolist() == [[1.0] * 15, [0.0] * 10 + [1.0] * 5]


def test_accelerations_of_files(tmp_path: Path):
    """The columns' values along the motion: v_y a_y / |v| at every frame, for all road users.

    Read again, they come from the cache.
    """
    write_folder(tmp_path)
    for recording in (open_data(tmp_path)[0], open_data(tmp_path)[0]):
        assert recording.accelerations is not None
        time = (np.arange(1, 250)) / 25.0  # the second car begins at frame 1
        v_x, v_y = 5.0, 0.4 * np.cos(0.4 * time)
        expected = v_y * -0.16 * np.sin(0.4 * time) / np.hypot(v_x, v_y)
        found = recording.accelerations[recording.starts[1] : recording.starts[2]]
        np.testing.assert_allclose(found, expected, atol=2e-5)
        assert (recording.start_hour, recording.weekday) == (8.0, "Mon")
    index = index_snippets(open_data(tmp_path), dt_s=0.2, horizon_s=3.0)
    recorded, inferred = (
        gather_scene(histories(open_data(tmp_path), kind), index)
        for kind in ("accelerations", "recorded")
    )
    np.testing.assert_array_equal(recorded.actions[..., 1], inferred.actions[..., 1])
    np.testing.assert_allclose(recorded.actions, inferred.actions, atol=2e-3)
    assert (recorded.actions[..., 0] != inferred.actions[..., 0]).any()


def test_a_vehicle_that_backs_up(tmp_path: Path):
    """At -2 m/s along x it brakes by 1 m/s²: the speed rises, so the acceleration is +1."""
    data = write_recording(tmp_path, classes=("car",))
    write_map(tmp_path)
    path = data / "00_tracks.csv"
    rows = np.genfromtxt(path, delimiter=",", names=True, dtype=None, encoding="utf-8")
    rows["xVelocity"], rows["yVelocity"], rows["heading"] = -2.0, 0.0, 0.0
    rows["xAcceleration"], rows["yAcceleration"] = 1.0, 0.0
    rows["xCenter"], rows["yCenter"] = 60.0 - 2.0 * rows["frame"] / 25.0, -21.75
    lines = [",".join(rows.dtype.names or ()), *(",".join(map(str, row)) for row in rows.tolist())]
    path.write_text("\n".join(lines) + "\n")
    recording = open_data(tmp_path)[0]
    assert recording.accelerations is not None
    np.testing.assert_allclose(recording.states[:, 3], -2.0)
    np.testing.assert_allclose(recording.accelerations, 1.0, atol=1e-6)


@pytest.mark.parametrize(
    ("columns", "known"),
    [
        (("xAcceleration", "yAcceleration"), True),  # without both: lonAcceleration
        (("lonAcceleration",), True),
        (("xAcceleration", "yAcceleration", "lonAcceleration"), False),
        (("xAcceleration", "lonAcceleration"), False),
    ],
)
def test_files_without_some_columns(tmp_path: Path, columns: tuple[str, ...], known: bool):
    write_folder(tmp_path)
    path = tmp_path / "data" / "00_tracks.csv"
    lines = [line.split(",") for line in path.read_text().splitlines()]
    keep = [i for i, name in enumerate(lines[0]) if name not in columns]
    path.write_text("\n".join(",".join(line[i] for i in keep) for line in lines) + "\n")
    recordings = open_data(tmp_path)
    assert (recordings[0].accelerations is not None) == known
    index = index_snippets(recordings, dt_s=0.2, horizon_s=3.0)
    sequence = histories(recordings, "accelerations")
    if known:
        assert np.isfinite(gather_scene(sequence, index).actions).all()
    else:
        with pytest.raises(DataError, match="recording 00: its files hold no accelerations"):
            _ = sequence[0]


def test_the_sequence(tmp_path: Path):
    """It is as long as the recordings, can be sliced, and survives a copy to another process."""
    write_folder(tmp_path, recordings=3)
    sequence = histories(open_data(tmp_path), "accelerations")
    assert isinstance(sequence, AccelerationHistories)
    assert [each.name for each in sequence] == ["00", "01", "02"]
    assert [each.name for each in sequence[1:]] == ["01", "02"]
    copy = pickle.loads(pickle.dumps(sequence))
    assert copy[2].shows_accelerations
    assert not open_data(tmp_path)[2].shows_accelerations
