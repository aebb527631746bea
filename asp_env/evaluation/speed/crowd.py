"""As many vehicles at once as asked for: the traffic of a recording laid over itself."""

import dataclasses

import numpy as np

from asp_env.data.recording import Recording
from asp_env.data.scenario import Scenario
from asp_env.evaluation.unseen import nothing_left

MIN_TRACK_S = 4.0
"""Shorter tracks would make a crowd that comes and goes."""


def crowd(recording: Recording, *, agents: int, duration_s: float) -> Recording:
    """A recording in which `agents` vehicles drive at every moment.

    Each follows a track of the given recording, on the same map, and when that ends another one
    takes its place. They do not heed each other: this is for measuring speeds, not driving.

    Raises:
        AspEnvError: the recording has no vehicle of 4 s.
    """
    frames = round(duration_s * recording.frame_rate_hz)
    lengths = recording.last_frames - recording.first_frames + 1
    enough = lengths >= MIN_TRACK_S * recording.frame_rate_hz
    pool = np.flatnonzero(recording.predicted & enough)
    if not len(pool):
        raise nothing_left("vehicle seen for 4 s")
    tracks, first_frames, taken = [], [], []
    number = 0
    for _ in range(agents):
        frame = 0
        while frame < frames:
            track = int(pool[number % len(pool)])
            number += 1
            states = recording.track(track)[: frames - frame]
            tracks.append(states)
            first_frames.append(frame)
            taken.append(track)
            frame += len(states)
    return dataclasses.replace(
        recording,
        num_frames=frames,
        track_ids=np.arange(len(tracks)).astype(recording.track_ids.dtype),
        classes=recording.classes[taken],
        sizes=recording.sizes[taken],
        first_frames=np.array(first_frames, dtype=recording.first_frames.dtype),
        starts=np.concatenate([[0], np.cumsum([len(each) for each in tracks])]),
        states=np.concatenate(tracks),
        background=None,
    )


def crowd_scenarios(
    recording: Recording, *, count: int, start_tick: int, length: int, stride: int
) -> list[Scenario]:
    """Scenarios of a crowd, each vehicle that lasts long enough being the ego in turn."""
    last = (start_tick + length) * stride
    egos = np.flatnonzero((recording.first_frames == 0) & (recording.last_frames >= last))
    if not len(egos):
        raise nothing_left(f"vehicle seen for {start_tick + length} ticks")
    return [
        Scenario(
            source="crowd",
            recording=0,
            recording_name=recording.name,
            start_tick=start_tick,
            length=length,
            ego_id=int(recording.track_ids[egos[i % len(egos)]]),
        )
        for i in range(count)
    ]
