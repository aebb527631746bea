"""Vector environments as stable-baselines3 takes them. Imported only by those who have it."""

import warnings
from collections.abc import Sequence
from typing import Any

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from stable_baselines3.common.vec_env import VecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices, VecEnvStepReturn

from asp_env.data.scene import Scene
from asp_env.errors import AspEnvError

Infos = list[dict[str, Any]]
Observations = dict[str, np.ndarray]

_OF_EACH = ("np_random", "np_random_seed")
_SINGLE = ("observation_space", "action_space")


class ReplayVecEnv(VecEnv):
    """A `VecEnv` that hands the arrays of a vector environment straight through.

    What it returns is what `DummyVecEnv` of as many single environments returns, seed by seed.
    """

    def __init__(self, envs: VectorEnv) -> None:
        """Takes over `asp_env/Replay-v0` as made by `gymnasium.make_vec`, possibly in wrappers.

        Raises:
            AspEnvError: it was made with an autoreset mode other than `SameStep` and `Disabled`.
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

    def reset(self) -> Observations:
        """Starts all episodes with the seeds and options that were set, which are then used up."""
        names = {name for options in self._options for name in options}
        options = {name: [each.get(name) for each in self._options] for name in names}
        observations, infos = self.envs.reset(seed=self._seeds, options=options)  # pyright: ignore[reportArgumentType]
        self.reset_infos = _by_member(infos, self.num_envs)
        self._reset_seeds()
        self._reset_options()
        return observations

    def step_async(self, actions: np.ndarray) -> None:
        """Keeps the actions until `step_wait`."""
        self._actions = actions

    def step_wait(self) -> VecEnvStepReturn:
        """One tick; what is over begins anew and tells its `terminal_observation`."""
        observations, rewards, terminated, truncated, told = self.envs.step(self._actions)
        over = terminated | truncated
        infos = _by_member(told, self.num_envs)
        limits = (truncated & ~terminated).tolist()
        if over.any():
            observations = self._restart(observations, over, infos)
        for info, limit in zip(infos, limits, strict=True):
            info["TimeLimit.truncated"] = limit
        return observations, rewards.astype(np.float32), over, infos

    def _restart(self, observations: Observations, over: np.ndarray, infos: Infos) -> Observations:
        """Puts last observations and infos where they belong; returns what is seen next."""
        rows = np.flatnonzero(over).tolist()
        if self._mode is AutoresetMode.SAME_STEP:
            for b in rows:
                last, ended = infos[b].pop("final_obs"), infos[b].pop("final_info")
                self.reset_infos[b], infos[b] = infos[b], ended | {"terminal_observation": last}
            return observations
        for b in rows:
            last = {name: value[b].copy() for name, value in observations.items()}
            infos[b]["terminal_observation"] = last
        observations, begun = self.envs.reset(options={"reset_mask": over})
        each = _by_member(begun, self.num_envs)
        for b in rows:
            self.reset_infos[b] = each[b]
        return observations

    def close(self) -> None:
        """Closes the vector environment."""
        self.envs.close()

    def get_images(self) -> Sequence[np.ndarray | None]:
        """A picture of each environment in mode `rgb_array`."""
        if self.render_mode != "rgb_array":
            warnings.warn(
                f"render mode {self.render_mode}: make the environment with "
                "render_mode='rgb_array' to get pictures",
                stacklevel=2,
            )
            return [None] * self.num_envs
        pictures: Any = self.envs.render()
        return list(pictures)

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        """An attribute of each environment; what is one for all is shared.

        Raises:
            AttributeError: they have none of that name, or it is a method.
        """
        chosen = self._get_indices(indices)
        if attr_name in _OF_EACH:
            of_each = self._of_all(attr_name)
            return [of_each[b] for b in chosen]
        found = self._of_all(f"single_{attr_name}" if attr_name in _SINGLE else attr_name)
        if callable(found):
            raise AttributeError(f"{attr_name} is a method: call it by env_method")
        return [found for _ in chosen]

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        """Sets an attribute of all environments, which share it.

        Raises:
            AspEnvError: only some environments are named.
        """
        if len(list(self._get_indices(indices))) < self.num_envs:
            raise AspEnvError(f"attribute {attr_name}: is one for all environments, not for some")
        setattr(self.envs.unwrapped, attr_name, value)

    def env_method(
        self,
        method_name: str,
        *method_args: Any,
        indices: VecEnvIndices = None,
        **method_kwargs: Any,
    ) -> list[Any]:
        """What `scene` or `render` returns of each environment.

        Raises:
            AttributeError: one environment alone has no such method.
        """
        if method_name not in ("scene", "render") or method_args or method_kwargs:
            raise AttributeError(
                f"method {method_name}: one environment alone has scene() and render()"
            )
        chosen = list(self._get_indices(indices))
        if method_name == "scene":
            scene: Scene = self._of_all("scene")()
            return [scene.situation(b) for b in chosen]
        pictures: Any = self.envs.render()
        return [None if pictures is None else pictures[b] for b in chosen]

    def env_is_wrapped(
        self, wrapper_class: type[gymnasium.Wrapper], indices: VecEnvIndices = None
    ) -> list[bool]:
        """Wrappers of single environments are around none."""
        del wrapper_class
        return [False for _ in self._get_indices(indices)]

    def _of_all(self, name: str) -> Any:
        """An attribute of the vector environment or of what its wrappers wrap."""
        layer: Any = self.envs
        while not hasattr(layer, name) and layer is not layer.unwrapped:
            layer = layer.env
        return getattr(layer, name)


def _by_member(infos: dict[str, Any], count: int) -> Infos:
    """Infos of Gymnasium's vector environments as one dictionary of plain values for each."""
    each: Infos = [{} for _ in range(count)]
    for name, mask in infos.items():
        if not name.startswith("_"):
            continue
        values = infos[name[1:]]
        plain = _by_member(values, count) if isinstance(values, dict) else values.tolist()
        for b in np.flatnonzero(mask).tolist():
            each[b][name[1:]] = plain[b]
    return each
