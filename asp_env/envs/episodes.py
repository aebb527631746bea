"""Memory for observations that is used again once nobody holds it.

MERGED: Which scenarios an environment draws from, and the one that a reset asks for.
MERGED: Episodes of recordings as the environments drive them: one core, of any number side by side.
"""

import dataclasses
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from gymnasium import spaces
from jaxtyping import Bool, Float, Int, Shaped

from asp_env.data.recording import DEFAULT_DT_S, ticks
from asp_env.data.scenarios.scenario import Scenario, ScenarioFilter, ScenarioSet
from asp_env.data.scenarios.selection import choose_scenarios, scenario_of
from asp_env.data.snippets import HISTORY_S
from asp_env.data.source import Recordings, open_data
from asp_env.dynamics import MAX_ACCELERATION_MPS2, MAX_STEERING_RAD
from asp_env.errors import AspEnvError, unknown_name
from asp_env.sim.observation import Observation, Observer, ego_context
from asp_env.sim.reward import reward_terms, weighted_sum, weights_from
from asp_env.sim.simulation import Simulation, ending
from asp_env.sim.traffic.assignment import TrafficSpec, make_traffic
from asp_env.sim.world import Ending, Events, world_of
from asp_env.views import make_raster_view


def _references(held: list[Observation], number: int, name: str) -> int:
    """How many references there are to one array, this function's own among them."""
    return sys.getrefcount(held[number][name])


class Buffers:
    """Hands out arrays for observations; none again while anybody else holds it or a part of it.

    Fresh memory of large pictures costs as much time as drawing them, since the system has to find
    and clear it page by page. NumPy arrays and tensors that share an array's memory keep a
    reference to it, so an array that has no reference but this object's own is free.
    """

    _KEPT = 3
    """The caller often still holds the last observations while it asks for the next."""

    def __init__(self, observer: Observer, count: int) -> None:
        """Of that many observations each."""
        self._observer = observer
        self._count = count
        self._held: list[Observation] = []
        self._alone = _references([{"": np.empty(0)}], 0, "")

    def take(self) -> Observation:
        """Arrays whose content does not matter; the caller owns them while it holds them."""
        for number, arrays in enumerate(self._held):
            if all(_references(self._held, number, name) == self._alone for name in arrays):
                self._held.append(self._held.pop(number))
                return dict(arrays)
        fresh = self._observer.memory(self._count)
        self._held.append(fresh)
        del self._held[: -self._KEPT]
        return dict(fresh)


