"""Recorded traffic in which many vehicles are agents, as a PettingZoo parallel environment.

An episode of V agents is simulated in V rows of the world. Row v is the scenario from the view of
agent v, which is the ego of that row; `JointPolicyDriver` moves the other agents of the row in the
same way as in their own rows. Each agent thus gets observations, rewards and infos of an ego.
"""

import copy
import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.utils import seeding
from jaxtyping import Bool, Float, Int
from pettingzoo import ParallelEnv

from asp_env.arguments import flag, shown, table, whole_number
from asp_env.data.classes import PREDICTED, AgentClass
from asp_env.data.recording import DEFAULT_DT_S, Recording, frames_per_tick
from asp_env.data.scenarios.scenario import Scenario, ScenarioFilter, ScenarioSet
from asp_env.data.scene import EGO, Scene
from asp_env.envs.episodes import (
    RESET_OPTIONS,
    ReplayEpisodes,
    checked_seed,
    info_of,
    reset_options,
    valid_actions,
)
from asp_env.envs.flat import Flatten, flat_space, flatten_observations
from asp_env.envs.forecasts import ForecastSpec, PredictorSpec, extended_space
from asp_env.envs.options import ReplayOptions, suggest_options
from asp_env.errors import AspEnvError, unknown_name
from asp_env.render.frames import draw_frame
from asp_env.render.live import render_fps
from asp_env.sim.reward import MIN_GOAL_M
from asp_env.sim.traffic import Control, Driver
from asp_env.sim.traffic.assignment import TrafficSpec
from asp_env.sim.traffic.driver import controllable_agents
from asp_env.sim.world import World


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class AgentSelection:
    """The vehicles that may be agents."""

    classes: Sequence[str] | None = None
    """Names of classes such as `car`; by default all predicted classes."""
    ids: Sequence[int] | None = None
    """Track ids, in any recording; by default all."""

    def __post_init__(self) -> None:
        """Checks the selection.

        Raises:
            AspEnvError: a class is unknown, an id is no whole number, or a sequence is empty.
        """
        known = sorted(kind.name.lower() for kind in PREDICTED)
        for field, values in (("classes", self.classes), ("ids", self.ids)):
            if values is None:
                continue
            is_sequence = isinstance(values, Sequence | np.ndarray) and not isinstance(values, str)
            if not is_sequence or not len(values):
                raise AspEnvError(
                    f"{field} {shown(values)}: expected a sequence with at least one entry"
                )
        for name in self.classes or ():
            if name not in known:
                raise unknown_name("class of agents", name, known)
        for number in self.ids if self.ids is not None else ():
            whole_number("id of an agent", number)

    def mask(self, recording: Recording) -> Bool[np.ndarray, " tracks"]:
        """Returns the mask of a recording's tracks that may be agents."""
        selected = recording.predicted.copy()
        if self.classes is not None:
            kinds = [int(AgentClass[name.upper()]) for name in self.classes]
            selected &= np.isin(recording.classes, kinds)
        if self.ids is not None:
            selected &= np.isin(recording.track_ids, np.asarray(self.ids))
        return selected


def present_tracks(
    recording: Recording, scenario: Scenario, *, dt_s: float, history: int
) -> Bool[np.ndarray, " tracks"]:
    """Returns the mask of tracks that last from the start of the history to one tick after now."""
    stride = frames_per_tick(recording.frame_rate_hz, dt_s)
    first, last = (scenario.start_tick - history) * stride, (scenario.start_tick + 1) * stride
    return (recording.first_frames <= first) & (recording.last_frames >= last)


