"""The core of the environments: episodes side by side, without the conventions of an interface.

`ReplayEpisodes` draws scenarios, steps the simulation, and returns observations, rewards and infos
as arrays with one row per episode. The single, vector and parallel environments build on it.
"""

import dataclasses
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from gymnasium import spaces
from jaxtyping import Bool, Float, Int

from asp_env.arguments import shown, table, whole_number
from asp_env.data.predictor import Predictor
from asp_env.data.recording import ticks
from asp_env.data.scenarios.scenario import (
    MIN_DISTANCE_M,
    MIN_LENGTH_S,
    SHORT_LENGTH_S,
    Scenario,
    ScenarioFilter,
    ScenarioSet,
    short_history,
)
from asp_env.data.scenarios.selection import choose_scenarios, scenario_of
from asp_env.data.scenarios.tags import TAGS
from asp_env.data.scene import EGO, Scene, infer_actions
from asp_env.data.snippets import HISTORY_S, Future
from asp_env.data.source import Recordings, open_readable
from asp_env.envs.compilation import announce_compilation
from asp_env.envs.forecasts import Present, extended_space, forecast_observers
from asp_env.envs.options import ReplayOptions, raster_size
from asp_env.errors import AspEnvError, unknown_name
from asp_env.sim.action_types import (
    check_action_type,
    following_steering,
    from_physical,
    to_physical,
)
from asp_env.sim.log_following import logged_actions
from asp_env.sim.observation import Observation, Observer, ego_context
from asp_env.sim.reward import REWARD_TERMS, reward_terms, weighted_sum, weights_from
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
                f"{recordings.source}: no vehicle covers {MIN_DISTANCE_M:g} m in "
                f"{MIN_LENGTH_S:g} s after {history * dt_s:g} s of history, or in "
                f"{SHORT_LENGTH_S:g} s of short recordings; use other recordings"
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
            ego_id=scenario.ego_id if ego is None else whole_number("ego", ego),
            start_tick=None if start_tick is None else whole_number("start_tick", start_tick),
            dt_s=self.scenarios.dt_s,
            history=self.scenarios.history,
        )

    def _by_key(self, key: Any) -> Scenario:
        if isinstance(key, str):
            return self.scenarios.by_name(key)
        is_whole = isinstance(key, int | np.integer) and not isinstance(key, bool)
        if not (is_whole and 0 <= key < len(self.scenarios)):
            raise AspEnvError(
                f"scenario {shown(key)}: expected 0 to {len(self.scenarios) - 1} for this data, or "
                "a scenario's name"
            )
        return self.scenarios[int(key)]


def reset_options(options: Any) -> dict[str, Any]:
    """Checks the options of a reset.

    Args:
        options: a mapping, or None for none.

    Returns:
        The options, in a dictionary of their own.

    Raises:
        AspEnvError: the options are no mapping.
    """
    if options is None:
        return {}
    return dict(table("options", options, f"some of {', '.join(RESET_OPTIONS)}"))


