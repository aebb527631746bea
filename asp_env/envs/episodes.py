"""Episodes of recordings as the environments drive them: one core, of any number side by side."""

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from gymnasium import spaces
from jaxtyping import Bool, Float, Int, Shaped

from asp_env.data.clock import DEFAULT_DT_S, ticks
from asp_env.data.scenario import Scenario, ScenarioSet
from asp_env.data.scenario_filter import ScenarioFilter
from asp_env.data.snippets import HISTORY_S
from asp_env.data.source import open_data
from asp_env.dynamics import MAX_ACCELERATION_MPS2, MAX_STEERING_RAD
from asp_env.envs.start import Starts
from asp_env.errors import AspEnvError, unknown_name
from asp_env.sim.observation import Observation, Observer
from asp_env.sim.reward import reward_terms, weighted_sum, weights_from
from asp_env.sim.sight import ego_sight
from asp_env.sim.simulation import Simulation, ending
from asp_env.sim.traffic import TrafficSpec, make_traffic
from asp_env.sim.world import Ending, Events
from asp_env.sim.worlds import world_of
from asp_env.views import make_picture_view

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
class Outcome:
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
        self._starts = Starts.choose(
            self.recordings, chosen.scenarios, dt_s=chosen.dt_s, history=history
        )
        self.scenarios = self._starts.scenarios
        raster = make_picture_view(chosen.view, pixels=chosen.raster_px)
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

    def step(self, actions: Float[np.ndarray, "b 2"]) -> Outcome:
        """One tick; actions in [-1, 1]."""
        world, before = self.simulation.world, self.events
        assert before is not None
        states_before = world.ego_states()
        driven = np.ones(len(world), dtype=bool)
        self.simulation.step(actions * _ACTION_LIMITS, driven)
        self.events = after = world.events()
        terms = reward_terms(before, after, states_before, world.ego_states(), world.dt_s)
        why = ending(after)
        return Outcome(
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
        return self.observer.observe(ego_sight(self.simulation.world, rows), events, out)

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
