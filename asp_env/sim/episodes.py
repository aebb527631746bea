"""The arrays of episodes that run side by side."""

import dataclasses
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int


@dataclass(slots=True, kw_only=True)
class Episodes:
    """The arrays of B episodes with A slots over K = history + 1 + longest episode ticks.

    Slots are sorted ego first, then by first appearance, then id. Time is the second axis, so
    that one tick of an episode lies together in memory.
    """

    states: Float[np.ndarray, "b k a 4"]
    """What happens here: the recorded past, then what the steps make of it."""
    valid: Bool[np.ndarray, "b k a"]
    actions: Float[np.ndarray, "b k a 2"]
    """The action inferred between each tick and the next, zero unless both are valid."""
    inferred: Int[np.ndarray, " b"]
    """How many ticks of `actions` are known; they are inferred when a scene shows them."""
    log_states: Float[np.ndarray, "b k a 4"]
    """What the recording holds."""
    log_valid: Bool[np.ndarray, "b k a"]
    gone: Bool[np.ndarray, "b a"]
    """Agents that have left for good."""
    sizes: Float[np.ndarray, "b a 2"]
    classes: Int[np.ndarray, "b a"]
    ids: Int[np.ndarray, "b a"]
    parked: Bool[np.ndarray, "b a"]
    tracks: Int[np.ndarray, "b a"]
    """Index of each agent's track in its recording."""
    route: Float[np.ndarray, "b p 2"]
    route_valid: Bool[np.ndarray, "b p"]
    log_off_road_m: Float[np.ndarray, "b p"]
    """How far off the road the logged ego itself is near each point of its route."""
    on_route: Float[np.ndarray, "b 3"]
    """The ego's arc length m, offset to the left m, and the route's heading rad there."""
    contacts: Int[np.ndarray, "b a"]
    """`Contact` of the ego with each agent; one that lasts keeps the class of its first tick."""
    own_trailer: Bool[np.ndarray, "b a"]
    """Trailers that touch the ego at the first tick: its own, with which it has no contact."""
    goal_m: Float[np.ndarray, " b"]
    recording: Int[np.ndarray, " b"]
    start_tick: Int[np.ndarray, " b"]
    elapsed: Int[np.ndarray, " b"]
    length: Int[np.ndarray, " b"]

    def copy(self) -> "Episodes":
        """A deep copy."""
        return Episodes(**{name: getattr(self, name).copy() for name in _NAMES})

    def clear(self, row: int) -> None:
        """Makes one episode all padding."""
        for name in _NAMES:
            getattr(self, name)[row] = _FILL.get(name, 0)

    def with_room(self, *, ticks: int, agents: int, points: int) -> "Episodes":
        """These episodes, or a larger copy where the given sizes ask for more."""
        have = self.valid.shape[1], self.valid.shape[2], self.route.shape[1]
        need = max(have[0], ticks), max(have[1], agents), max(have[2], points)
        if need == have:
            return self
        larger = no_episodes(len(self.length), ticks=need[0], agents=need[1], points=need[2])
        for name in _NAMES:
            value = getattr(self, name)
            getattr(larger, name)[tuple(map(slice, value.shape))] = value
        return larger


_NAMES = tuple(field.name for field in dataclasses.fields(Episodes))
_FILL = {"ids": -1, "tracks": -1}


def no_episodes(num_episodes: int, *, ticks: int, agents: int, points: int) -> Episodes:
    """Room for episodes that have not begun."""
    b, k, a, p = num_episodes, ticks, agents, points
    return Episodes(
        states=np.zeros((b, k, a, 4), dtype=np.float32),
        valid=np.zeros((b, k, a), dtype=bool),
        actions=np.zeros((b, k, a, 2), dtype=np.float32),
        inferred=np.zeros(b, dtype=np.int64),
        log_states=np.zeros((b, k, a, 4), dtype=np.float32),
        log_valid=np.zeros((b, k, a), dtype=bool),
        gone=np.zeros((b, a), dtype=bool),
        sizes=np.zeros((b, a, 2), dtype=np.float32),
        classes=np.zeros((b, a), dtype=np.int32),
        ids=np.full((b, a), -1, dtype=np.int64),
        parked=np.zeros((b, a), dtype=bool),
        tracks=np.full((b, a), -1, dtype=np.int64),
        route=np.zeros((b, p, 2), dtype=np.float32),
        route_valid=np.zeros((b, p), dtype=bool),
        log_off_road_m=np.zeros((b, p), dtype=np.float32),
        on_route=np.zeros((b, 3)),
        contacts=np.zeros((b, a), dtype=np.int8),
        own_trailer=np.zeros((b, a), dtype=bool),
        goal_m=np.zeros(b),
        recording=np.zeros(b, dtype=np.int64),
        start_tick=np.zeros(b, dtype=np.int64),
        elapsed=np.zeros(b, dtype=np.int64),
        length=np.zeros(b, dtype=np.int64),
    )