def checked_seed(seed: Any) -> int | None:
    """Checks the seed of a reset, which Gymnasium expects to be a number of Python.

    Raises:
        AspEnvError: the seed is neither None nor a whole number of at least 0.
    """
    return None if seed is None else whole_number("seed", seed, least=0)


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
    histories = (history, short_history(history, dt_s))
    if abs(scenarios.dt_s - dt_s) > 1e-9 or scenarios.history not in histories:
        raise AspEnvError(
            f"scenarios for {scenarios.history} past ticks of {scenarios.dt_s:g} s: expected "
            f"{history} of {dt_s:g} s"
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class StepResult:
    """Rewards and ends of one step of B episodes; `ReplayEpisodes.info` has the details."""

    reward: Float[np.ndarray, " b"]
    terminated: Bool[np.ndarray, " b"]
    truncated: Bool[np.ndarray, " b"]


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
        announce_compilation()
        history = ticks(HISTORY_S, options.dt_s)
        self.recordings = open_readable(data, dt_s=options.dt_s)
        self._sampler = ScenarioSampler.choose(
            self.recordings, options.scenarios, dt_s=options.dt_s, history=history
        )
        self.scenarios = self._sampler.scenarios
        raster = make_raster_view(options.view, pixels=raster_size(options.raster_px))
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
        self._traffic = _name_of_traffic(options.traffic, kind.traffic)
        check_action_type(options.action_type)
        self._action_type = options.action_type
        self._action_repeat = options.action_repeat
        self._weights = weights_from(options.reward_weights or {})
        self._forecasts = forecast_observers(options.predictor, options.forecast, options.dt_s)
        self.space: spaces.Space[Any] = self.observer.space
        for each in self._forecasts:
            self.space = extended_space(self.space, each.spaces)
        self._num_begun = 0
        """Number of episodes begun or restored so far."""
        self._allocate(num_episodes)
        self.action_space = spaces.Box(-1.0, 1.0, (2,), dtype=np.float32)

    def _allocate(self, num_episodes: int) -> None:
        """Describes episodes that have not begun."""
        self.events: Events | None = None
        self._names = np.full(num_episodes, None, dtype=object)
        self._tags = np.zeros((num_episodes, len(TAGS)), dtype=bool)
        self._return = np.zeros(num_episodes)
        """Sum of the rewards since the start of each episode."""
        self._num_steps = np.zeros(num_episodes, dtype=np.int64)
        self._seeds = np.zeros(num_episodes, dtype=np.uint64)
        self._serials = np.full(num_episodes, -1)
        self._rows = np.arange(num_episodes)
        self._terms = {name: np.zeros(num_episodes) for name in REWARD_TERMS}
        """The unweighted terms of the reward of each episode's last step; zeros at its start."""

    def restrict(self, scenarios: ScenarioSet, num_episodes: int) -> None:
        """Replaces the scenarios to draw from and the number of episodes, and ends all episodes."""
        world = self.simulation.world
        self.draw_from(scenarios)
        self.simulation = Simulation(
            self.recordings,
            self.simulation.driver,
            num_episodes=num_episodes,
            dt_s=world.dt_s,
            history=world.history,
            world_class=type(world),
        )
        self._allocate(num_episodes)

    def draw_from(self, scenarios: ScenarioSet) -> None:
        """Replaces the scenarios to draw from; episodes under way go on.

        Raises:
            AspEnvError: the argument is no set of scenarios, or the set is of other data.
        """
        if not isinstance(scenarios, ScenarioSet):
            raise AspEnvError(f"scenarios {shown(scenarios)}: expected a ScenarioSet")
        world = self.simulation.world
        _check_set(scenarios, self.recordings, dt_s=world.dt_s, history=world.history)
        self.scenarios = scenarios
        self._sampler = dataclasses.replace(self._sampler, scenarios=scenarios)

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
            self._describe(b, scenarios[b])
            self._seeds[b] = _seed_from(rngs[b])
        self._return[reset_mask], self._num_steps[reset_mask] = 0.0, 0
        self._terms = {name: np.where(reset_mask, 0.0, term) for name, term in self._terms.items()}
        self._number(np.flatnonzero(reset_mask))
        self.events = self.simulation.world.events()

    def _describe(self, b: int, scenario: Scenario | None) -> None:
        self._names[b] = None if scenario is None else scenario.name
        self._tags[b] = [scenario is not None and tag in scenario.tags for tag in TAGS]

    def step(self, actions: Float[np.ndarray, "b 2"]) -> StepResult:
        """Steps all episodes by `action_repeat` ticks, or up to the tick at which they end.

        Args:
            actions: the egos' actions of the action type, in [-1, 1].
        """
        terms, after = self._tick(actions)
        endings = ending(after)
        for _ in range(self._action_repeat - 1):
            running = endings == Ending.RUNNING
            if not running.any():
                break
            self.make_forecasts()
            more, later = self._tick(actions)
            terms = {name: terms[name] + value * running for name, value in more.items()}
            self.events = after = _merge_events(later, after, running)
            endings = np.where(running, ending(later), endings)
        reward = weighted_sum(terms, self._weights)
        self._return += reward
        self._num_steps += 1
        self._terms = {name: value.astype(np.float64) for name, value in terms.items()}
        return StepResult(
            reward=reward,
            terminated=_IS_TERMINAL[endings],
            truncated=endings == Ending.OUT_OF_DATA,
        )

    def _tick(
        self, actions: Float[np.ndarray, "b 2"]
    ) -> tuple[dict[str, Float[np.ndarray, " b"]], Events]:
        """Steps by one tick; returns the terms of the reward, and the events after it."""
        world, before = self.simulation.world, self.events
        assert before is not None
        states_before = world.ego_states()
        controlled = np.ones(len(world), dtype=bool)
        self.simulation.step(self.physical_actions(actions), controlled)
        self.events = after = world.events()
        terms = reward_terms(before, after, states_before, world.ego_states(), world.dt_s)
        return terms, after

    @property
    def predictors(self) -> tuple[Predictor, ...]:
        """The predictors whose forecasts are part of the observation."""
        return tuple(each.predictor for each in self._forecasts)

    def physical_actions(self, actions: Float[np.ndarray, "b 2"]) -> Float[np.ndarray, "b 2"]:
        """Converts the egos' actions in [-1, 1] to [acceleration m/s², steering rad]."""
        return to_physical(self._action_type, actions, *self._action_context())

    def actions_from(self, physical: Float[np.ndarray, "b 2"]) -> Float[np.ndarray, "b 2"]:
        """Converts [acceleration m/s², steering rad] to actions, possibly beyond [-1, 1]."""
        return from_physical(self._action_type, physical, *self._action_context())

    def _action_context(self) -> tuple[np.ndarray, np.ndarray, float]:
        """The last actions of the egos, their steering along the route, and the time step."""
        world = self.simulation.world
        episodes, count = world.episodes, len(world)
        last, following = np.zeros((count, 2), dtype=np.float32), np.zeros(count)
        lengths = episodes.sizes[:, EGO, 0]
        if self._action_type == "jerk":
            rows = np.arange(count)
            before = np.stack([episodes.states[rows, world.now - k, EGO] for k in (1, 0)], axis=1)
            seen = np.stack([episodes.valid[rows, world.now - k, EGO] for k in (1, 0)], axis=1)
            last = infer_actions(before, seen, lengths, world.dt_s)[:, 0]
        if self._action_type == "route":
            assert self.events is not None
            following = following_steering(
                world.ego_states(),
                np.maximum(lengths, 0.1),
                episodes.route,
                episodes.route_valid,
                self.events.route_m,
            )
        return last, following, world.dt_s

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

        Raises:
            AspEnvError: an argument is no scene or no number of ticks.
        """
        if not isinstance(scene, Scene):
            raise AspEnvError(f"scene {shown(scene)}: expected a Scene, such as that of scene()")
        whole_number("horizon", horizon, least=1)
        return recorded_future(self.simulation.world, scene, horizon, rows)

    @property
    def num_steps(self) -> Int[np.ndarray, " b"]:
        """Number of steps since the start of each episode."""
        return self._num_steps

    def info(self) -> dict[str, Any]:
        """Returns the present infos in new arrays; keys, shapes and types never change.

        The value of `tags` is (B, tags), that of `reward_terms` a dictionary of arrays (B,), and
        all others are (B,).
        """
        events = self.events
        assert events is not None
        endings = ending(events)
        # An episode has not ended before its first step, even where its goal is at its start.
        endings[events.elapsed == 0] = Ending.RUNNING
        return {
            "scenario": self._names.copy(),
            "tags": self._tags.copy(),
            "tick": events.elapsed.copy(),
            "progress": events.route_m / np.maximum(events.goal_m, 1.0),
            "collision": events.collision,
            "at_fault": events.at_fault,
            "off_road_m": events.off_road_m.astype(np.float64),
            "reward_terms": {name: term.copy() for name, term in self._terms.items()},
            "ending": _ENDING_NAMES[endings],
            "is_success": endings == Ending.GOAL,
            "episode_return": self._return.copy(),
            "episode_length": self._num_steps.copy(),
        }

    def logged_actions(self) -> tuple[Float[np.ndarray, "b 2"], Bool[np.ndarray, " b"]]:
        """Returns the actions of the logged drivers in [-1, 1], and a mask of the clipped ones.

        Raises:
            AspEnvError: the world has no logged drivers.
        """
        physical, clipped = logged_actions(self.simulation.world)
        actions = self.actions_from(physical)
        beyond = (np.abs(actions) > 1.0).any(axis=1)
        return np.clip(actions, -1.0, 1.0), clipped | beyond

    def snapshot(self) -> Any:
        """Returns the whole state for `restore`; it holds no recordings and no rasters."""
        forecasts = [each.snapshot() for each in self._forecasts]
        statistics = self._return.copy(), self._num_steps.copy(), dict(self._terms)
        state = self.simulation.snapshot(), self._seeds.copy(), forecasts, statistics
        return state

    @cached_property
    def origin(self) -> dict[str, Any]:
        """What a snapshot must have in common with these episodes to be restored here."""
        world = self.simulation.world
        return {
            "data": f"of content {self.recordings.data_hash()[:12]}",
            "time step": f"{world.dt_s:g} s",
            "number of episodes": len(self._rows),
            "traffic": self._traffic,
            "action_type": self._action_type,
            "action_repeat": self._action_repeat,
            "predictors": ", ".join(each.name for each in self.predictors) or "none",
        }

    def check_origin(self, origin: Mapping[str, Any]) -> None:
        """Checks what a snapshot comes from.

        Raises:
            AspEnvError: it is of other data, of another time step, number of episodes or action.
        """
        for name, expected in self.origin.items():
            if origin.get(name) != expected:
                raise AspEnvError(
                    f"the snapshot is of an environment with {name} {origin.get(name)}, expected "
                    f"{expected}; restore it in an environment with the same arguments"
                )

    def restore(self, snapshot: Any) -> None:
        """Restores the state of a snapshot of these episodes, see `check_origin`, bit for bit."""
        simulation, seeds, forecasts, (returns, num_steps, terms) = snapshot
        self.simulation.restore(simulation)
        self._return, self._num_steps = returns.copy(), num_steps.copy()
        self._terms = dict(terms)
        self._seeds = seeds.copy()
        self._number(self._rows)
        for each, stored in zip(self._forecasts, forecasts, strict=True):
            each.restore(stored, self._serials)
        world = self.simulation.world
        for b, scenario in enumerate(world.scenarios):
            self._describe(b, scenario)
        self.events = world.events()

    def _number(self, rows: Int[np.ndarray, " n"]) -> None:
        """Gives episodes serial numbers, so that forecasts of earlier ones are not shown."""
        self._serials[rows] = self._num_begun + np.arange(len(rows))
        self._num_begun += len(rows)


def _name_of_traffic(spec: Any, default: str) -> str:
    """The traffic in words, to compare environments: drivers by name, or by class."""
    if isinstance(spec, Mapping):
        names = (f"{key}={_name_of_traffic(each, default)}" for key, each in spec.items())
        return ",".join(sorted(names))
    return spec if isinstance(spec, str) else default if spec is None else type(spec).__name__


def _seed_from(rng: np.random.Generator) -> int:
    """A number of 64 bits from the state of a generator, which stays unchanged."""
    state = rng.bit_generator.state["state"]
    bits = state["state"] ^ state["inc"]
    return (bits ^ (bits >> 64)) & (2**64 - 1)


def _merge_events(new: Events, old: Events, rows: Bool[np.ndarray, " b"]) -> Events:
    """The new events in the rows of a mask, the old ones in the others."""
    merged = {}
    for field in dataclasses.fields(Events):
        left, right = getattr(new, field.name), getattr(old, field.name)
        merged[field.name] = np.where(rows.reshape(-1, *[1] * (left.ndim - 1)), left, right)
    return Events(**merged)


def info_of(infos: Mapping[str, Any], b: int) -> dict[str, Any]:
    """Returns the info of one episode of `ReplayEpisodes.info`, with numbers as Python's own.

    Args:
        infos: the infos of all episodes.
        b: number of the episode.
    """
    info: dict[str, Any] = {}
    for name, values in infos.items():
        if isinstance(values, Mapping):
            info[name] = info_of(values, b)
        else:
            info[name] = values[b].copy() if values.ndim > 1 else values.tolist()[b]
    return info


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
    except (TypeError, ValueError, OverflowError):
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