OPTIONS = ("scenario", "start_tick", "ego")
"""What `reset(options=…)` understands."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ScenarioSampler:
    """Where episodes of some recordings may begin."""

    recordings: Recordings
    scenarios: ScenarioSet

    @classmethod
    def choose(
        cls,
        recordings: Recordings,
        wanted: ScenarioSet | ScenarioFilter | str,
        *,
        dt_s: float,
        history: int,
    ) -> "ScenarioSampler":
        """The scenarios to draw from: those that fit a filter or its words, or those given.

        Raises:
            AspEnvError: there is none, or those given are of other data or another time step.
        """
        data = recordings.source
        if isinstance(wanted, ScenarioSet):
            _check(wanted, recordings, dt_s=dt_s, history=history)
            return cls(recordings=recordings, scenarios=wanted)
        found = choose_scenarios(recordings, str(wanted), dt_s=dt_s, history=history)
        if not len(found):
            raise AspEnvError(
                f"{data}: no vehicle covers 10 m in 4 s after 3 s of history; use other recordings"
            )
        return cls(recordings=recordings, scenarios=found)

    def __deepcopy__(self, memo: dict[int, Any]) -> "ScenarioSampler":
        """Itself, since nothing of it ever changes."""
        del memo
        return self

    def find(self, options: Mapping[str, Any], drawn: int) -> Scenario:
        """The scenario that the options of a reset ask for, else the drawn one.

        `scenario` is a number or a name. `ego` is the track id of any vehicle, in the recording of
        the scenario; `start_tick` the tick of the first observation. Without a start the episode
        begins as soon as the history is there; it lasts as long as the track, 15 s at most.

        Raises:
            AspEnvError: an option is unknown, or what it asks for does not exist.
        """
        for name in options:
            if name not in OPTIONS:
                raise unknown_name("reset option", str(name), OPTIONS)
        asked = options.get("scenario")
        given = self.scenarios[drawn] if asked is None else self._asked(asked)
        ego, start_tick = options.get("ego"), options.get("start_tick")
        if ego is None and start_tick is None:
            return given
        if asked is None and ego is None:
            raise AspEnvError(
                f"start_tick {start_tick} alone: name the scenario or the ego that starts there"
            )
        if asked is None and len(self.recordings) > 1:
            raise AspEnvError(
                f"ego {ego} without a scenario: {self.scenarios.source} has "
                f"{len(self.recordings)} recordings; name a scenario of the one that is meant"
            )
        return scenario_of(
            self.recordings,
            source=self.scenarios.source,
            recording=given.recording,
            ego_id=given.ego_id if ego is None else _whole("ego", ego),
            start_tick=None if start_tick is None else _whole("start_tick", start_tick),
            dt_s=self.scenarios.dt_s,
            history=self.scenarios.history,
        )

    def _asked(self, asked: Any) -> Scenario:
        if isinstance(asked, str):
            return self.scenarios.by_name(asked)
        whole = isinstance(asked, int | np.integer) and not isinstance(asked, bool)
        if not (whole and 0 <= asked < len(self.scenarios)):
            raise AspEnvError(
                f"scenario {asked}: expected 0 to {len(self.scenarios) - 1} for this data, or a "
                "scenario's name"
            )
        return self.scenarios[int(asked)]


def _check(given: ScenarioSet, recordings: Recordings, *, dt_s: float, history: int) -> None:
    if not len(given):
        raise AspEnvError("scenarios: the set is empty; expected at least one scenario")
    names = tuple(recording.name for recording in recordings)
    if given.recordings != names:
        raise AspEnvError(
            f"scenarios of {given.source}: expected some of {recordings.source}, whose recordings "
            f"are {', '.join(names)}"
        )
    if abs(given.dt_s - dt_s) > 1e-9 or given.history != history:
        raise AspEnvError(
            f"scenarios for {given.history} past ticks of {given.dt_s:g} s: expected {history} of "
            f"{dt_s:g} s"
        )


def _whole(name: str, value: Any) -> int:
    if not isinstance(value, int | np.integer) or isinstance(value, bool):
        raise AspEnvError(f"{name} {value!r}: expected a whole number")
    return int(value)


_ACTION_LIMITS = np.array([MAX_ACCELERATION_MPS2, MAX_STEERING_RAD], dtype=np.float32)
_TERMINAL = np.array([kind in (Ending.COLLISION, Ending.OFF_ROAD, Ending.GOAL) for kind in Ending])
_ENDING_NAMES = np.array([kind.name for kind in Ending], dtype=object)


@dataclass(frozen=True, slots=True, kw_only=True)
class ReplayOptions:
    """What can be chosen of a replay environment."""

    observations: Sequence[str] = ("raster", "actions", "state")
    """Some of `asp_env.sim.observation.KNOWN`."""
    view: str = "chauffeurnet"
    """What the raster shows."""
    raster_px: tuple[int, int] | None = None
    """Height and width of the raster; by default the view's own."""
    traffic: TrafficSpec | None = None
    """Who moves the others; by default the world itself."""
    dt_s: float = DEFAULT_DT_S
    """Length of a tick."""
    reward_weights: Mapping[str, float] | None = None
    """Weights by name, where they differ from the defaults."""
    scenarios: ScenarioSet | ScenarioFilter | str = ""
    """The scenarios to draw from: those that fit a filter, such as `left,length>=8`, or these."""


@dataclass(frozen=True, slots=True, kw_only=True)
class StepResult:
    """What a step of B episodes led to."""

    reward: Float[np.ndarray, " b"]
    terms: dict[str, Float[np.ndarray, " b"]]
    """The terms of the reward, unweighted."""
    terminated: Bool[np.ndarray, " b"]
    truncated: Bool[np.ndarray, " b"]
    ending: Shaped[np.ndarray, " b"]
    """The name of the `Ending` of each."""


