"""Policies without a network, the baselines of every comparison of trained policies."""

from collections.abc import Mapping

import numpy as np


def zero_actions(observations: Mapping[str, np.ndarray], starts: np.ndarray | None) -> np.ndarray:
    """Zeros (B, 2): with the action type `route`, coasting along the route."""
    del starts
    return np.zeros((len(observations["state"]), 2), dtype=np.float32)


class RandomActions:
    """Uniform actions in [-1, 1]."""

    def __init__(self, seed: int) -> None:
        """Seeds the generator."""
        self._rng = np.random.default_rng(seed)

    def __call__(
        self, observations: Mapping[str, np.ndarray], starts: np.ndarray | None
    ) -> np.ndarray:
        """Actions (B, 2)."""
        del starts
        return self._rng.uniform(-1.0, 1.0, (len(observations["state"]), 2)).astype(np.float32)
