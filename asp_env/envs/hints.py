"""A hint for learners whose observations are large."""

import functools
import logging
import sys
from typing import Any

import numpy as np
from gymnasium import spaces

LARGE_OBSERVATION_BYTES = 200_000
"""Observations beyond this size fill the memory of learners. Chosen by hand: 100,000 are 20 GB."""

LEARNERS = ("stable_baselines3", "torchrl", "ray.rllib", "skrl", "tianshou", "d3rlpy")
"""Packages of learners; one that has been imported is assumed to make the environment."""

_logger = logging.getLogger("asp_env")


def hint_at_large_observations(space: spaces.Space[Any], *, is_vector: bool) -> None:
    """Logs a warning, once per process, if a learner's buffer is about to hold large rasters.

    Args:
        space: the space of one observation.
        is_vector: whether many environments are made at once. A single environment counts only if
            a package of `LEARNERS` has been imported.
    """
    assert isinstance(space, spaces.Dict)
    size = sum(
        int(np.prod(box.shape)) * box.dtype.itemsize
        for box in space.values()
        if box.shape is not None and box.dtype is not None
    )
    if size > LARGE_OBSERVATION_BYTES and (
        is_vector or any(each in sys.modules for each in LEARNERS)
    ):
        _warn_once(size)


@functools.cache
def _warn_once(size: int) -> None:
    _logger.warning(
        "asp_env: an observation has %.2f MB, a replay buffer of a million has %.1f TB. "
        "asp_env/ReplayVectors-v0 and asp_env/ReplayState-v0 have 34 kB and 0.7 kB; "
        "raster_px=(90, 60) makes smaller rasters.",
        size / 1e6,
        size / 1e6,
    )
