"""The core of the environments: episodes side by side, without the conventions of an interface.

`ReplayEpisodes` draws scenarios, steps the simulation, and returns observations, rewards and infos
as arrays with one row per episode. The single, vector and parallel environments build on it.
"""

import dataclasses
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from gymnasium import spaces
from jaxtyping import Bool, Float, Int, Shaped

from asp_env.data.recording import ticks
from asp_env.data.scenarios.scenario import Scenario, ScenarioFilter, ScenarioSet
from asp_env.data.scenarios.selection import choose_scenarios, scenario_of
from asp_env.data.scene import Scene
from asp_env.data.snippets import HISTORY_S, Future
from asp_env.data.source import Recordings, open_data
from asp_env.dynamics import denormalize_actions
from asp_env.envs.forecasts import Present, extended_space, forecast_observers
from asp_env.envs.options import ReplayOptions
from asp_env.errors import AspEnvError, unknown_name
from asp_env.sim.observation import Observation, Observer, ego_context
from asp_env.sim.reward import reward_terms, weighted_sum, weights_from
from asp_env.sim.simulation import Simulation, ending
from asp_env.sim.traffic.assignment import make_traffic
from asp_env.sim.world import Ending, Events, recorded_future, world_class
from asp_env.views import make_raster_view

RESET_OPTIONS = ("scenario", "start_tick", "ego")
"""The keys that `reset(options=…)` accepts."""

_IS_TERMINAL = np.array(
    [kind in (Ending.COLLISION, Ending.OFF_ROAD, Ending.GOAL) for kind in Ending]
)
_ENDING_NAMES = np.array([kind.name for kind in Ending], dtype=object)


@dataclass(frozen=True, slots=True, kw_only=True)
class ScenarioSampler:
    """The scenarios of some recordings that episodes are drawn from."""

    recordings: Recordings
    scenarios: ScenarioSet

    @classmethod
    def choose(
        cls,
        recordings: Recordings,
        scenarios: ScenarioSet | ScenarioFilter | str,
        *,
        dt_s: float,
        history: int,
    ) -> "ScenarioSampler":
        """Makes a sampler of a given set, or of the scenarios that fit a filter.

        Args:
            recordings: the recordings of the scenarios.
            scenarios: a set, a filter, or the text of a filter; empty text fits every scenario.
            dt_s: length of a tick in seconds.
            history: past ticks before the start of a scenario.

        Raises:
            AspEnvError: no scenario fits, or the set is of other data or another time step.
        """
        if isinstance(scenarios, ScenarioSet):
            _check_set(scenarios, recordings, dt_s=dt_s, history=history)
            return cls(recordings=recordings, scenarios=scenarios)
        chosen = choose_scenarios(recordings, str(scenarios), dt_s=dt_s, history=history)
        if not len(chosen):
            raise AspEnvError(
                f"{recordings.source}: no vehicle covers 10 m in 4 s after 3 s of history; "
                "use other recordings"
            )
        return cls(recordings=recordings, scenarios=chosen)

    def __deepcopy__(self, memo: dict[int, Any]) -> "ScenarioSampler":
        """Returns the sampler itself, which is immutable."""
        del memo
        return self

    def select(self, options: Mapping[str, Any], drawn: int) -> Scenario:
        """Returns the scenario that the options of a reset name, or the drawn one.

        Args:
            options: `scenario`, a number or a name; `ego`, the track id of any vehicle in the
                recording of the scenario; `start_tick`, the tick of the first observation. Without
                a start the episode begins at the first tick with a full history. It lasts as long
                as the ego's track, 15 s at most.
            drawn: number of the scenario for options that name none.

        Raises:
            AspEnvError: an option is unknown, or there is no such scenario.
        """
        for name in options:
            if name not in RESET_OPTIONS:
                raise unknown_name("reset option", str(name), RESET_OPTIONS)
        key, ego, start_tick = (options.get(name) for name in ("scenario", "ego", "start_tick"))
        scenario = self.scenarios[drawn] if key is None else self._by_key(key)
        if ego is None and start_tick is None:
            return scenario
        if key is None and ego is None:
            raise AspEnvError(
                f"start_tick {start_tick} alone: name the scenario or the ego that starts there"
            )
        if key is None and len(self.recordings) > 1:
            raise AspEnvError(
                f"ego {ego} without a scenario: {self.scenarios.source} has "
                f"{len(self.recordings)} recordings; name a scenario of the ego's recording"
            )
        return scenario_of(
            self.recordings,
            source=self.scenarios.source,
            recording=scenario.recording,
            ego_id=scenario.ego_id if ego is None else _whole_number("ego", ego),
            start_tick=None if start_tick is None else _whole_number("start_tick", start_tick),
            dt_s=self.scenarios.dt_s,
            history=self.scenarios.history,
        )

    def _by_key(self, key: Any) -> Scenario:
        if isinstance(key, str):
            return self.scenarios.by_name(key)
        is_whole = isinstance(key, int | np.integer) and not isinstance(key, bool)
        if not (is_whole and 0 <= key < len(self.scenarios)):
            raise AspEnvError(
                f"scenario {key}: expected 0 to {len(self.scenarios) - 1} for this data, or a "
                "scenario's name"
            )
        return self.scenarios[int(key)]


