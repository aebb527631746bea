"""Many episodes of `asp_env/Replay-v0` side by side, batched in arrays."""

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import gymnasium
import numpy as np
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from jaxtyping import Bool, Float, Shaped

from asp_env.arguments import shown, whole_number
from asp_env.data.predictor import Predictor
from asp_env.data.recording import DEFAULT_DT_S
from asp_env.data.scenarios.scenario import ScenarioFilter, ScenarioSet
from asp_env.data.scene import Scene
from asp_env.data.snippets import Future
from asp_env.data.source import Recordings
from asp_env.envs.episodes import (
    ObservationBuffers,
    ReplayEpisodes,
    StepResult,
    checked_seed,
    reset_options,
    valid_actions,
)
from asp_env.envs.flat import Flatten, flat_space, flatten_observations, observation_of
from asp_env.envs.forecasts import ForecastSpec, PredictorSpec
from asp_env.envs.hints import hint_at_large_observations
from asp_env.envs.options import ReplayOptions, suggest_options
from asp_env.envs.shared_in_spec import SharedInSpec
from asp_env.errors import AspEnvError
from asp_env.render.frames import draw_frame
from asp_env.render.live import render_fps
from asp_env.sim.observation import Observation
from asp_env.sim.traffic.assignment import TrafficSpec

Infos = dict[str, Any]

MAX_ENVS = 2**20
"""Largest number of environments. Chosen by hand: a million have 20 GB of states."""


@dataclass(frozen=True, slots=True, kw_only=True)
class VectorSnapshot:
    """The whole state of a vector environment; a pickle holds no recordings and no rasters."""

    origin: Mapping[str, Any]
    """What an environment must have in common with this one to restore the snapshot."""
    episodes: Any
    generators: tuple[Mapping[str, Any], ...]
    """States of `np_random`."""
    seeds: tuple[int | None, ...]
    over: Bool[np.ndarray, " n"]