class ReplayEpisodes:
    """B episodes: scenarios, observations, rewards and infos, without anybody's conventions."""

    def __init__(self, data: str, options: Mapping[str, Any], num_episodes: int) -> None:
        """Episodes begin with `begin`.

        Args:
            data: DATA.
            options: fields of `ReplayOptions`.
            num_episodes: B.

        Raises:
            AspEnvError: an option is not understood, or the data hold no scenario.
        """
        chosen = _options(options)
        history = ticks(HISTORY_S, chosen.dt_s)
        self.recordings = open_data(data)
        self._starts = ScenarioSampler.choose(
            self.recordings, chosen.scenarios, dt_s=chosen.dt_s, history=history
        )
        self.scenarios = self._starts.scenarios
        raster = make_raster_view(chosen.view, pixels=chosen.raster_px)
        self.observer = Observer(chosen.observations, raster, history)
        kind = world_of(data)
        self.simulation = Simulation(
            self.recordings,
            make_traffic(chosen.traffic, dt_s=chosen.dt_s, default=kind.traffic),
            num_episodes=num_episodes,
            dt_s=chosen.dt_s,
            history=history,
            kind=kind,
        )
        self._weights = weights_from(chosen.reward_weights or {})
        self._names = np.full(num_episodes, None, dtype=object)
        self._tags = np.full(num_episodes, None, dtype=object)
        self.action_space = spaces.Box(-1.0, 1.0, (2,), dtype=np.float32)
        self.events: Events | None = None

    def restrict(self, scenarios: ScenarioSet, num_episodes: int) -> None:
        """From now on draws from these scenarios and holds that many episodes, none begun."""
        world = self.simulation.world
        self.scenarios = scenarios
        self._starts = dataclasses.replace(self._starts, scenarios=scenarios)
        self.simulation = Simulation(
            self.recordings,
            self.simulation.driver,
            num_episodes=num_episodes,
            dt_s=world.dt_s,
            history=world.history,
            kind=type(world),
        )
        self._names = np.full(num_episodes, None, dtype=object)
        self._tags = np.full(num_episodes, None, dtype=object)
        self.events = None

    def draw(
        self, np_random: np.random.Generator, options: Mapping[str, Any]
    ) -> tuple[Scenario, np.random.Generator]:
        """The scenario of the options of a reset, else a drawn one; and its own generator.

        Raises:
            AspEnvError: an option is unknown, or what it asks for does not exist.
        """
        drawn = int(np_random.integers(len(self.scenarios)))
        scenario = self._starts.find(options, drawn)
        return scenario, np.random.default_rng(np_random.integers(2**63))

    def begin(
        self,
        scenarios: Sequence[Scenario],
        rngs: Sequence[np.random.Generator],
        where: Bool[np.ndarray, " b"],
    ) -> None:
        """Starts the episodes at `where`; the others' entries are not read."""
        self.simulation.reset(scenarios, rngs, where)
        for b in np.flatnonzero(where).tolist():
            self._names[b], self._tags[b] = scenarios[b].name, scenarios[b].tags
        self.events = self.simulation.world.events()

    def snapshot(self) -> Any:
        """The whole state, to be handed to `restore`: no recording, no picture."""
        return self.simulation.snapshot()

    def restore(self, snapshot: Any) -> None:
        """Goes back to a snapshot, bit for bit."""
        self.simulation.restore(snapshot)
        world = self.simulation.world
        for b, scenario in enumerate(world.scenarios):
            self._names[b] = None if scenario is None else scenario.name
            self._tags[b] = None if scenario is None else scenario.tags
        self.events = world.events()

    def step(self, actions: Float[np.ndarray, "b 2"]) -> StepResult:
        """One tick; actions in [-1, 1]."""
        world, before = self.simulation.world, self.events
        assert before is not None
        states_before = world.ego_states()
        driven = np.ones(len(world), dtype=bool)
        self.simulation.step(actions * _ACTION_LIMITS, driven)
        self.events = after = world.events()
        terms = reward_terms(before, after, states_before, world.ego_states(), world.dt_s)
        why = ending(after)
        return StepResult(
            reward=weighted_sum(terms, self._weights),
            terms=terms,
            terminated=_TERMINAL[why],
            truncated=why == Ending.OUT_OF_DATA,
            ending=_ENDING_NAMES[why],
        )

    def observe(
        self, rows: Int[np.ndarray, " n"] | None = None, out: Observation | None = None
    ) -> Observation:
        """What the egos of some episodes see now, by default of all; into `out` if given."""
        assert self.events is not None
        events = self.events if rows is None else _rows(self.events, rows)
        return self.observer.observe(ego_context(self.simulation.world, rows), events, out)

    def info(self) -> dict[str, Shaped[np.ndarray, " b"]]:
        """What is told beside the observation, in fresh arrays."""
        events = self.events
        assert events is not None
        return {
            "scenario": self._names.copy(),
            "tags": self._tags.copy(),
            "tick": events.elapsed.copy(),
            "progress": events.route_m / np.maximum(events.goal_m, 1.0),
            "collision": events.collision,
            "at_fault": events.at_fault,
            "off_road_m": events.off_road_m.astype(np.float64),
        }


def as_actions(
    given: Any, shape: tuple[int, ...], ignored: Bool[np.ndarray, " b"] | None = None
) -> Float[np.ndarray, "*batch 2"]:
    """Actions as they are carried out: moved to the nearest ones in [-1, 1].

    Args:
        given: by the caller.
        shape: expected.
        ignored: rows that may hold anything; they become zeros.

    Raises:
        AspEnvError: the actions have another shape or are not finite.
    """
    expected = "two finite numbers in [-1, 1]"
    if len(shape) > 1:
        expected += f" for each environment, {shape}"
    try:
        actions = np.asarray(given, dtype=np.float64)
    except (TypeError, ValueError):
        raise AspEnvError(f"action {type(given).__name__}: expected {expected}") from None
    if actions.shape != shape:
        raise AspEnvError(f"action of shape {actions.shape}: expected {expected}")
    if ignored is not None:
        actions = np.where(ignored[:, None], 0.0, actions)
    if not np.isfinite(actions).all():
        rows = actions.reshape(-1, 2)
        wrong = rows[~np.isfinite(rows).all(axis=1)][0]
        raise AspEnvError(f"action {wrong.tolist()}: expected {expected}")
    return np.minimum(np.maximum(actions, -1.0), 1.0).astype(np.float32)


def _options(given: Mapping[str, Any]) -> ReplayOptions:
    known = [field.name for field in dataclasses.fields(ReplayOptions)]
    for name in given:
        if name not in known:
            raise unknown_name("argument", name, ["data", "render_mode", *known])
    return ReplayOptions(**given)


def _rows(events: Events, rows: Int[np.ndarray, " n"]) -> Events:
    return Events(
        **{field.name: getattr(events, field.name)[rows] for field in dataclasses.fields(events)}
    )