def _check_set(
    scenarios: ScenarioSet, recordings: Recordings, *, dt_s: float, history: int
) -> None:
    if not len(scenarios):
        raise AspEnvError("scenarios: the set is empty; expected at least one scenario")
    names = tuple(recording.name for recording in recordings)
    if scenarios.recordings != names:
        raise AspEnvError(
            f"scenarios of {scenarios.source}: expected some of {recordings.source}, whose "
            f"recordings are {', '.join(names)}"
        )
    if abs(scenarios.dt_s - dt_s) > 1e-9 or scenarios.history != history:
        raise AspEnvError(
            f"scenarios for {scenarios.history} past ticks of {scenarios.dt_s:g} s: expected "
            f"{history} of {dt_s:g} s"
        )


def _whole_number(name: str, value: Any) -> int:
    if not isinstance(value, int | np.integer) or isinstance(value, bool):
        raise AspEnvError(f"{name} {value!r}: expected a whole number")
    return int(value)


@dataclass(frozen=True, slots=True, kw_only=True)
class StepResult:
    """Rewards and endings of one step of B episodes."""

    reward: Float[np.ndarray, " b"]
    terms: dict[str, Float[np.ndarray, " b"]]
    """The terms of the reward by name, unweighted."""
    terminated: Bool[np.ndarray, " b"]
    truncated: Bool[np.ndarray, " b"]
    ending: Shaped[np.ndarray, " b"]
    """Name of the `Ending` of each episode."""