class ReplayVectorEnv(SharedInSpec, VectorEnv[Any, Any, np.ndarray]):  # pyright: ignore[reportIncompatibleVariableOverride]
    """`asp_env/Replay-v0` as a vector environment: one world of arrays for all episodes.

    ## Description
    The environment returns the same bits as Gymnasium's `SyncVectorEnv` over `num_envs` single
    `ReplayEnv`s, in every autoreset mode. Its id is that of the single environment:

    ```python
    import gymnasium, asp_env

    envs = gymnasium.make_vec(
        "asp_env/Replay-v0", num_envs=64, vectorization_mode="vector_entry_point"
    )
    ```

    Returned arrays are never overwritten while they, views of them or tensors on them are
    referenced.

    ## Action Space
    `Box(-1, 1, (num_envs, 2), float32)`: the action of `ReplayEnv` for each environment.

    ## Observation Space
    The `Dict` of `ReplayEnv` with `num_envs` as the first axis of each shape.

    ## Rewards
    Those of `ReplayEnv`, (num_envs,).

    ## Starting State
    As in `ReplayEnv`. Environment i of `reset(seed=s)` has the seed s + i. Options are the same for
    all environments, or lists with a value for each.

    ## Episode End
    As in `ReplayEnv`. `autoreset_mode` decides what happens next, as in Gymnasium: `NextStep`
    resets in the next step, `SameStep` at once, with `final_obs` and `final_info` in the infos, and
    `Disabled` waits for `reset(options={"reset_mask": mask})` with a mask (num_envs,) bool.

    ## Arguments
    `num_envs`, the arguments of `ReplayEnv` (as `render_mode` only `rgb_array`), and
    `autoreset_mode`, by default `NextStep`, and `max_episode_steps`, after which episodes are
    truncated as by Gymnasium's `TimeLimit`.

    ## Version History
    - v0: initial version
    """

    @suggest_options
    def __init__(
        self,
        num_envs: int,
        data: str = "sample:intersection",
        *,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        max_episode_steps: int | None = None,
        flatten: Flatten = False,
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
            AspEnvError: an argument is invalid, or the data hold no scenario.
        """
        num_envs = whole_number("num_envs", num_envs, least=1, most=MAX_ENVS)
        if max_episode_steps is not None:
            whole_number("max_episode_steps", max_episode_steps, least=1)
        if render_mode not in (None, "rgb_array"):
            raise AspEnvError(f"render mode {render_mode!r}: expected rgb_array or None")
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
        self.num_envs = num_envs
        self.autoreset_mode = _parse_autoreset_mode(autoreset_mode)
        self.render_mode = render_mode
        self._episodes = ReplayEpisodes(data, options, num_envs)
        self.metadata = {
            "render_modes": ["rgb_array"],
            "render_fps": render_fps(dt_s * action_repeat),
            "autoreset_mode": self.autoreset_mode,
        }
        self.single_observation_space = flat_space(self._episodes.space, flatten)
        self._flatten: Flatten = flatten
        self._max_episode_steps = max_episode_steps
        hint_at_large_observations(self._episodes.space, is_vector=True)
        self.single_action_space = self._episodes.action_space
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._buffers = ObservationBuffers(self._episodes.observer, num_envs)
        self._generators: list[np.random.Generator | None] = [None] * num_envs
        self._seeds: list[int | None] = [None] * num_envs
        self._begun = np.zeros(num_envs, dtype=bool)
        self._over = np.zeros(num_envs, dtype=bool)

    def reset(
        self,
        *,
        seed: int | Sequence[int | None] | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[Any, Infos]:
        """Starts all episodes, or those of `options["reset_mask"]`.

        Args:
            seed: the seed of the first environment, which the following ones count up from; or one
                seed for each.
            options: `reset_mask`, (num_envs,) bool; the others are those of `ReplayEnv.reset`, for
                all environments or in a list for each.

        Raises:
            AspEnvError: a seed, the mask or an option is invalid.
            gymnasium.error.ResetNeeded: the mask leaves out an episode that has not begun.
        """
        options = reset_options(options)
        seeds = self._seeds_of(seed)
        reset_mask = self._parse_mask(options.pop("reset_mask", None))
        for b, env_seed in enumerate(seeds):
            if reset_mask[b] and env_seed is not None:
                self._generators[b], self._seeds[b] = seeding.np_random(env_seed)
        self._begin(reset_mask, [_options_of(options, b, self.num_envs) for b in self._rows])
        return self._flat(self._observe()), _mask_infos(self._episodes.info(), reset_mask)

    def step(self, actions: Any) -> tuple[Any, np.ndarray, np.ndarray, np.ndarray, Infos]:
        """Steps all episodes by one tick with actions (num_envs, 2), which are clipped to [-1, 1].

        Raises:
            gymnasium.error.ResetNeeded: an episode has not begun, or is over and not reset.
            AspEnvError: the actions have another shape or are not finite.
        """
        if not self._begun.all():
            raise gymnasium.error.ResetNeeded("call reset before step")
        restart = self._over.copy()
        if restart.any() and self.autoreset_mode is not AutoresetMode.NEXT_STEP:
            over = np.flatnonzero(restart).tolist()
            raise gymnasium.error.ResetNeeded(
                f"the episodes {over} are over: reset them with options={{'reset_mask': mask}}"
            )
        result = self._episodes.step(valid_actions(actions, (self.num_envs, 2), restart))
        if self._max_episode_steps is not None:
            is_long = self._episodes.num_steps >= self._max_episode_steps
            result = dataclasses.replace(result, truncated=result.truncated | is_long)
        if self.autoreset_mode is AutoresetMode.SAME_STEP:
            return self._finish_same_step(result)
        if restart.any():
            self._begin(restart, [{}] * self.num_envs)
        stepped = ~restart
        infos = _mask_infos(self._episodes.info(), np.ones_like(restart))
        terminated, truncated = result.terminated & stepped, result.truncated & stepped
        self._over = terminated | truncated
        reward = np.where(stepped, result.reward, 0.0)
        return self._flat(self._observe()), reward, terminated, truncated, infos

    def _finish_same_step(
        self, result: StepResult
    ) -> tuple[Any, np.ndarray, np.ndarray, np.ndarray, Infos]:
        """Resets the finished episodes and moves their last observations to the infos."""
        over = result.terminated | result.truncated
        observation, ended = self._observe(), self._episodes.info()
        if not over.any():
            infos = _mask_infos(ended, ~over)
            flat = self._flat(observation)
            return flat, result.reward, result.terminated, result.truncated, infos
        rows = np.flatnonzero(over)
        last, flat = np.full(self.num_envs, None, dtype=object), self._flat(observation)
        for b in rows.tolist():
            last[b] = observation_of(flat, b)
        self._begin(over, [{}] * self.num_envs)
        for name, value in self._episodes.observe(rows).items():
            observation[name][rows] = value
        infos = _mask_infos({"final_obs": last, "final_info": ended}, over)
        infos |= _mask_infos(self._episodes.info(), np.ones_like(over))
        self._over = np.zeros_like(over)
        flat = self._flat(observation)
        return flat, result.reward, result.terminated, result.truncated, infos

    def scene(self) -> Scene:
        """Returns everything that may be known now; situation i is environment i, its ego slot 0.

        Raises:
            gymnasium.error.ResetNeeded: an episode has not begun.
        """
        self._check_begun()
        return self._episodes.scene()

    def recorded_future(self, scene: Scene, horizon: int) -> Future:
        """Returns the recorded future of a scene's targets, for privileged predictors.

        Args:
            scene: the present scene, possibly with other targets.
            horizon: number of ticks.

        Raises:
            gymnasium.error.ResetNeeded: an episode has not begun.
        """
        self._check_begun()
        return self._episodes.recorded_future(scene, horizon)

    def logged_actions(self) -> Float[np.ndarray, "n 2"]:
        """Returns the action of the logged driver of each environment, see `ReplayEnv`.

        Raises:
            gymnasium.error.ResetNeeded: an episode has not begun.
            AspEnvError: the world has no logged drivers, as highway-env's.
        """
        self._check_begun()
        return self._episodes.logged_actions()[0]

    def logged_actions_clipped(self) -> Bool[np.ndarray, " n"]:
        """Returns a mask of the environments whose `logged_actions()` were clipped.

        Raises:
            gymnasium.error.ResetNeeded: an episode has not begun.
            AspEnvError: the world has no logged drivers, as highway-env's.
        """
        self._check_begun()
        return self._episodes.logged_actions()[1]

    def render(self) -> tuple[Any, ...] | None:
        """Returns the image of each environment, see `ReplayEnv.render`; None without a mode.

        Raises:
            gymnasium.error.ResetNeeded: an episode has not begun.
        """
        if self.render_mode is None:
            return None
        scene, recording = self.scene(), self._episodes.simulation.world.episodes.recording
        return tuple(
            draw_frame(scene, situation=b, background=self.recordings[int(recording[b])].background)
            for b in self._rows
        )

    def snapshot(self) -> VectorSnapshot:
        """Returns the whole state, including those of `np_random`, for `restore`.

        Raises:
            gymnasium.error.ResetNeeded: an episode has not begun.
        """
        self._check_begun()
        return VectorSnapshot(
            origin=self._episodes.origin,
            episodes=self._episodes.snapshot(),
            generators=tuple(each.bit_generator.state for each in self.np_random),
            seeds=tuple(self._seeds),
            over=self._over.copy(),
        )

    def restore(self, snapshot: VectorSnapshot) -> None:
        """Restores a snapshot of this environment or of one made with the same arguments.

        Raises:
            AspEnvError: the snapshot is of an environment with other arguments.
        """
        if not isinstance(snapshot, VectorSnapshot):
            raise AspEnvError(
                f"snapshot {shown(snapshot)}: expected what snapshot() of a ReplayVectorEnv returns"
            )
        self._episodes.check_origin(snapshot.origin)
        self._episodes.restore(snapshot.episodes)
        for generator, state in zip(self.np_random, snapshot.generators, strict=True):
            generator.bit_generator.state = state
        self._seeds = list(snapshot.seeds)
        self._begun[:] = True
        self._over = snapshot.over.copy()

    @property
    def episodes(self) -> ReplayEpisodes:
        """The episodes, for wrappers."""
        return self._episodes

    @property
    def dt_s(self) -> float:
        """Length of a tick in seconds."""
        return self._episodes.simulation.world.dt_s

    @property
    def recordings(self) -> Recordings:
        """The recordings of `data`."""
        return self._episodes.recordings

    @property
    def predictors(self) -> tuple[Predictor, ...]:
        """The predictors whose forecasts are part of the observation."""
        return self._episodes.predictors

    @property
    def scenarios(self) -> ScenarioSet:
        """The scenarios to draw from; others of the same data can be set, for a curriculum."""
        return self._episodes.scenarios

    @scenarios.setter
    def scenarios(self, scenarios: ScenarioSet) -> None:
        self._episodes.draw_from(scenarios)

    @property
    def np_random(self) -> tuple[np.random.Generator, ...]:  # pyright: ignore[reportIncompatibleMethodOverride]
        """The generator of each environment, as in `SyncVectorEnv`."""
        return tuple(self._generator(b) for b in self._rows)

    @property
    def np_random_seed(self) -> tuple[int | None, ...]:  # pyright: ignore[reportIncompatibleMethodOverride]
        """The seed of each environment's generator, as in `SyncVectorEnv`."""
        for b in self._rows:
            self._generator(b)
        return tuple(self._seeds)

    @property
    def _rows(self) -> range:
        return range(self.num_envs)

    def _generator(self, b: int) -> np.random.Generator:
        generator = self._generators[b]
        if generator is None:
            generator, self._seeds[b] = seeding.np_random()
            self._generators[b] = generator
        return generator

    def _begin(self, reset_mask: Bool[np.ndarray, " n"], options: Sequence[dict[str, Any]]) -> None:
        world = self._episodes.simulation.world
        scenarios, rngs = [self.scenarios[0]] * self.num_envs, list(world.rngs)
        for b in np.flatnonzero(reset_mask).tolist():
            scenarios[b], rngs[b] = self._episodes.draw(self._generator(b), options[b])
        self._episodes.begin(scenarios, rngs, reset_mask)
        self._begun |= reset_mask
        self._over &= ~reset_mask

    def _observe(self) -> Observation:
        return self._episodes.observe(out=self._buffers.take())

    def _flat(self, observation: Observation) -> Any:
        return flatten_observations(observation, self._flatten)

    def _check_begun(self) -> None:
        if not self._begun.all():
            raise gymnasium.error.ResetNeeded("call reset first")

    def _seeds_of(self, seed: int | Sequence[int | None] | None) -> list[int | None]:
        if seed is None:
            return [None] * self.num_envs
        if isinstance(seed, str) or not isinstance(seed, Sequence | np.ndarray):
            first = whole_number("seed", seed, least=0)
            return [first + b for b in self._rows]
        if len(seed) != self.num_envs:
            raise AspEnvError(f"{len(seed)} seeds: expected {self.num_envs}, one per environment")
        return [checked_seed(each) for each in seed]

    def _parse_mask(self, mask: Any) -> Bool[np.ndarray, " n"]:
        if mask is None:
            return np.ones(self.num_envs, dtype=bool)
        is_mask = isinstance(mask, np.ndarray) and mask.dtype == np.bool_
        if not (is_mask and mask.shape == (self.num_envs,) and mask.any()):
            raise AspEnvError(
                f"reset_mask {mask!r}: expected a bool array ({self.num_envs},) with a true entry"
            )
        if not (self._begun | mask).all():
            raise gymnasium.error.ResetNeeded("reset all environments before some of them")
        return mask.copy()


def _parse_autoreset_mode(mode: AutoresetMode | str) -> AutoresetMode:
    try:
        return AutoresetMode(mode)
    except ValueError:
        names = ", ".join(each.value for each in AutoresetMode)
        raise AspEnvError(f"autoreset_mode {mode!r}: expected one of {names}") from None


def _options_of(options: dict[str, Any], b: int, num_envs: int) -> dict[str, Any]:
    """Returns the reset options of environment `b`; a list holds one value for each."""
    chosen: dict[str, Any] = {}
    for name, value in options.items():
        if isinstance(value, str) or not isinstance(value, Sequence | np.ndarray):
            chosen[name] = value
        elif len(value) == num_envs:
            chosen[name] = value[b]
        else:
            raise AspEnvError(
                f"reset option {name!r} of {len(value)} values: expected one or {num_envs}"
            )
    return chosen


def _mask_infos(infos: Infos, mask: Bool[np.ndarray, " n"]) -> Infos:
    """Adds the mask of each key as `_key`, as Gymnasium's vector environments do.

    Values outside the mask are zeros, or None for objects. An empty mask gives no infos.
    """
    if not mask.any():
        return {}
    masked: Infos = {}
    for name, value in infos.items():
        is_group = isinstance(value, dict)
        masked[name] = _mask_infos(value, mask) if is_group else _mask_values(value, mask)
        masked[f"_{name}"] = mask.copy()
    return masked


def _mask_values(values: Shaped[np.ndarray, "n ..."], mask: Bool[np.ndarray, " n"]) -> np.ndarray:
    if mask.all():
        return values
    out = np.full(values.shape, None if values.dtype == object else 0, dtype=values.dtype)
    out[mask] = values[mask]
    return out
