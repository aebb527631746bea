"""Tables of recordings and maps against the drives from which they were made."""

import dataclasses

import numpy as np
import pytest

from asp_env.data.classes import AgentClass
from asp_env.data.road_map import Ragged
from asp_env.errors import DataError
from tests.builders import Drive, make_map, make_recording

MOVING = (0.0, 0.0, 0.0, 5.0)
STANDING = (50.0, 0.0, 0.0, 0.0)


def test_frames_of_a_recording() -> None:
    """20 s at 25 Hz are 501 frames; the seventh track spans frames 100 to 350."""
    recording = make_recording()
    assert len(recording) == 10
    assert recording.num_frames == 501
    assert recording.duration_s == pytest.approx(501 / 25)
    assert (recording.first_frames[6], recording.last_frames[6]) == (100, 350)
    assert recording.track(6).shape == (251, 4)
    assert recording.track(6)[0, 1] == -80


def test_frame_index_lists_the_tracks_of_each_frame() -> None:
    recording = make_recording(duration_s=6.0)
    starts, tracks = recording.frame_index
    assert len(starts) == recording.num_frames + 1
    for frame in range(recording.num_frames):
        spans = (recording.first_frames <= frame) & (recording.last_frames >= frame)
        np.testing.assert_array_equal(
            tracks[starts[frame] : starts[frame + 1]], np.flatnonzero(spans)
        )


@pytest.mark.parametrize(
    ("first", "last", "ids"),
    [(0, 0, [1, 3]), (10, 10, [1, 3, 2]), (30, 40, [1, 3]), (26, 40, [1, 3]), (25, 40, [1, 3, 2])],
)
def test_tracks_between(first: int, last: int, ids: list[int]) -> None:
    """Sorted by first frame, then id; track 2 is present from frame 10 to frame 25."""
    late = Drive(kind=AgentClass.CAR, start=MOVING, appears_s=1.0, leaves_s=2.5)
    always = Drive(kind=AgentClass.CAR, start=MOVING)
    recording = make_recording(drives=(always, late, always), duration_s=5.0, frame_rate_hz=10.0)
    assert recording.track_ids[recording.tracks_between(first, last)].tolist() == ids


def test_parked() -> None:
    """Present from the first to the last frame, and always within 1 m of the first position."""
    creep = Drive(kind=AgentClass.CAR, start=STANDING, phases=((1.0, 0.45, 0.0), (1.0, -0.45, 0.0)))
    drives = (
        Drive(kind=AgentClass.CAR, start=STANDING),
        creep,  # 0.45 m
        dataclasses.replace(creep, phases=((2.0, 0.45, 0.0), (2.0, -0.45, 0.0))),  # 1.8 m
        Drive(kind=AgentClass.CAR, start=STANDING, appears_s=0.2),
        Drive(kind=AgentClass.CAR, start=STANDING, leaves_s=9.8),
        Drive(kind=AgentClass.BICYCLE, start=STANDING),
        Drive(kind=AgentClass.CAR, start=MOVING),
    )
    recording = make_recording(drives=drives, duration_s=10.0)
    assert recording.parked.tolist() == [True, True, False, False, False, True, False]
    assert recording.predicted.tolist() == [False, False, True, True, True, False, True]


def test_vehicle_that_returns_to_its_start_is_not_parked() -> None:
    circle = Drive(kind=AgentClass.CAR, start=MOVING, phases=((60.0, 0.0, 0.3),))
    assert not make_recording(drives=(circle,), duration_s=20.0).parked.any()


def test_recording_without_tracks() -> None:
    recording = dataclasses.replace(
        make_recording(),
        track_ids=np.zeros(0, dtype=np.int64),
        classes=np.zeros(0, dtype=np.int32),
        sizes=np.zeros((0, 2), dtype=np.float32),
        first_frames=np.zeros(0, dtype=np.int64),
        starts=np.zeros(1, dtype=np.int64),
        states=np.zeros((0, 4), dtype=np.float32),
    )
    assert len(recording) == 0
    assert recording.predicted.shape == (0,)
    assert recording.frame_index[0].tolist() == [0] * 502
    assert len(recording.tracks_between(0, 500)) == 0


def test_columns_of_different_lengths_are_rejected() -> None:
    recording = make_recording(name="07")
    with pytest.raises(DataError, match=r"recording 07: .*differ in length"):
        dataclasses.replace(recording, states=recording.states[:-1])


def test_ragged_arrays_return_their_sequences() -> None:
    """By positive and negative index, within the bounds only."""
    sequences = [np.ones((2, 2)), np.zeros((0, 2)), np.full((3, 2), 7.0)]
    packed = Ragged.pack(sequences)
    assert len(packed) == 3
    for number, sequence in enumerate(sequences):
        np.testing.assert_array_equal(packed[number], sequence)
        np.testing.assert_array_equal(packed[number - 3], sequence)
    assert [len(each) for each in packed] == [2, 0, 3]
    for number in (3, -4):
        with pytest.raises(IndexError):
            packed[number]
    assert len(Ragged.pack([])) == 0


def test_map_extent() -> None:
    """The crossing extends 100 m in each direction; an empty map has an extent, too."""
    assert make_map().extent_m == (-100, -100, 100, 100)
    nothing = Ragged.pack([])
    empty = dataclasses.replace(
        make_map(), lines=nothing, drivable=nothing, line_types=np.zeros(0, dtype=np.int64)
    )
    assert empty.extent_m == (0, 0, 1, 1)


def test_map_with_wrong_counts_is_rejected() -> None:
    road_map = make_map()
    with pytest.raises(DataError, match="map crossing: 8 lines but 7 line types"):
        dataclasses.replace(road_map, line_types=road_map.line_types[:-1])
    with pytest.raises(DataError, match="a successor names lane 8 of 8"):
        dataclasses.replace(road_map, successors=np.array([(0, 8)]))
