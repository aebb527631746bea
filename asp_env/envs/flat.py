"""Observations as vectors: each entry a vector, or all entries in one."""

from collections.abc import Mapping
from typing import Any, Literal

import numpy as np
from gymnasium import spaces
from jaxtyping import Shaped

from asp_env.arguments import shown
from asp_env.errors import AspEnvError

Flatten = bool | Literal["parts"]
"""How observations are flattened.

`False`: entries have their own shapes. `"parts"`: entries are vectors, images stay images. `True`:
the observation is one vector of all entries, in their order.
"""


def flat_space(space: spaces.Space[Any], flatten: Flatten) -> spaces.Space[Any]:
    """Returns the space of flattened observations.

    Args:
        space: a Dict of boxes.
        flatten: how observations are flattened.

    Raises:
        AspEnvError: `flatten` has another value, or the space is no Dict.
    """
    if flatten != "parts" and not isinstance(flatten, bool):
        raise AspEnvError(f"flatten {shown(flatten)}: expected False, True or 'parts'")
    if not isinstance(space, spaces.Dict):
        raise AspEnvError(f"observation space {space}: expected a Dict")
    if flatten == "parts":
        return spaces.Dict([(name, _flat_box(box)) for name, box in space.items()])
    return spaces.flatten_space(space) if flatten else space


def flatten_observations(
    observations: Mapping[str, Shaped[np.ndarray, "b ..."]], flatten: Flatten
) -> Any:
    """Flattens B observations.

    Args:
        observations: the entries by name, each with B as its first axis.
        flatten: how they are flattened.

    Returns:
        The entries by name, or views of them; with `flatten=True` a new array (B, numbers), which
        `gymnasium.spaces.flatten` would return for each observation.
    """
    if not flatten:
        return observations
    if flatten == "parts":
        return {
            name: value if _is_image(value.shape[1:], value.dtype) else _rows(value)
            for name, value in observations.items()
        }
    return np.concatenate([_rows(value) for value in observations.values()], axis=1)


def observation_of(observations: Any, b: int) -> Any:
    """Returns a copy of one of B observations: of a Dict, or of one array.

    Args:
        observations: the entries by name with B as their first axis, or an array (B, numbers).
        b: number of the observation.
    """
    if isinstance(observations, np.ndarray):
        return observations[b].copy()
    return {name: value[b].copy() for name, value in observations.items()}


def _rows(value: Shaped[np.ndarray, "b ..."]) -> Shaped[np.ndarray, "b n"]:
    return value.reshape(len(value), -1)


def _is_image(shape: tuple[int, ...], dtype: np.dtype | None) -> bool:
    return len(shape) == 3 and dtype == np.uint8


def _flat_box(box: spaces.Space[Any]) -> spaces.Space[Any]:
    if not isinstance(box, spaces.Box) or len(box.shape) < 2 or _is_image(box.shape, box.dtype):
        return box
    return spaces.Box(np.ravel(box.low), np.ravel(box.high), dtype=box.low.dtype.type)
