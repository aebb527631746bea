"""Several agents driven in one episode: who they are, and how each sees all others drive."""

import dataclasses
from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Int

from asp_env.data.classes import PREDICTED, AgentClass
from asp_env.data.clock import frames_per_tick
from asp_env.data.recording import Recording
from asp_env.data.scenario import Scenario
from asp_env.errors import AspEnvError, unknown_name
from asp_env.sim.drivers import Control, Driver
from asp_env.sim.drivers.driver import vehicles
from asp_env.sim.reward import MIN_GOAL_M
from asp_env.sim.scenario_world import ScenarioWorld
from asp_env.sim.world import EGO


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class Wanted:
    """Which vehicles shall be agents."""

    classes: Sequence[str] | None = None
    """Names of classes such as `car`; by default all that are predicted."""
    ids: Sequence[int] | None = None
    """Track ids, in whatever recording; by default all."""

    def __post_init__(self) -> None:
        """Refuses what no vehicle is.

        Raises:
            AspEnvError: a class is unknown, or there is none.
        """
        known = sorted(kind.name.lower() for kind in PREDICTED)
        for what, given in (("classes", self.classes), ("ids", self.ids)):
            if given is not None and (isinstance(given, str) or not len(given)):
                raise AspEnvError(f"{what} {given!r}: expected a sequence with at least one entry")
        for name in self.classes or ():
            if name not in known:
                raise unknown_name("class of agents", name, known)

    def among(self, recording: Recording) -> Bool[np.ndarray, " tracks"]:
        """The tracks of a recording that may be agents."""
        chosen = recording.predicted.copy()
        if self.classes is not None:
            kinds = [int(AgentClass[name.upper()]) for name in self.classes]
            chosen &= np.isin(recording.classes, kinds)
        if self.ids is not None:
            chosen &= np.isin(recording.track_ids, np.asarray(self.ids))
        return chosen


def candidates(
    recording: Recording, scenario: Scenario, *, dt_s: float, history: int
) -> Bool[np.ndarray, " tracks"]:
    """Tracks that could drive in a scenario: there for the history before it and a tick after."""
    stride = frames_per_tick(recording.frame_rate_hz, dt_s)
    first, last = (scenario.start_tick - history) * stride, (scenario.start_tick + 1) * stride
    return (recording.first_frames <= first) & (recording.last_frames >= last)


def viewpoints(
    recording: Recording,
    wanted: Bool[np.ndarray, " tracks"],
    scenario: Scenario,
    *,
    dt_s: float,
    history: int,
    most: int,
) -> list[Scenario]:
    """The scenario from the view of each of its agents, that of its own ego first.

    Agents are the ego and the wanted vehicles that could be one: there for the whole history, and
    in the log once 1 m away before the scenario or their track ends. Of more than `most` those that
    start nearest to the ego are taken. They are in the order of slots.
    """
    stride, start = frames_per_tick(recording.frame_rate_hz, dt_s), scenario.start_tick
    chosen = candidates(recording, scenario, dt_s=dt_s, history=history) & wanted
    chosen &= recording.track_ids != scenario.ego_id
    ego = int(np.flatnonzero(recording.track_ids == scenario.ego_id)[0])
    here = recording.track(ego)[start * stride - recording.first_frames[ego], :2]
    found: list[tuple[float, int, int, Scenario]] = []
    for track in np.flatnonzero(chosen).tolist():
        first, last = int(recording.first_frames[track]), int(recording.last_frames[track])
        length = min(scenario.length, last // stride - start)
        way = recording.track(track)[(start + np.arange(length + 1)) * stride - first, :2]
        # not the length of the way, which jitter adds up to while a vehicle stands
        if np.hypot(*(way - way[0]).T).max() >= MIN_GOAL_M:
            number = int(recording.track_ids[track])
            view = dataclasses.replace(scenario, ego_id=number, length=length, tags=())
            found.append((float(np.hypot(*(way[0] - here))), first, number, view))
    nearest = sorted(found, key=lambda each: (each[0], each[2]))[: most - 1]
    return [scenario, *(each[3] for each in sorted(nearest, key=lambda each: each[1:3]))]


class TogetherDriver:
    """Moves all but the ego in rows that show one episode, each to another of its agents.

    Row v has agent v in the slot of the ego. In every row the agents do what is given for them in
    `actions`, and the others what the traffic's driver says in row 0.
    """

    def __init__(self, traffic: Driver) -> None:
        """Agents among a traffic that has this driver."""
        self._traffic = traffic
        self.actions = np.zeros((0, 2), dtype=np.float32)
        """[acceleration m/s², steering rad] of each agent in the coming tick."""
        self._agents = np.zeros((0, 0), dtype=np.int64)
        self._slots = np.zeros((0, 0), dtype=np.int64)

    def reset(
        self,
        world: ScenarioWorld,
        where: Bool[np.ndarray, " b"],
        mine: Bool[np.ndarray, "b a"] | None = None,
    ) -> None:
        """Learns who is who in the rows at `where`; the others take no part."""
        tracks = world.episodes.tracks
        here = np.where(where[:, None] & (tracks >= 0), tracks, -1)
        self._agents = _positions(here, here[:, EGO])
        self._slots = _positions(here, here[0])
        self.actions = np.zeros((len(tracks), 2), dtype=np.float32)
        traffic = (vehicles(world) if mine is None else mine) & (self._agents < 0)
        traffic[1:] = False
        self._traffic.reset(world, where, traffic)

    def control(self, world: ScenarioWorld) -> Control:
        """What everybody but the ego does in each row."""
        said = self._traffic.control(world)
        known, agent = self._slots >= 0, self._agents >= 0
        return Control(
            actions=np.where(
                agent[..., None], self.actions[self._agents], said.actions[0, self._slots]
            ),
            driven=agent | (said.driven[0, self._slots] & known),
            leaving=~agent & said.leaving[0, self._slots] & known,
        )

    def slots_of(self, agents: Bool[np.ndarray, " b"]) -> Bool[np.ndarray, "b a"]:
        """Where in each row some agents are."""
        return (self._agents >= 0) & agents[self._agents]


def _positions(
    tracks: Int[np.ndarray, "b a"], known: Int[np.ndarray, " n"]
) -> Int[np.ndarray, "b a"]:
    """Where each track is among the known ones, else -1; tracks below 0 are nobody."""
    same = (tracks[..., None] == known) & (tracks >= 0)[..., None]
    return np.where(same.any(axis=-1), same.argmax(axis=-1), -1)
