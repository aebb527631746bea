"""Observations as stable-baselines3 likes them."""

from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces


class FlatParts(gymnasium.ObservationWrapper[dict[str, Any], Any, dict[str, Any]]):
    """Makes a vector of every table among the parts of a Dict; images and vectors stay.

    stable-baselines3's `check_env` warns of tables such as the action history, (15, 2); behind this
    wrapper it is a vector, (30,), time by time. Agents, lines, their masks and the route likewise.
    """

    def __init__(self, env: gymnasium.Env[dict[str, Any], Any]) -> None:
        """Wraps an environment whose observations are a Dict of boxes."""
        super().__init__(env)
        parts = env.observation_space
        assert isinstance(parts, spaces.Dict)
        self.observation_space = spaces.Dict({name: _flat(box) for name, box in parts.items()})

    def observation(self, observation: dict[str, Any]) -> dict[str, Any]:
        """The same numbers in the shapes of this wrapper's space."""
        parts = self.observation_space
        assert isinstance(parts, spaces.Dict)
        return {name: value.reshape(parts[name].shape) for name, value in observation.items()}


def _flat(box: spaces.Space[Any]) -> spaces.Space[Any]:
    if not isinstance(box, spaces.Box) or len(box.shape) < 2:
        return box
    if len(box.shape) == 3 and box.dtype == np.uint8:
        return box
    return spaces.Box(np.ravel(box.low), np.ravel(box.high), dtype=box.low.dtype.type)
