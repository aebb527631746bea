"""Many episodes of `asp_env/Replay-v0` side by side, on arrays all the way."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import gymnasium
import numpy as np
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from jaxtyping import Bool, Shaped

from asp_env.data.scenarios.scenario import ScenarioSet
from asp_env.data.scene import Scene
from asp_env.data.snippets import Future
from asp_env.data.source import Recordings
from asp_env.envs.episodes import Buffers, ReplayEpisodes, StepResult, as_actions
from asp_env.errors import AspEnvError
from asp_env.render.frames import draw_frame
from asp_env.sim.observation import Observation
from asp_env.sim.world import recorded_future

Infos = dict[str, Any]


@dataclass(frozen=True, slots=True, kw_only=True)
class VectorSnapshot:
    """The whole state of a vector environment: picklable, without recordings and pictures."""

    episodes: Any
    generators: tuple[Mapping[str, Any], ...]
    """States of `np_random`."""
    seeds: tuple[int | None, ...]
    over: Bool[np.ndarray, " n"]


class ReplayVectorEnv(VectorEnv[Observation, Any, np.ndarray]):
    """What `SyncVectorEnv` of as many `ReplayEnv`s does, bit for bit, in one world of arrays.

    Made by `gymnasium.make_vec("asp_env/Replay-v0", num_envs=64,
    vectorization_mode="vector_entry_point", …)` with the arguments of `ReplayEnv` and
    `autoreset_mode`: `NextStep`, `SameStep` or `Disabled`.

    Returned arrays are the caller's: they are written again only when nobody holds them.
    """

    def __init__(
        self,
        num_envs: int,
        data: str = "sample:intersection",
        *,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        render_mode: str | None = None,
        **options: Any,
    ) -> None:
        """See the class documentation for the arguments.

        Raises:
            AspEnvError: an argument is not understood, or the data hold no scenario.
        """
        if num_envs < 1:
            raise AspEnvError(f"num_envs {num_envs}: expected at least 1")
        if render_mode not in (None, "rgb_array"):
            raise AspEnvError(f"render mode {render_mode!r}: expected rgb_array or None")
        self.num_envs = num_envs
        self._mode = _autoreset_mode(autoreset_mode)
        self.metadata = {**self.metadata, "autoreset_mode": self._mode}
        self.render_mode = render_mode
        self._episodes = ReplayEpisodes(data, options, num_envs)
        self.single_observation_space = self._episodes.observer.space
        self.single_action_space = self._episodes.action_space
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._buffers = Buffers(self._episodes.observer, num_envs)
        self._generators: list[np.random.Generator | None] = [None] * num_envs
        self._seeds: list[int | None] = [None] * num_envs
        self._begun = np.zeros(num_envs, dtype=bool)
        self._over = np.zeros(num_envs, dtype=bool)

    def reset(
        self,
        *,
        seed: int | Sequence[int | None] | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[Observation, Infos]:
        """Starts all episodes, or those of `options["reset_mask"]`.

        Args:
            seed: of the first environment, the next has the next one; or one for each.
            options: `reset_mask` (num_envs,) bool; the others are those of `ReplayEnv.reset`, for
                all environments or in a list for each.

        Raises:
            AspEnvError: a seed, mask or option does not fit.
            gymnasium.error.ResetNeeded: the mask leaves out an episode that has never begun.
        """
        given = dict(options or {})
        where = self._mask(given.pop("reset_mask", None))
        for b, each in enumerate(self._seeds_of(seed)):
            if where[b] and each is not None:
                self._generators[b], self._seeds[b] = seeding.np_random(each)
        self._begin(where, [_of_env(given, b, self.num_envs) for b in range(self.num_envs)])
        return self._observe(), _masked(self._episodes.info(), where)

    def step(self, actions: Any) -> tuple[Observation, np.ndarray, np.ndarray, np.ndarray, Infos]:
        """One tick of all episodes; actions are moved to the nearest ones in the space.

        What happens to an episode that is over depends on the autoreset mode, as in Gymnasium.

        Raises:
            gymnasium.error.ResetNeeded: an episode has not begun, or is over and not reset.
            AspEnvError: the actions have another shape or are not finite.
        """
        if not self._begun.all():
            raise gymnasium.error.ResetNeeded("call reset before step")
        restart = self._over.copy()
        if restart.any() and self._mode is not AutoresetMode.NEXT_STEP:
            over = np.flatnonzero(restart).tolist()
            raise gymnasium.error.ResetNeeded(
                f"the episodes {over} are over: reset them with options={{'reset_mask': mask}}"
            )
        given = as_actions(actions, (self.num_envs, 2), restart)
        outcome = self._episodes.step(given)
        if self._mode is AutoresetMode.SAME_STEP:
            return self._finish_same_step(outcome)
        if restart.any():
            self._begin(restart, [{}] * self.num_envs)
        stepped = ~restart
        infos = _masked(self._episodes.info(), np.ones_like(restart))
        infos |= _masked(_told(outcome), stepped)
        terminated, truncated = outcome.terminated & stepped, outcome.truncated & stepped
        self._over = terminated | truncated
        reward = np.where(stepped, outcome.reward, 0.0)
        return self._observe(), reward, terminated, truncated, infos

    def _finish_same_step(
        self, outcome: StepResult
    ) -> tuple[Observation, np.ndarray, np.ndarray, np.ndarray, Infos]:
        """Resets what is over at once; what it ended with goes into the infos."""
        over = outcome.terminated | outcome.truncated
        observation, infos = self._observe(), self._episodes.info()
        if not over.any():
            everyone = ~over
            told = _masked(infos, everyone) | _masked(_told(outcome), everyone)
            return observation, outcome.reward, outcome.terminated, outcome.truncated, told
        rows = np.flatnonzero(over)
        last = np.full(self.num_envs, None, dtype=object)
        for b in rows.tolist():
            last[b] = {name: value[b].copy() for name, value in observation.items()}
        final = {"final_obs": last, "final_info": infos | _told(outcome)}
        self._begin(over, [{}] * self.num_envs)
        for name, value in self._episodes.observe(rows).items():
            observation[name][rows] = value
        told = _masked(final, over)
        told |= _masked(self._episodes.info(), np.ones_like(over))
        told |= _masked(_told(outcome), ~over)
        self._over = np.zeros_like(over)
        return observation, outcome.reward, outcome.terminated, outcome.truncated, told

    def scene(self) -> Scene:
        """All that may be known now; situation i is environment i, its ego slot 0.

        Raises:
            gymnasium.error.ResetNeeded: an episode has not begun.
        """
        self._need_begun()
        return self._episodes.simulation.world.scene()

    def recorded_future(self, scene: Scene, horizon: int) -> Future:
        """What the targets of a scene of now went on to do, for privileged predictors alone.

        Raises:
            gymnasium.error.ResetNeeded: no episode has begun.
        """
        self._need_begun()
        return recorded_future(self._episodes.simulation.world, scene, horizon)

    @property
    def dt_s(self) -> float:
        """Length of a tick."""
        return self._episodes.simulation.world.dt_s

    def render(self) -> tuple[Any, ...] | None:
        """What `ReplayEnv.render` returns, of each environment; None without a render mode.

        Raises:
            gymnasium.error.ResetNeeded: an episode has not begun.
        """
        if self.render_mode is None:
            return None
        scene, recording = self.scene(), self._episodes.simulation.world.episodes.recording
        return tuple(
            draw_frame(scene, situation=b, background=self.recordings[int(recording[b])].background)
            for b in range(self.num_envs)
        )

    def snapshot(self) -> VectorSnapshot:
        """The whole state with those of `np_random`, to be handed to `restore`.

        Raises:
            gymnasium.error.ResetNeeded: an episode has not begun.
        """
        self._need_begun()
        return VectorSnapshot(
            episodes=self._episodes.snapshot(),
            generators=tuple(each.bit_generator.state for each in self.np_random),
            seeds=tuple(self._seeds),
            over=self._over.copy(),
        )

    def restore(self, snapshot: VectorSnapshot) -> None:
        """Goes back to a snapshot of this environment or of one made with the same arguments."""
        self._episodes.restore(snapshot.episodes)
        for generator, state in zip(self.np_random, snapshot.generators, strict=True):
            generator.bit_generator.state = state
        self._seeds = list(snapshot.seeds)
        self._begun[:] = True
        self._over = snapshot.over.copy()

    @property
    def recordings(self) -> Recordings:
        """Of DATA."""
        return self._episodes.recordings

    @property
    def scenarios(self) -> ScenarioSet:
        """Those that are drawn from."""
        return self._episodes.scenarios

    @property
    def np_random(self) -> tuple[np.random.Generator, ...]:  # pyright: ignore[reportIncompatibleMethodOverride]
        """The generator of each environment, as of `SyncVectorEnv`."""
        return tuple(self._generator(b) for b in range(self.num_envs))

    @property
    def np_random_seed(self) -> tuple[int | None, ...]:  # pyright: ignore[reportIncompatibleMethodOverride]
        """The seed of each environment's generator, as of `SyncVectorEnv`."""
        for b in range(self.num_envs):
            self._generator(b)
        return tuple(self._seeds)

    def _generator(self, b: int) -> np.random.Generator:
        generator = self._generators[b]
        if generator is None:
            generator, self._seeds[b] = seeding.np_random()
            self._generators[b] = generator
        return generator

    def _begin(self, where: Bool[np.ndarray, " n"], options: Sequence[dict[str, Any]]) -> None:
        world = self._episodes.simulation.world
        scenarios, rngs = [self.scenarios[0]] * self.num_envs, list(world.rngs)
        for b in np.flatnonzero(where).tolist():
            scenarios[b], rngs[b] = self._episodes.draw(self._generator(b), options[b])
        self._episodes.begin(scenarios, rngs, where)
        self._begun |= where
        self._over &= ~where

    def _observe(self) -> Observation:
        return self._episodes.observe(out=self._buffers.take())

    def _need_begun(self) -> None:
        if not self._begun.all():
            raise gymnasium.error.ResetNeeded("call reset first")

    def _seeds_of(self, seed: int | Sequence[int | None] | None) -> list[int | None]:
        if seed is None:
            return [None] * self.num_envs
        if isinstance(seed, int | np.integer):
            return [int(seed) + b for b in range(self.num_envs)]
        if len(seed) != self.num_envs:
            raise AspEnvError(f"{len(seed)} seeds: expected {self.num_envs}, one per environment")
        return list(seed)

    def _mask(self, given: Any) -> Bool[np.ndarray, " n"]:
        if given is None:
            return np.ones(self.num_envs, dtype=bool)
        fits = isinstance(given, np.ndarray) and given.dtype == np.bool_
        if not (fits and given.shape == (self.num_envs,) and given.any()):
            raise AspEnvError(
                f"reset_mask {given!r}: expected a bool array ({self.num_envs},) with a true entry"
            )
        if not (self._begun | given).all():
            raise gymnasium.error.ResetNeeded("reset all environments before some of them")
        return given.copy()