class ReplayEpisodes:
    """B episodes side by side: scenarios, observations, rewards and infos."""

    def __init__(self, data: str, options: ReplayOptions, num_episodes: int) -> None:
        """Opens the data; `begin` starts episodes.

        Args:
            data: a folder with recordings, or `scheme:argument`.
            options: the options of the environment.
            num_episodes: number B of episodes.

        Raises:
            AspEnvError: an option is invalid, or the data hold no scenario.
        """
        history = ticks(HISTORY_S, options.dt_s)
        self.recordings = open_data(data)
        self._sampler = ScenarioSampler.choose(
            self.recordings, options.scenarios, dt_s=options.dt_s, history=history
        )
        self.scenarios = self._sampler.scenarios
        raster = make_raster_view(options.view, pixels=options.raster_px)
        self.observer = Observer(options.observations, raster, history)
        kind = world_class(data)
        self.simulation = Simulation(
            self.recordings,
            make_traffic(options.traffic, dt_s=options.dt_s, default=kind.traffic),
            num_episodes=num_episodes,
            dt_s=options.dt_s,
            history=history,
            world_class=kind,
        )
        self._weights = weights_from(options.reward_weights or {})
        self._forecasts = forecast_observers(options.predictor, options.forecast, options.dt_s)
        self.space: spaces.Space[Any] = self.observer.space
        for each in self._forecasts:
            self.space = extended_space(self.space, each.spaces)
        self._num_begun = 0
        """Number of episodes begun or restored so far."""
        self._allocate(num_episodes)
        self.action_space = spaces.Box(-1.0, 1.0, (2,), dtype=np.float32)
        self.events: Events | None = None

    def restrict(self, scenarios: ScenarioSet, num_episodes: int) -> None:
        """Replaces the scenarios to draw from and the number of episodes, and ends all episodes."""
        world = self.simulation.world
        self.scenarios = scenarios
        self._sampler = dataclasses.replace(self._sampler, scenarios=scenarios)
        self.simulation = Simulation(
            self.recordings,
            self.simulation.driver,
            num_episodes=num_episodes,
            dt_s=world.dt_s,
            history=world.history,
            world_class=type(world),
        )
        self._allocate(num_episodes)
        self.events = None

    def _allocate(self, num_episodes: int) -> None:
        self._names = np.full(num_episodes, None, dtype=object)
        self._tags = np.full(num_episodes, None, dtype=object)
        self._seeds = np.zeros(num_episodes, dtype=np.uint64)
        self._serials = np.full(num_episodes, -1)
        self._rows = np.arange(num_episodes)

    def draw(
        self, np_random: np.random.Generator, options: Mapping[str, Any]
    ) -> tuple[Scenario, np.random.Generator]:
        """Draws a scenario, unless the options of a reset name one, and seeds its generator.

        Args:
            np_random: the generator of the environment; two numbers are drawn from it.
            options: the options of the reset, see `ScenarioSampler.select`.

        Returns:
            The scenario, and the generator for its episode.

        Raises:
            AspEnvError: an option is unknown, or there is no such scenario.
        """
        drawn = int(np_random.integers(len(self.scenarios)))
        scenario = self._sampler.select(options, drawn)
        return scenario, np.random.default_rng(np_random.integers(2**63))

    def begin(
        self,
        scenarios: Sequence[Scenario],
        rngs: Sequence[np.random.Generator],
        reset_mask: Bool[np.ndarray, " b"],
    ) -> None:
        """Starts the episodes of a mask; the other entries of the sequences are ignored."""
        self.simulation.reset(scenarios, rngs, reset_mask)
        for b in np.flatnonzero(reset_mask).tolist():
            self._names[b], self._tags[b] = scenarios[b].name, scenarios[b].tags
            self._seeds[b] = _seed_from(rngs[b])
        self._number(np.flatnonzero(reset_mask))
        self.events = self.simulation.world.events()

    def step(self, actions: Float[np.ndarray, "b 2"]) -> StepResult:
        """Steps all episodes by one tick; the egos' actions lie in [-1, 1]."""
        world, before = self.simulation.world, self.events
        assert before is not None
        states_before = world.ego_states()
        controlled = np.ones(len(world), dtype=bool)
        self.simulation.step(denormalize_actions(actions), controlled)
        self.events = after = world.events()
        terms = reward_terms(before, after, states_before, world.ego_states(), world.dt_s)
        endings = ending(after)
        return StepResult(
            reward=weighted_sum(terms, self._weights),
            terms=terms,
            terminated=_IS_TERMINAL[endings],
            truncated=endings == Ending.OUT_OF_DATA,
            ending=_ENDING_NAMES[endings],
        )

    def observe(
        self, rows: Int[np.ndarray, " n"] | None = None, out: Observation | None = None
    ) -> Observation:
        """Returns the present observations of the egos of some episodes, by default of all.

        Args:
            rows: numbers of the episodes.
            out: arrays to write into; new ones by default.
        """
        assert self.events is not None
        events = self.events if rows is None else _events_of(self.events, rows)
        seen = self.observer.observe(ego_context(self.simulation.world, rows), events, out)
        for each in self._forecasts:
            seen |= each.observe(self, self._rows if rows is None else rows)
        return seen

    def make_forecasts(self) -> None:
        """Makes the forecasts that are due now, as `observe` does, without observing."""
        for each in self._forecasts:
            each.make(self, self._rows)

    def __len__(self) -> int:
        """The number of episodes."""
        return len(self._rows)

    @property
    def dt_s(self) -> float:
        """Length of a tick in seconds."""
        return self.simulation.world.dt_s

    def present(self, rows: Int[np.ndarray, " r"]) -> Present:
        """Returns the present tick of some episodes, for forecasts."""
        world, episodes = self.simulation.world, self.simulation.world.episodes
        at = rows, world.now[rows]
        return Present(
            states=episodes.states[at],
            valid=episodes.valid[at],
            ids=episodes.ids[rows],
            elapsed=episodes.elapsed[rows],
            serials=self._serials[rows],
        )

    def scene(
        self,
        rows: Int[np.ndarray, " r"] | None = None,
        targets: Int[np.ndarray, "t 2"] | None = None,
        history: int | None = None,
    ) -> Scene:
        """Returns the scene of some episodes, by default of all, with the seeds of predictors.

        Args:
            rows: numbers of the episodes, which are the situations in this order.
            targets: (situation, slot) of the targets; by default all present agents but the egos.
            history: number of past ticks; that of the world by default.
        """
        scene = self.simulation.world.scene(rows, targets, history)
        seeds = self._seeds.copy() if rows is None else self._seeds[rows]
        return dataclasses.replace(scene, seeds=seeds)

    def recorded_future(
        self, scene: Scene, horizon: int, rows: Int[np.ndarray, " r"] | None = None
    ) -> Future:
        """Returns the recorded future of a scene's targets, for privileged predictors.

        Args:
            scene: a present scene.
            horizon: number of ticks.
            rows: numbers of the episodes that are its situations; all by default.
        """
        return recorded_future(self.simulation.world, scene, horizon, rows)

    def info(self) -> dict[str, Shaped[np.ndarray, " b"]]:
        """Returns the present infos in new arrays."""
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

    def snapshot(self) -> Any:
        """Returns the whole state for `restore`; it holds no recordings and no rasters."""
        forecasts = [each.snapshot() for each in self._forecasts]
        return self.simulation.snapshot(), self._seeds.copy(), forecasts

    def restore(self, snapshot: Any) -> None:
        """Restores the state of a snapshot, bit for bit."""
        simulation, seeds, forecasts = snapshot
        self.simulation.restore(simulation)
        self._seeds = seeds.copy()
        self._number(self._rows)
        for each, stored in zip(self._forecasts, forecasts, strict=True):
            each.restore(stored, self._serials)
        world = self.simulation.world
        for b, scenario in enumerate(world.scenarios):
            self._names[b] = None if scenario is None else scenario.name
            self._tags[b] = None if scenario is None else scenario.tags
        self.events = world.events()

    def _number(self, rows: Int[np.ndarray, " n"]) -> None:
        """Gives episodes serial numbers, so that forecasts of earlier ones are not shown."""
        self._serials[rows] = self._num_begun + np.arange(len(rows))
        self._num_begun += len(rows)


