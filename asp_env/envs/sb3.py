"""Vector environments for stable-baselines3. Importing this module imports stable-baselines3."""

import warnings
from collections.abc import Mapping, Sequence
from typing import Any

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from stable_baselines3.common.vec_env import VecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices, VecEnvStepReturn

from asp_env.arguments import shown
from asp_env.data.scene import Scene
from asp_env.envs.episodes import checked_seed
from asp_env.envs.flat import observation_of
from asp_env.errors import AspEnvError

Infos = list[dict[str, Any]]
Observations = Any
"""A dict of arrays, or one array."""

_PER_ENVIRONMENT = ("np_random", "np_random_seed")
_SINGLE = ("observation_space", "action_space")
_BATCHED_METHODS = {
    "logged_action": "logged_actions",
    "logged_action_clipped": "logged_actions_clipped",
}
"""Methods of a single environment, and those that return an array for all environments."""


class ReplayVecEnv(VecEnv):
    """Adapts a `ReplayVectorEnv` to the `VecEnv` of stable-baselines3 without copying arrays.

    It returns the same bits as `DummyVecEnv` over single environments with the same seeds.
    """

    def __init__(self, envs: VectorEnv) -> None:
        """Wraps a vector environment.

        Args:
            envs: a `ReplayVectorEnv`; in wrappers it needs `autoreset_mode="Disabled"`.

        Raises:
            AspEnvError: the autoreset mode is neither `SameStep` nor `Disabled`.
        """
        self._mode = envs.metadata.get("autoreset_mode")
        if self._mode not in (AutoresetMode.SAME_STEP, AutoresetMode.DISABLED):
            raise AspEnvError(
                f"autoreset_mode {self._mode}: stable-baselines3 needs autoreset_mode='SameStep', "
                "or 'Disabled' in wrappers"
            )
        self.envs = envs
        self._actions = np.zeros((envs.num_envs, 2), dtype=np.float32)
        super().__init__(envs.num_envs, envs.single_observation_space, envs.single_action_space)
        # `VecVideoRecorder` takes its frame rate from here.
        self.metadata = {
            name: value for name, value in envs.metadata.items() if name.startswith("render_")
        }

    def reset(self) -> Observations:
        """Starts all episodes with the seeds and options that were set, and clears these.

        Raises:
            AspEnvError: the options are neither a mapping nor one for each environment.
        """
        is_one_each = isinstance(self._options, Sequence) and len(self._options) == self.num_envs
        if not is_one_each or not all(isinstance(each, Mapping) for each in self._options):
            raise AspEnvError(
                f"options {shown(self._options)}: expected one mapping, or a list with one for "
                f"each of the {self.num_envs} environments"
            )
        names = {name for options in self._options for name in options}
        options = {name: [each.get(name) for each in self._options] for name in names}
        observations, infos = self.envs.reset(seed=self._seeds, options=options)  # pyright: ignore[reportArgumentType]
        self.reset_infos = _unbatch_infos(infos, self.num_envs)
        self._reset_seeds()
        self._reset_options()
        return observations

    def seed(self, seed: int | None = None) -> Sequence[int | None]:
        """Sets the seeds of the next reset, as of all environments of stable-baselines3.

        Raises:
            AspEnvError: the seed is no whole number of at least 0.
        """
        return super().seed(checked_seed(seed))

    def step_async(self, actions: np.ndarray) -> None:
        """Stores the actions for `step_wait`."""
        self._actions = actions

    def step_wait(self) -> VecEnvStepReturn:
        """Steps by one tick; finished episodes restart and report a `terminal_observation`."""
        observations, rewards, terminated, truncated, batched = self.envs.step(self._actions)
        over = terminated | truncated
        infos = _unbatch_infos(batched, self.num_envs)
        limits = (truncated & ~terminated).tolist()
        if over.any():
            observations = self._restart(observations, over, infos)
        for info, limit in zip(infos, limits, strict=True):
            info["TimeLimit.truncated"] = limit
        for b in np.flatnonzero(over).tolist():
            infos[b]["episode"] = {"r": infos[b]["episode_return"], "l": infos[b]["episode_length"]}
        return observations, rewards.astype(np.float32), over, infos

    def _restart(self, observations: Observations, over: np.ndarray, infos: Infos) -> Observations:
        """Moves last observations to the infos; returns the first ones of the next episodes."""
        rows = np.flatnonzero(over).tolist()
        if self._mode is AutoresetMode.SAME_STEP:
            for b in rows:
                last, ended = infos[b].pop("final_obs"), infos[b].pop("final_info")
                self.reset_infos[b], infos[b] = infos[b], ended | {"terminal_observation": last}
            return observations
        for b in rows:
            infos[b]["terminal_observation"] = observation_of(observations, b)
        observations, batched = self.envs.reset(options={"reset_mask": over})
        reset_infos = _unbatch_infos(batched, self.num_envs)
        for b in rows:
            self.reset_infos[b] = reset_infos[b]
        return observations

    def close(self) -> None:
        """Closes the vector environment."""
        self.envs.close()

    def get_images(self) -> Sequence[np.ndarray | None]:
        """Returns an image of each environment in mode `rgb_array`."""
        if self.render_mode != "rgb_array":
            warnings.warn(
                f"render mode {self.render_mode}: make the environment with "
                "render_mode='rgb_array' to get images",
                stacklevel=2,
            )
            return [None] * self.num_envs
        images: Any = self.envs.render()
        return list(images)

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        """Returns an attribute of each environment; all share one object for most attributes.

        Raises:
            AttributeError: there is no such attribute, or it is a method.
        """
        rows = self._get_indices(indices)
        if attr_name in _PER_ENVIRONMENT:
            values = self._find_attribute(attr_name)
            return [values[b] for b in rows]
        value = self._find_attribute(f"single_{attr_name}" if attr_name in _SINGLE else attr_name)
        if callable(value):
            raise AttributeError(f"{attr_name} is a method: call it with env_method")
        return [value for _ in rows]

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        """Sets an attribute that all environments share.

        Raises:
            AspEnvError: `indices` leaves environments out.
        """
        if len(list(self._get_indices(indices))) < self.num_envs:
            raise AspEnvError(
                f"attribute {attr_name}: all environments share it; it cannot be set for some"
            )
        setattr(self.envs.unwrapped, attr_name, value)

    def env_method(
        self,
        method_name: str,
        *method_args: Any,
        indices: VecEnvIndices = None,
        **method_kwargs: Any,
    ) -> list[Any]:
        """Calls a method of each environment.

        Raises:
            AttributeError: the method is none of `scene`, `render`, `logged_action` and
                `logged_action_clipped`, or has arguments.
        """
        known = ("scene", "render", *_BATCHED_METHODS)
        if method_name not in known or method_args or method_kwargs:
            raise AttributeError(
                f"method {method_name}: expected one of {', '.join(known)}, without arguments"
            )
        rows = list(self._get_indices(indices))
        if method_name in _BATCHED_METHODS:
            values: np.ndarray = self._find_attribute(_BATCHED_METHODS[method_name])()
            return [values[b] for b in rows]
        if method_name == "scene":
            scene: Scene = self._find_attribute("scene")()
            return [scene.situation(b) for b in rows]
        images: Any = self.envs.render()
        return [None if images is None else images[b] for b in rows]

    def env_is_wrapped(
        self, wrapper_class: type[gymnasium.Wrapper], indices: VecEnvIndices = None
    ) -> list[bool]:
        """Returns False for each environment: wrappers of single environments do not apply."""
        del wrapper_class
        return [False for _ in self._get_indices(indices)]

    def _find_attribute(self, name: str) -> Any:
        """Returns an attribute of the outermost layer of wrappers that has it."""
        layer: Any = self.envs
        while not hasattr(layer, name) and layer is not layer.unwrapped:
            layer = layer.env
        return getattr(layer, name)


def _unbatch_infos(infos: dict[str, Any], count: int) -> Infos:
    """Converts infos of Gymnasium's vector environments to a dictionary for each environment."""
    unbatched: Infos = [{} for _ in range(count)]
    for name, mask in infos.items():
        if not name.startswith("_"):
            continue
        values = infos[name[1:]]
        if isinstance(values, dict):
            plain = _unbatch_infos(values, count)
        else:
            plain = list(values) if values.ndim > 1 else values.tolist()
        for b in np.flatnonzero(mask).tolist():
            unbatched[b][name[1:]] = plain[b]
    return unbatched