def _autoreset_mode(given: AutoresetMode | str) -> AutoresetMode:
    try:
        return AutoresetMode(given)
    except ValueError:
        names = ", ".join(mode.value for mode in AutoresetMode)
        raise AspEnvError(f"autoreset_mode {given!r}: expected one of {names}") from None


def _of_env(options: dict[str, Any], b: int, num_envs: int) -> dict[str, Any]:
    """The options of one environment; lists hold one value for each."""
    chosen: dict[str, Any] = {}
    for name, value in options.items():
        if not isinstance(value, list | tuple | np.ndarray):
            chosen[name] = value
        elif len(value) == num_envs:
            chosen[name] = value[b]
        else:
            raise AspEnvError(
                f"reset option {name!r} of {len(value)} values: expected one or {num_envs}"
            )
    return chosen


def _told(outcome: StepResult) -> Infos:
    return {"reward_terms": dict(outcome.terms), "ending": outcome.ending}


def _masked(infos: Infos, where: Bool[np.ndarray, " n"]) -> Infos:
    """Infos as Gymnasium's vector environments give them: each with a mask `_key`.

    Where the mask is false there are zeros, or None among objects; what nobody has is left out.
    """
    if not where.any():
        return {}
    out: Infos = {}
    for name, value in infos.items():
        out[name] = _masked(value, where) if isinstance(value, dict) else _only(value, where)
        out[f"_{name}"] = where.copy()
    return out


def _only(value: Shaped[np.ndarray, " n"], where: Bool[np.ndarray, " n"]) -> np.ndarray:
    if where.all():
        return value
    out = np.full(len(value), None if value.dtype == object else 0, dtype=value.dtype)
    out[where] = value[where]
    return out
