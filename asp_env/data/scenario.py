"""Where, when and who: the table of episodes that can be driven."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool

from asp_env.data.clock import frames_per_tick
from asp_env.data.geometry import path_length
from asp_env.data.recording import Recording
from asp_env.dynamics import wrap_angle

MAX_LENGTH_S = 15.0
MIN_LENGTH_S = 4.0
MIN_DISTANCE_M = 10.0
TURN_RAD = np.pi / 6
STANDING_MPS = 0.5


@dataclass(frozen=True, slots=True, kw_only=True)
class Scenario:
    """One episode: an ego in a stretch of a recording."""

    source: str
    """DATA as the user named it."""
    recording: int
    """Index of the recording in its source."""
    recording_name: str
    start_tick: int
    """The tick of the first observation; its history lies before it."""
    length: int
    """How many steps the recording provides after `start_tick`."""
    ego_id: int
    seed: int = 0
    """Seeds the generator of this episode, for drivers that draw."""
    tags: tuple[str, ...] = ()

    @property
    def name(self) -> str:
        """A readable name, unique within the source, which may be a file's."""
        place = self.recording_name.replace("/", "_")
        return f"{place}-{self.ego_id}-{self.start_tick}"


@dataclass(frozen=True, slots=True, kw_only=True)
class ScenarioSet:
    """Scenarios that can be counted, indexed and filtered by tag."""

    scenarios: tuple[Scenario, ...]

    def __len__(self) -> int:
        """How many there are."""
        return len(self.scenarios)

    def __getitem__(self, index: int) -> Scenario:
        """One of them."""
        return self.scenarios[index]

    def __iter__(self) -> Iterator[Scenario]:
        """All of them in order."""
        return iter(self.scenarios)

    def tagged(self, tag: str) -> "ScenarioSet":
        """Those that carry a tag."""
        return ScenarioSet(scenarios=tuple(s for s in self.scenarios if tag in s.tags))


def find_scenarios(
    recordings: Sequence[Recording],
    *,
    source: str,
    dt_s: float,
    history: int,
    allowed: Sequence[Bool[np.ndarray, " _"]] | None = None,
) -> ScenarioSet:
    """Every stretch of a vehicle's track that is worth driving.

    A track of a predicted class is cut, from the first tick with `history` ticks behind it, into
    windows of at most 15 s without overlap; those of at least 4 s in which the vehicle covers at
    least 10 m are kept. Tags: `left`, `right` or `straight` (30° of total turn), and
    `standing-start`. With `allowed`, scenarios and their histories keep to the ticks that are so
    marked in each recording.
    """
    found: list[Scenario] = []
    for number, recording in enumerate(recordings):
        stride = frames_per_tick(recording.frame_rate_hz, dt_s)
        ticks_allowed = None if allowed is None else allowed[number]
        for track in np.flatnonzero(recording.predicted):
            first = -(-int(recording.first_frames[track]) // stride)
            last = int(recording.last_frames[track]) // stride
            for start, length in _windows(first, last, history, dt_s, ticks_allowed):
                rows = (start + np.arange(length + 1)) * stride - recording.first_frames[track]
                states = recording.track(int(track))[rows]
                if path_length(states[:, :2]) < MIN_DISTANCE_M:
                    continue
                found.append(
                    Scenario(
                        source=source,
                        recording=number,
                        recording_name=recording.name,
                        start_tick=start,
                        length=length,
                        ego_id=int(recording.track_ids[track]),
                        seed=len(found),
                        tags=_tags(states),
                    )
                )
    return ScenarioSet(scenarios=tuple(found))


def _windows(
    first: int, last: int, history: int, dt_s: float, allowed: Bool[np.ndarray, " ticks"] | None
) -> Iterator[tuple[int, int]]:
    """(start, length) of the windows in every allowed stretch of the ticks first to last."""
    longest, shortest = int(MAX_LENGTH_S / dt_s + 1e-6), math.ceil(MIN_LENGTH_S / dt_s - 1e-6)
    marked = np.ones(last - first + 1, dtype=bool) if allowed is None else allowed[first : last + 1]
    edges = np.flatnonzero(np.diff(marked, prepend=False, append=False)) + first
    for begin, end in edges.reshape(-1, 2).tolist():
        for start in range(begin + history, end - shortest, longest):
            yield start, min(longest, end - 1 - start)


def _tags(states: np.ndarray) -> tuple[str, ...]:
    turned = float(wrap_angle(np.diff(states[:, 2])).sum())
    turn = "left" if turned > TURN_RAD else "right" if turned < -TURN_RAD else "straight"
    return (turn, "standing-start") if abs(states[0, 3]) < STANDING_MPS else (turn,)