def agent_scenarios(
    recording: Recording,
    selected: Bool[np.ndarray, " tracks"],
    scenario: Scenario,
    *,
    dt_s: float,
    history: int,
    max_agents: int,
) -> list[Scenario]:
    """Returns a scenario from the view of each of its agents.

    Agents are the ego, and the selected vehicles that are present during the whole history and
    move away from their start by at least 1 m in the log. If there are more than `max_agents`,
    those nearest to the ego at the start are taken.

    Args:
        recording: the recording of the scenario.
        selected: mask of the tracks that may be agents.
        scenario: the scenario from the view of its ego.
        dt_s: length of a tick in seconds.
        history: past ticks before the start.
        max_agents: the largest number of agents, at least 1.

    Returns:
        The scenario itself, then those of the other agents in the order of slots.
    """
    stride, start = frames_per_tick(recording.frame_rate_hz, dt_s), scenario.start_tick
    others = present_tracks(recording, scenario, dt_s=dt_s, history=history) & selected
    others &= recording.track_ids != scenario.ego_id
    ego = int(np.flatnonzero(recording.track_ids == scenario.ego_id)[0])
    ego_position = recording.track(ego)[start * stride - recording.first_frames[ego], :2]
    moving: list[tuple[float, int, int, Scenario]] = []
    for track in np.flatnonzero(others).tolist():
        first, last = int(recording.first_frames[track]), int(recording.last_frames[track])
        length = min(scenario.length, last // stride - start)
        path = recording.track(track)[(start + np.arange(length + 1)) * stride - first, :2]
        # The distance from the start: jitter adds up in the path length of a standing vehicle.
        if np.hypot(*(path - path[0]).T).max() >= MIN_GOAL_M:
            track_id = int(recording.track_ids[track])
            view = dataclasses.replace(scenario, ego_id=track_id, length=length, tags=())
            distance_m = float(np.hypot(*(path[0] - ego_position)))
            moving.append((distance_m, first, track_id, view))
    nearest = sorted(moving, key=lambda entry: (entry[0], entry[2]))[: max_agents - 1]
    return [scenario, *(entry[3] for entry in sorted(nearest, key=lambda entry: entry[1:3]))]


class JointPolicyDriver:
    """Moves all agents but the ego in rows that show one episode from the views of its agents.

    Row v has agent v in the slot of the ego. In each row the agents follow `actions`, and the other
    vehicles follow the traffic driver, which controls row 0 only.
    """

    def __init__(self, traffic: Driver) -> None:
        """Wraps the driver of the vehicles that are not agents."""
        self._traffic = traffic
        self.actions = np.zeros((0, 2), dtype=np.float32)
        """(V, 2) [acceleration m/s², steering rad] of each agent in the coming tick."""
        self._agent_index = np.zeros((0, 0), dtype=np.int64)
        """(V, A) number of the agent in each slot, -1 for other vehicles."""
        self._slots = np.zeros((0, 0), dtype=np.int64)
        """(V, A) slot in row 0 of the vehicle in each slot, -1 for vehicles not in row 0."""

    def reset(
        self,
        world: World,
        reset_mask: Bool[np.ndarray, " b"],
        agent_mask: Bool[np.ndarray, "b a"] | None = None,
    ) -> None:
        """Matches the slots of the rows in `reset_mask`; the other rows are empty."""
        tracks = world.episodes.tracks
        tracks = np.where(reset_mask[:, None] & (tracks >= 0), tracks, -1)
        self._agent_index = _match(tracks, tracks[:, EGO])
        self._slots = _match(tracks, tracks[0])
        self.actions = np.zeros((len(tracks), 2), dtype=np.float32)
        others = controllable_agents(world) if agent_mask is None else agent_mask
        traffic = others & (self._agent_index < 0)
        traffic[1:] = False
        self._traffic.reset(world, reset_mask, traffic)

    def control(self, world: World) -> Control:
        """Returns the control of all agents but the ego in each row."""
        control = self._traffic.control(world)
        in_row_0, is_agent = self._slots >= 0, self._agent_index >= 0
        euler = None
        if control.euler is not None:
            euler = ~is_agent & control.euler[0, self._slots] & in_row_0
        return Control(
            actions=np.where(
                is_agent[..., None],
                self.actions[self._agent_index],
                control.actions[0, self._slots],
            ),
            controlled=is_agent | (control.controlled[0, self._slots] & in_row_0),
            leaving=~is_agent & control.leaving[0, self._slots] & in_row_0,
            euler=euler,
        )

    def slots_of(self, agents: Bool[np.ndarray, " b"]) -> Bool[np.ndarray, "b a"]:
        """Returns the mask of the slots that hold some agents, in all rows."""
        return (self._agent_index >= 0) & agents[self._agent_index]


def _match(tracks: Int[np.ndarray, "b a"], known: Int[np.ndarray, " n"]) -> Int[np.ndarray, "b a"]:
    """Returns the index of each track among the known ones, -1 for none and for negative tracks."""
    same = (tracks[..., None] == known) & (tracks >= 0)[..., None]
    return np.where(same.any(axis=-1), same.argmax(axis=-1), -1)


PRESENT = "present"
"""The key of the mask of `pad_absent` in observations and infos."""

Observations = dict[str, Any]
"""The observation of each agent: a dict of arrays, or with `flatten=True` one array."""


class ParallelReplayEnv(ParallelEnv[str, Any, Any]):
    """Controls many vehicles of a recording at once; the others are replayed or react.

    ## Description
    Each agent has the observations, actions, rewards and infos that `ReplayEnv` has for its ego,
    from its own view. `vehicle_0` is the ego of the scenario. The other agents are the vehicles
    that are present during the whole history and move by at least 1 m until the scenario, or their
    own track, ends. Vehicles that stand all the time or appear later are traffic.

    `possible_agents` never changes: it has as many agents as the scenario with the most agents. The
    first of them, as many as the scenario has, are present. An agent is present until its episode
    ends, and absent from then on. After `reset`, `agents` are all of `possible_agents`, as tools
    for PettingZoo expect; those that the scenario does not have are terminated in the first step,
    with zeros as observations and the reward 0. From then on, `agents` are the present ones, and
    the list shrinks. With `pad_absent`, `agents` are all of `possible_agents` until no agent is
    present, for tools that need a fixed population. `present_agents` are the present ones.

    ## Action Space
    That of `ReplayEnv` for each agent.

    ## Observation Space
    That of `ReplayEnv` for each agent. `pad_absent` adds the entry `present`, `Box(0, 1, (1,),
    int8)`, which is 0 for an absent agent; all other entries are zeros then.

    ## Rewards
    Those of `ReplayEnv` for each agent; 0 for an absent one.

    ## Starting State
    As in `ReplayEnv`; only scenarios whose ego may be an agent are drawn. `reset` ignores unknown
    options, since PettingZoo's own tests pass one.

    ## Episode End
    As in `ReplayEnv` for each agent: terminated by `COLLISION` at its own fault, `OFF_ROAD` or
    `GOAL`, truncated by `OUT_OF_DATA` when its own track ends. An agent disappears after its last
    observation, also after a collision, since replayed traffic would pass through a wreck. A
    vehicle that was hit continues. The episode is over when no agent is present. After that,
    `step({})` returns five empty dicts.

    With `pad_absent`, PettingZoo does not allow an agent to be terminated and to stay. Therefore
    both flags are False until the last agent ends. In this tick the agents that end have their own
    flags, and absent ones are terminated if all of these are, and truncated otherwise.
    `info["ending"]` names the reason in the tick in which an agent ends, and `info["present"]` is
    False from the next tick on. An absent agent's observations are all the same and its rewards are
    0: an absorbing state, whose value is 0. Infos of absent agents have the keys of the others,
    with zeros, empty strings and empty tuples.

    ## Arguments
    The arguments of `ReplayEnv` (as `render_mode` only `rgb_array`), and

    | argument | default | meaning |
    |---|---|---|
    | `classes` | `None` | names of the classes of vehicles that may be agents, such as `car`; by \
default all |
    | `ids` | `None` | track ids of the vehicles that may be agents, in any recording; by default \
all |
    | `max_agents` | `None` | the largest number of agents; those nearest to `vehicle_0` are taken |
    | `pad_absent` | `False` | absent agents stay in `agents`, with zeros and the mask `present` |
    | `flatten` | `False` | `True`: the observation of an agent is one vector; `"parts"`: each \
entry is a vector, images stay images |
    | `numeric_infos` | `False` | infos are numbers only, with the same keys after `reset` and \
`step`; no `scenario`, `ending` and `reward_terms` |

    ## Version History
    - v0: initial version
    """

    @suggest_options
    def __init__(
        self,
        data: str = "sample:intersection",
        *,
        classes: Sequence[str] | None = None,
        ids: Sequence[int] | None = None,
        max_agents: int | None = None,
        pad_absent: bool = False,
        flatten: Flatten = False,
        numeric_infos: bool = False,
        render_mode: str | None = None,
        observations: Sequence[str] = ("raster", "actions", "state"),
        view: str = "chauffeurnet",
        raster_px: int | Sequence[int] | None = None,
        traffic: TrafficSpec | None = None,
        dt_s: float = DEFAULT_DT_S,
        action_type: str = "direct",
        action_repeat: int = 1,
        reward_weights: Mapping[str, float] | None = None,
        scenarios: ScenarioSet | ScenarioFilter | str = "",
        predictor: PredictorSpec | None = None,
        forecast: ForecastSpec | None = None,
    ) -> None:
        """Makes the environment; the arguments are those of the class documentation.

        Raises:
            AspEnvError: an argument is invalid, or no scenario fits.
        """
        if render_mode not in (None, "rgb_array"):
            raise AspEnvError(f"render mode {render_mode!r}: expected rgb_array or None")
        if max_agents is not None:
            whole_number("max_agents", max_agents, least=1)
        flag("pad_absent", pad_absent)
        flag("numeric_infos", numeric_infos)
        options = ReplayOptions(
            observations=observations,
            view=view,
            raster_px=raster_px,
            traffic=traffic,
            dt_s=dt_s,
            action_type=action_type,
            action_repeat=action_repeat,
            reward_weights=reward_weights,
            scenarios=scenarios,
            predictor=predictor,
            forecast=forecast,
        )
        self.render_mode = render_mode
        self._episodes = ReplayEpisodes(data, options, 1)
        self.metadata = {
            "name": "asp_env/ParallelReplay-v0",
            "render_modes": ["rgb_array"],
            "render_fps": render_fps(dt_s * action_repeat),
        }
        self.recordings = self._episodes.recordings
        selection = AgentSelection(classes=classes, ids=ids)
        self._selected = tuple(selection.mask(recording) for recording in self.recordings)
        self.scenarios, num_agents = self._drivable_scenarios(data)
        self._max_agents = num_agents if max_agents is None else min(num_agents, max_agents)
        self._episodes.restrict(self.scenarios, self._max_agents)
        simulation = self._episodes.simulation
        simulation.driver = JointPolicyDriver(simulation.driver)
        self.possible_agents = [f"vehicle_{row}" for row in range(self._max_agents)]
        self.agents: list[str] = []
        self._pad_absent = pad_absent
        self._flatten: Flatten = flatten
        self._numeric_infos = numeric_infos
        self._rows = {name: row for row, name in enumerate(self.possible_agents)}
        self._in_episode: list[str] = []
        """The agents of the episode: those that were present after `reset`."""
        self._present: list[str] = []
        space = self._episodes.space
        if pad_absent:
            mask = spaces.Box(0, 1, (1,), dtype=np.int8)
            space = extended_space(space, {PRESENT: mask})
        space = flat_space(space, flatten)
        self.observation_spaces: dict[str, Any] = dict.fromkeys(self._rows, space)
        self.action_spaces: dict[str, spaces.Space[Any]] = {
            name: spaces.Box(-1.0, 1.0, (2,), dtype=np.float32) for name in self._rows
        }
        self.state_space = spaces.Box(-np.inf, np.inf, (self._max_agents, 7), dtype=np.float32)
        self._np_random: np.random.Generator | None = None

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observations, dict[str, dict[str, Any]]]:
        """Starts an episode.

        Args:
            seed: seed of the generator that draws the scenario.
            options: those of `ReplayEnv.reset`; others are ignored.

        Raises:
            AspEnvError: the seed or the options are invalid, or there is no such scenario.
        """
        chosen = reset_options(options)
        seed = checked_seed(seed)
        if seed is not None or self._np_random is None:
            self._np_random, _ = seeding.np_random(seed)
        known = {name: value for name, value in chosen.items() if name in RESET_OPTIONS}
        scenario, rng = self._episodes.draw(self._np_random, known)
        world = self._episodes.simulation.world
        views = agent_scenarios(
            self.recordings[scenario.recording],
            self._selected[scenario.recording],
            scenario,
            dt_s=world.dt_s,
            history=self.scenarios.history,
            max_agents=self._max_agents,
        )
        reset_mask = np.arange(self._max_agents) < len(views)
        padding = [scenario] * (self._max_agents - len(views))
        self._episodes.begin([*views, *padding], [rng] * self._max_agents, reset_mask)
        self._in_episode = self.possible_agents[: len(views)]
        self._present = self._in_episode.copy()
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
        """Steps by one tick with an action (2,) for each present agent, clipped to [-1, 1].

        Args:
            actions: the actions by agent; those of absent agents are ignored. An empty dict after
                the end of the episode changes nothing.

        Returns:
            Observations, rewards, terminations, truncations and infos of `agents`, and of those
            that end in this tick; five empty dicts after the end of the episode.

        Raises:
            gymnasium.error.ResetNeeded: there are actions after the end of the episode, or none
                has begun.
            AspEnvError: an agent's action is missing, has another shape or is not finite.
        """
        table("actions", actions, "an action by agent")
        if not self._present:
            if actions or not self._in_episode:
                raise gymnasium.error.ResetNeeded("no agent is left: call reset before step")
            return {}, {}, {}, {}, {}
        joint = np.zeros((self._max_agents, 2), dtype=np.float32)
        for name in self._present:
            if name not in actions:
                raise AspEnvError(
                    f"no action for {name}: expected one for each present agent, which are "
                    f"{', '.join(self._present)}"
                )
            joint[self._rows[name]] = valid_actions(actions[name], (2,))
        driver = self._episodes.simulation.driver
        assert isinstance(driver, JointPolicyDriver)
        driver.actions = self._episodes.physical_actions(joint)
        result = self._episodes.step(joint)
        over = result.terminated | result.truncated
        remaining = [name for name in self._present if not over[self._rows[name]]]
        present = self._present_mask()
        terminated, truncated = result.terminated, result.truncated
        if self._pad_absent:
            all_terminated = terminated[present].all()
            terminated = np.where(present, terminated, all_terminated) & (not remaining)
            truncated = np.where(present, truncated, ~all_terminated) & (not remaining)
        else:  # those that the scenario does not have end in the first step
            terminated, truncated = terminated | ~present, truncated & present
        returned = (
            self._observe(),
            self._by_agent(np.where(present, result.reward, 0.0)),
            self._by_agent(terminated),
            self._by_agent(truncated),
            self._infos(),
        )
        self._episodes.simulation.world.episodes.departed |= driver.slots_of(over)
        self._present = remaining
        if not self._pad_absent or not remaining:
            self.agents = remaining.copy()
        return returned

    def scene(self, agent: str) -> Scene:
        """Returns the scene from the view of an agent, which is slot 0, for predictors.

        Raises:
            gymnasium.error.ResetNeeded: no episode has begun.
            AspEnvError: there is no such agent, or the episode began without it.
        """
        self._check_agent(agent)
        self._check_begun()
        if agent not in self._in_episode:
            raise AspEnvError(
                f"{agent} is absent from this episode: expected one of "
                f"{', '.join(self._in_episode)}"
            )
        return self._episodes.scene().situation(self._rows[agent])

    @property
    def present_agents(self) -> list[str]:
        """The agents that are present now, in the order of `possible_agents`."""
        return self._present.copy()

    def state(self) -> Float[np.ndarray, "agents 7"]:
        """Returns the states of all possible agents in the recording's frame.

        Returns:
            [x m, y m, heading rad, speed m/s, length m, width m, 1] of each agent; zeros for absent
            ones.

        Raises:
            gymnasium.error.ResetNeeded: no episode has begun.
        """
        self._check_begun()
        world = self._episodes.simulation.world
        state = np.zeros(self.state_space.shape or (), dtype=np.float32)
        rows = [self._rows[name] for name in self._present]
        state[rows, :4] = world.ego_states()[rows]
        state[rows, 4:6] = world.episodes.sizes[rows, 0]
        state[rows, 6] = 1.0
        return state

    def observation_space(self, agent: str) -> spaces.Space[Any]:
        """Returns the observation space, which all agents share.

        Raises:
            AspEnvError: there is no such agent.
        """
        self._check_agent(agent)
        return self.observation_spaces[agent]

    def action_space(self, agent: str) -> spaces.Space[Any]:
        """Returns the action space of an agent, which has its own seed.

        Raises:
            AspEnvError: there is no such agent.
        """
        self._check_agent(agent)
        return self.action_spaces[agent]

    def render(self) -> Any:
        """Returns an image of the whole map, uint8 (H, W, 3) RGB, or None without a mode."""
        if self.render_mode is None:
            return None
        scene = self.scene((self._present or self._in_episode or self.possible_agents)[0])
        recording = self._episodes.simulation.world.episodes.recording[0]
        background = self.recordings[int(recording)].background
        return draw_frame(scene, extent_m=None, background=background)

    def close(self) -> None:
        """Does nothing: the environment has no window."""

    def _drivable_scenarios(self, data: str) -> tuple[ScenarioSet, int]:
        """Returns the scenarios whose ego may be an agent, and the most agents of any of them."""
        world, scenarios = self._episodes.simulation.world, self._episodes.scenarios
        drivable, num_agents = np.zeros(len(scenarios), dtype=bool), 0
        for row, scenario in enumerate(scenarios):
            recording = self.recordings[scenario.recording]
            selected = self._selected[scenario.recording]
            if selected[recording.track_ids == scenario.ego_id].any():
                present = present_tracks(
                    recording, scenario, dt_s=world.dt_s, history=scenarios.history
                )
                num_agents = max(num_agents, int((present & selected).sum()))
                drivable[row] = True
        if not num_agents:
            raise AspEnvError(
                f"{data}: the ego of no scenario has one of the given classes and ids"
            )
        return scenarios.select(drivable), num_agents

    def _check_agent(self, agent: str) -> None:
        if agent not in self.possible_agents:
            raise unknown_name("agent", agent, self.possible_agents)

    def _check_begun(self) -> None:
        if not self._in_episode:
            raise gymnasium.error.ResetNeeded("no episode has begun: call reset first")

    def _present_mask(self) -> Bool[np.ndarray, " agents"]:
        """Returns the mask of the present agents among the possible ones."""
        present = np.zeros(self._max_agents, dtype=bool)
        present[[self._rows[name] for name in self._present]] = True
        return present

    def _observe(self) -> Observations:
        rows = np.flatnonzero(self._present_mask())
        observed = self._episodes.observe(rows)
        if self._pad_absent:
            observed[PRESENT] = np.ones((len(rows), 1), dtype=np.int8)
        if len(self.agents) > len(rows):
            observed = {
                name: _pad(values, rows, self._max_agents) for name, values in observed.items()
            }
        observed = flatten_observations(observed, self._flatten)
        if self._flatten is True:
            return dict(zip(self.agents, observed, strict=True))
        return {
            agent: {name: values[row] for name, values in observed.items()}
            for row, agent in enumerate(self.agents)
        }

    def _infos(self) -> dict[str, dict[str, Any]]:
        rows = self._episodes.info()
        if self._numeric_infos:
            rows = {
                name: values
                for name, values in rows.items()
                if isinstance(values, np.ndarray) and values.dtype != object
            }
        infos = {agent: info_of(rows, self._rows[agent]) for agent in self.agents}
        if len(self.agents) > len(self._present):
            empty = _empty(infos[self._present[0]])
            for agent in set(self.agents).difference(self._present):
                infos[agent] = copy.deepcopy(empty)
        if self._pad_absent:
            for agent, info in infos.items():
                info[PRESENT] = agent in self._present
        return infos

    def _by_agent(self, values: np.ndarray) -> dict[str, Any]:
        plain = values.tolist()
        return {name: plain[self._rows[name]] for name in self.agents}


def _pad(values: np.ndarray, rows: Int[np.ndarray, " n"], count: int) -> np.ndarray:
    """Returns `count` rows: the given values in their rows, and zeros in the others."""
    padded = np.zeros((count, *values.shape[1:]), dtype=values.dtype)
    padded[rows] = values
    return padded


def _empty(info: dict[str, Any]) -> dict[str, Any]:
    """Returns an info with the same keys and types, and with zeros and empty values."""
    return {
        name: _empty(value)
        if isinstance(value, dict)
        else np.zeros_like(value)
        if isinstance(value, np.ndarray)
        else type(value)()
        for name, value in info.items()
    }
