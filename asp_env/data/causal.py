"""Histories as a tracker would know them: filtered forward only, on positions with noise.

Recorded tracks are smoothed with look-ahead, so a state of them holds about half a second of what
comes next. Here each recorded position and heading gets white noise (0.08 m, 1.5°) and is filtered
again, so that the state at a frame is made of measurements up to that frame alone.
"""

import dataclasses
import hashlib
import warnings
from collections.abc import Iterator, Sequence
from typing import Any, SupportsIndex, overload

import numpy as np
from jaxtyping import Float

from asp_env.data import cache, tracker
from asp_env.data.classes import VULNERABLE
from asp_env.data.recording import Recording
from asp_env.dynamics.bicycle import AXLE_SHARE_OF_LENGTH
from asp_env.errors import DataError

VERSION = 1
"""Raise whenever the filter or its noise gives other states for the same recording."""


class CausalHistories(Sequence[Any]):  # not of Recording: checking its items would filter them
    """Recordings with causal states, each filtered when it is first asked for."""

    def __init__(self, recordings: Sequence[Any]) -> None:
        """Filters nothing yet.

        Args:
            recordings: as they were recorded; opened no earlier than asked for.
        """
        self._recorded = recordings
        self._filtered: dict[int, Recording] = {}

    def __reduce__(self) -> tuple[Any, ...]:
        """A copy in another process filters anew what is not in the cache."""
        return CausalHistories, (self._recorded,)

    def __len__(self) -> int:
        """How many there are."""
        return len(self._recorded)

    @overload
    def __getitem__(self, index: SupportsIndex) -> Recording: ...
    @overload
    def __getitem__(self, index: slice) -> "CausalHistories": ...
    def __getitem__(self, index: SupportsIndex | slice) -> "Recording | CausalHistories":
        """One recording with causal states, or some of them, still unfiltered."""
        if isinstance(index, slice):
            return CausalHistories(self._recorded[index])
        number = range(len(self))[index]
        if number not in self._filtered:
            recording = self._recorded[number]
            self._filtered[number] = dataclasses.replace(recording, states=_kept(recording))
        return self._filtered[number]

    def __iter__(self) -> Iterator[Recording]:
        """Filters one after the other."""
        return (self[index] for index in range(len(self)))


def causal_histories(recordings: Sequence[Any]) -> CausalHistories:
    """The same recordings with `states` as a causal tracker knows them; all else is unchanged.

    Make scenes of these, and snippets, futures and labels of the recorded ones. What was filtered
    is kept in the cache folder, by content, and mapped into memory from then on.
    """
    return CausalHistories(recordings)


def causal_states(recording: Recording) -> Float[np.ndarray, "rows 4"]:
    """The states of all rows, each made of its track's rows up to it.

    The noise is drawn from a generator of each track's own, seeded by the location's and the
    recording's name and the track's id. A track begins with its first measurement; its speed is
    measured there and nowhere else, with an error of 0.1 m/s + 5 %: who comes into view has been
    seen to move.
    """
    states = np.empty(recording.states.shape, dtype=np.float32)
    dt_s = 1.0 / recording.frame_rate_hz
    vulnerable = np.isin(recording.classes, [int(kind) for kind in VULNERABLE])
    for track, track_id in enumerate(recording.track_ids.tolist()):
        rows = slice(int(recording.starts[track]), int(recording.starts[track + 1]))
        source = f"{recording.location}\0{recording.name}\0{track_id}".encode()
        rng = np.random.default_rng(int.from_bytes(hashlib.sha256(source).digest()[:16], "little"))
        measured, speed_mps = _measure(rng, recording.states[rows])
        if vulnerable[track]:
            tracker.follow_vulnerable(measured, speed_mps, dt_s, states[rows])
        else:
            rear_m = AXLE_SHARE_OF_LENGTH * float(recording.sizes[track, 0])
            tracker.follow_vehicle(measured, speed_mps, rear_m, dt_s, states[rows])
    states.flags.writeable = False
    return states


def _measure(
    rng: np.random.Generator, states: Float[np.ndarray, "n 4"]
) -> tuple[Float[np.ndarray, "n 3"], float]:
    """Positions and headings with noise, and the speed at the first frame."""
    first_mps = float(states[0, 3])
    sigma_mps = tracker.SPEED_SIGMA_MPS + tracker.SPEED_SIGMA_SHARE * abs(first_mps)
    speed_mps = first_mps + sigma_mps * float(rng.standard_normal())
    errors = rng.standard_normal((len(states), 3))
    errors *= (tracker.POSITION_SIGMA_M, tracker.POSITION_SIGMA_M, tracker.HEADING_SIGMA_RAD)
    return states[:, :3] + errors, speed_mps


def _kept(recording: Recording) -> Float[np.ndarray, "rows 4"]:
    """The causal states, read-only, from the cache if it has them; otherwise it gets them.

    Where the cache cannot be written to, they are filtered anew each time, and a warning says so.
    """
    content = _digest(recording)
    stamp = [["causal", VERSION, content]]
    try:
        path = cache.cache_folder() / f"causal-{content[:20]}.bin"
    except DataError as error:
        warnings.warn(f"nothing is kept for next time: {error}", stacklevel=2)
        return causal_states(recording)
    if (found := cache.load(path, stamp)) is not None:
        return found[1]["states"]
    states = causal_states(recording)
    try:
        cache.save(path, stamp, {}, {"states": states})
    except OSError as error:
        warnings.warn(f"nothing is kept for next time: {path}: {error.strerror}", stacklevel=2)
    found = cache.load(path, stamp)
    return states if found is None else found[1]["states"]


def _digest(recording: Recording) -> str:
    """A hash of all that the causal states are made of."""
    digest = hashlib.sha256(
        repr((recording.location, recording.name, recording.frame_rate_hz)).encode()
    )
    for column in ("track_ids", "classes", "sizes", "starts", "states"):
        digest.update(np.ascontiguousarray(getattr(recording, column)).data)
    return digest.hexdigest()