def _seed_from(rng: np.random.Generator) -> int:
    """A number of 64 bits from the state of a generator, which stays unchanged."""
    state = rng.bit_generator.state["state"]
    bits = state["state"] ^ state["inc"]
    return (bits ^ (bits >> 64)) & (2**64 - 1)


def _events_of(events: Events, rows: Int[np.ndarray, " n"]) -> Events:
    return Events(
        **{field.name: getattr(events, field.name)[rows] for field in dataclasses.fields(events)}
    )


def valid_actions(
    actions: Any, shape: tuple[int, ...], ignored: Bool[np.ndarray, " b"] | None = None
) -> Float[np.ndarray, "*batch 2"]:
    """Checks actions and clips them to [-1, 1].

    Args:
        actions: the actions that the caller passed to `step`.
        shape: the expected shape, (2,) or (B, 2).
        ignored: (B,) mask of rows that may hold anything; they become zeros.

    Returns:
        The actions in float32.

    Raises:
        AspEnvError: the actions have another shape or are not finite.
    """
    expected = "two finite numbers in [-1, 1]"
    if len(shape) > 1:
        expected += f" for each environment, {shape}"
    try:
        values = np.asarray(actions, dtype=np.float64)
    except (TypeError, ValueError):
        raise AspEnvError(f"action {type(actions).__name__}: expected {expected}") from None
    if values.shape != shape:
        raise AspEnvError(f"action of shape {values.shape}: expected {expected}")
    if ignored is not None:
        values = np.where(ignored[:, None], 0.0, values)
    if not np.isfinite(values).all():
        rows = values.reshape(-1, 2)
        invalid = rows[~np.isfinite(rows).all(axis=1)][0]
        raise AspEnvError(f"action {invalid.tolist()}: expected {expected}")
    return np.minimum(np.maximum(values, -1.0), 1.0).astype(np.float32)


class ObservationBuffers:
    """Arrays for observations that are reused once no reference to them is left.

    Allocating a large raster takes as long as drawing it, since the system clears new memory page
    by page. NumPy arrays and tensors that share the memory of an array hold a reference to it, so
    an array without references other than the pool's own can be overwritten.
    """

    _MAX_BUFFERS = 3
    """Two suffice for callers that hold the last observation until they have the next one."""

    def __init__(self, observer: Observer, count: int) -> None:
        """Creates an empty pool of buffers for `count` observations each."""
        self._observer = observer
        self._count = count
        self._buffers: list[Observation] = []
        self._free_count = _count_references([{"": np.empty(0)}], 0, "")

    def take(self) -> Observation:
        """Returns a buffer without other references, or a new one; its content is arbitrary."""
        for number, arrays in enumerate(self._buffers):
            if all(
                _count_references(self._buffers, number, name) == self._free_count
                for name in arrays
            ):
                self._buffers.append(self._buffers.pop(number))
                return dict(arrays)
        fresh = self._observer.allocate(self._count)
        self._buffers.append(fresh)
        del self._buffers[: -self._MAX_BUFFERS]
        return dict(fresh)


def _count_references(buffers: list[Observation], number: int, name: str) -> int:
    """Counts the references to one array, including the one of this call."""
    return sys.getrefcount(buffers[number][name])
