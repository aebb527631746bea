"""Several agents driven in one episode: who they are, and how each sees all others drive.

MERGED: Recorded traffic in which the vehicles are agents, for PettingZoo.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.utils import seeding
from jaxtyping import Bool, Float, Int
from pettingzoo import ParallelEnv

from asp_env.data.classes import PREDICTED, AgentClass
from asp_env.data.recording import Recording, frames_per_tick
from asp_env.data.scenarios.scenario import Scenario, ScenarioSet
from asp_env.data.scene import EGO, Scene
from asp_env.dynamics import denormalize_actions
from asp_env.envs.episodes import OPTIONS, ReplayEpisodes, StepResult, as_actions
from asp_env.errors import AspEnvError, unknown_name
from asp_env.render.frames import draw_frame
from asp_env.sim.reward import MIN_GOAL_M
from asp_env.sim.traffic import Control, Driver
from asp_env.sim.traffic.driver import controllable_agents
from asp_env.sim.world import World


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class AgentSelection:
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


class JointPolicyDriver:
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
        world: World,
        reset_mask: Bool[np.ndarray, " b"],
        agent_mask: Bool[np.ndarray, "b a"] | None = None,
    ) -> None:
        """Learns who is who in the rows at `where`; the others take no part."""
        tracks = world.episodes.tracks
        here = np.where(reset_mask[:, None] & (tracks >= 0), tracks, -1)
        self._agents = _positions(here, here[:, EGO])
        self._slots = _positions(here, here[0])
        self.actions = np.zeros((len(tracks), 2), dtype=np.float32)
        others = controllable_agents(world) if agent_mask is None else agent_mask
        traffic = others & (self._agents < 0)
        traffic[1:] = False
        self._traffic.reset(world, reset_mask, traffic)

    def control(self, world: World) -> Control:
        """What everybody but the ego does in each row."""
        said = self._traffic.control(world)
        known, agent = self._slots >= 0, self._agents >= 0
        return Control(
            actions=np.where(
                agent[..., None], self.actions[self._agents], said.actions[0, self._slots]
            ),
            controlled=agent | (said.controlled[0, self._slots] & known),
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


Observations = dict[str, dict[str, np.ndarray]]


class ParallelReplayEnv(ParallelEnv[str, dict[str, np.ndarray], Any]):
    """Drive many vehicles of a drone recording at once; the rest is replayed or reacts.

    Each agent has the observations, actions, rewards and infos that `ReplayEnv` has for its ego,
    from its own point of view.

    ## Agents
    `vehicle_0` is the vehicle of the scenario. The others are those that were there for the whole
    history when it begins and get on by at least 1 m until it, or their own track, ends. Whoever
    stands all the while or comes later is traffic. The list `agents` therefore only shrinks.
    `possible_agents` are those of the episode; before the first `reset`, as many as any scenario
    can have.

    ## End of an agent
    As in `ReplayEnv`: terminated by `COLLISION` (one that it answers for), `OFF_ROAD` or `GOAL`,
    truncated by `OUT_OF_DATA` when its own track ends. It vanishes behind its last observation,
    a crashed one too: replayed traffic would drive through a wreck. Whoever was hit drives on.

    ## Arguments
    Those of `ReplayEnv`, and `classes` (names such as `car`), `ids` (track ids, of whatever
    recording) and `max_agents` (those that start nearest to `vehicle_0`), which say who may be an
    agent. Scenarios are those whose own vehicle may be one.

    ## Options of `reset`
    Those of `ReplayEnv`; others are passed over, since PettingZoo's own test gives one.
    """

    def __init__(
        self,
        data: str = "sample:intersection",
        *,
        classes: Sequence[str] | None = None,
        ids: Sequence[int] | None = None,
        max_agents: int | None = None,
        render_mode: str | None = None,
        **options: Any,
    ) -> None:
        """See the class documentation for the arguments.

        Raises:
            AspEnvError: an argument is not understood, or no scenario is left.
        """
        if render_mode not in (None, "rgb_array"):
            raise AspEnvError(f"render mode {render_mode!r}: expected rgb_array or None")
        if max_agents is not None and max_agents < 1:
            raise AspEnvError(f"max_agents {max_agents}: expected at least 1")
        self.metadata = {"name": "asp_env/ParallelReplay-v0", "render_modes": ["rgb_array"]}
        self.render_mode = render_mode
        self._episodes = ReplayEpisodes(data, options, 1)
        self.metadata["render_fps"] = 1 / self._episodes.simulation.world.dt_s
        self.recordings = self._episodes.recordings
        self._wanted = tuple(
            AgentSelection(classes=classes, ids=ids).among(r) for r in self.recordings
        )
        self.scenarios, most = self._scenarios(data)
        self._most = most if max_agents is None else min(most, max_agents)
        self._episodes.restrict(self.scenarios, self._most)
        simulation = self._episodes.simulation
        simulation.driver = JointPolicyDriver(simulation.driver)
        self.possible_agents = [f"vehicle_{number}" for number in range(self._most)]
        self.agents: list[str] = []
        self._numbers = {name: number for number, name in enumerate(self.possible_agents)}
        space: spaces.Space[Any] = self._episodes.observer.space
        self.observation_spaces: dict[str, Any] = dict.fromkeys(self._numbers, space)
        self.action_spaces: dict[str, spaces.Space[Any]] = {
            name: spaces.Box(-1.0, 1.0, (2,), dtype=np.float32) for name in self._numbers
        }
        self.state_space = spaces.Box(-np.inf, np.inf, (self._most, 7), dtype=np.float32)
        self._np_random: np.random.Generator | None = None

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observations, dict[str, dict[str, Any]]]:
        """Starts the scenario that the options ask for, or one drawn with the seed.

        Raises:
            AspEnvError: what an option asks for does not exist.
        """
        if seed is not None or self._np_random is None:
            self._np_random, _ = seeding.np_random(seed)
        known = {name: value for name, value in (options or {}).items() if name in OPTIONS}
        scenario, rng = self._episodes.draw(self._np_random, known)
        world = self._episodes.simulation.world
        views = viewpoints(
            self.recordings[scenario.recording],
            self._wanted[scenario.recording],
            scenario,
            dt_s=world.dt_s,
            history=world.history,
            most=self._most,
        )
        reset_mask = np.arange(self._most) < len(views)
        padding = [scenario] * (self._most - len(views))
        self._episodes.begin([*views, *padding], [rng] * self._most, reset_mask)
        self.possible_agents = list(self._numbers)[: len(views)]
        self.agents = self.possible_agents.copy()
        return self._observe(), self._infos()

    def step(
        self, actions: Mapping[str, Any]
    ) -> tuple[
        Observations,
        dict[str, float],
        dict[str, bool],
        dict[str, bool],
        dict[str, dict[str, Any]],
    ]:
        """One tick; the actions of all `agents`, moved to the nearest ones in the space.

        Raises:
            gymnasium.error.ResetNeeded: the episode is over, or none has begun.
            AspEnvError: an agent's action is missing, has another shape or is not finite.
        """
        if not self.agents:
            raise gymnasium.error.ResetNeeded("no agent is left: call reset before step")
        given = np.zeros((self._most, 2), dtype=np.float32)
        for name in self.agents:
            if name not in actions:
                raise AspEnvError(f"no action for {name}: expected one for each of env.agents")
            given[self._numbers[name]] = as_actions(actions[name], (2,))
        driver = self._episodes.simulation.driver
        assert isinstance(driver, JointPolicyDriver)
        driver.actions = denormalize_actions(given)
        outcome = self._episodes.step(given)
        over = outcome.terminated | outcome.truncated
        returned = (
            self._observe(),
            self._told(outcome.reward),
            self._told(outcome.terminated),
            self._told(outcome.truncated),
            self._infos(outcome),
        )
        self._episodes.simulation.world.episodes.departed |= driver.slots_of(over)
        self.agents = [name for name in self.agents if not over[self._numbers[name]]]
        return returned

    def scene(self, agent: str) -> Scene:
        """All that an agent may know now, for a predictor in its loop; it is slot 0.

        Raises:
            gymnasium.error.ResetNeeded: no episode has begun.
            AspEnvError: there is no such agent.
        """
        if agent not in self.possible_agents:
            raise unknown_name("agent", agent, self.possible_agents)
        world = self._episodes.simulation.world
        if world.scenarios[0] is None:
            raise gymnasium.error.ResetNeeded("no episode has begun: call reset first")
        return world.scene().situation(self._numbers[agent])

    def state(self) -> Float[np.ndarray, "agents 7"]:
        """Of every possible agent x m, y m, heading rad, speed m/s, length m, width m, 1.

        Zeros for those that are not there. Positions are in the recording's frame.
        """
        world = self._episodes.simulation.world
        state = np.zeros(self.state_space.shape or (), dtype=np.float32)
        rows = [self._numbers[name] for name in self.agents]
        state[rows, :4] = world.ego_states()[rows]
        state[rows, 4:6] = world.episodes.sizes[rows, 0]
        state[rows, 6] = 1.0
        return state

    def observation_space(self, agent: str) -> spaces.Space[Any]:
        """The same for all agents."""
        return self.observation_spaces[agent]

    def action_space(self, agent: str) -> spaces.Space[Any]:
        """The agent's own, with its own seed."""
        return self.action_spaces[agent]

    def render(self) -> Any:
        """An RGB picture uint8 (H, W, 3) of the whole place in mode `rgb_array`, else None."""
        if self.render_mode is None:
            return None
        scene = self.scene((self.agents or self.possible_agents)[0])
        recording = self._episodes.simulation.world.episodes.recording[0]
        background = self.recordings[int(recording)].background
        return draw_frame(scene, extent_m=None, background=background)

    def close(self) -> None:
        """Nothing is held open."""

    def _scenarios(self, data: str) -> tuple[ScenarioSet, int]:
        """The scenarios whose own vehicle may be an agent, and the most agents of one of them."""
        world, found = self._episodes.simulation.world, self._episodes.scenarios
        kept, most = np.zeros(len(found), dtype=bool), 0
        for row, scenario in enumerate(found):
            recording = self.recordings[scenario.recording]
            wanted = self._wanted[scenario.recording]
            if wanted[recording.track_ids == scenario.ego_id].any():
                there = candidates(recording, scenario, dt_s=world.dt_s, history=world.history)
                most = max(most, int((there & wanted).sum()))
                kept[row] = True
        if not most:
            raise AspEnvError(f"{data}: no scenario's vehicle is of the given classes and ids")
        return found.select(kept), most

    def _observe(self) -> Observations:
        rows = np.array([self._numbers[name] for name in self.agents])
        observed = self._episodes.observe(rows)
        return {
            name: {part: value[row] for part, value in observed.items()}
            for row, name in enumerate(self.agents)
        }

    def _infos(self, outcome: StepResult | None = None) -> dict[str, dict[str, Any]]:
        columns = {name: self._told(value) for name, value in self._episodes.info().items()}
        if outcome is not None:
            terms = {name: self._told(value) for name, value in outcome.terms.items()}
            columns["reward_terms"] = {
                agent: {name: value[agent] for name, value in terms.items()}
                for agent in self.agents
            }
            columns["ending"] = self._told(outcome.ending)
        return {
            agent: {name: value[agent] for name, value in columns.items()} for agent in self.agents
        }

    def _told(self, values: np.ndarray) -> dict[str, Any]:
        """One plain value for each agent that is there."""
        plain = values.tolist()
        return {name: plain[self._numbers[name]] for name in self.agents}
