"""Observations as vectors: each entry of its own, or all of them in one."""

from collections.abc import Mapping
from typing import Any, Literal

import numpy as np
from gymnasium import spaces
from jaxtyping import Shaped

from asp_env.errors import AspEnvError

Flatten = bool | Literal["parts"]
"""`False`: the entries have their own shapes. `"parts"`: each entry is a vector, images stay images.
`True`: the observation is one float32 vector of all entries, in their order."""


def flat_space(space: spaces.Dict, flatten: Flatten) -> spaces.Space[Any]:
    """Returns the space of flattened observations.

    Args:
        space: a Dict of boxes.
        flatten: how observations are flattened, see `Flatten`.

    Raises:
        AspEnvError: `flatten` is another value, or one vector would hold an image.
    """
    if flatten not in (False, True, "parts"):
        raise AspEnvError(f"flatten {flatten!r}: expected False, True or 'parts'")
    if flatten == "parts":
        return spaces.Dict([(name, _flat_box(box)) for name, box in space.items()])
    if not flatten:
        return space
    if images := [name for name, box in space.items() if _is_image(box)]:
        raise AspEnvError(
            f"flatten=True with {images[0]!r}, which is an image: use flatten='parts', or "
            "observations without a raster, such as ('state', 'route', 'nearest')"
        )
    low, high = (
        np.concatenate([np.ravel(getattr(box, bound)) for box in space.values()])
        for bound in ("low", "high")
    )
    return spaces.Box(low.astype(np.float32), high.astype(np.float32), dtype=np.float32)


def flatten_observations(
    observations: Mapping[str, Shaped[np.ndarray, "b ..."]], flatten: Flatten
) -> Any:
    """Flattens B observations.

    Args:
        observations: the entries by name, each with B as its first axis.
        flatten: how they are flattened, see `Flatten`.

    Returns:
        Views of the entries by name; with `flatten=True` a new float32 array (B, numbers).
    """
    if not flatten:
        return dict(observations)
    if flatten == "parts":
        return {
            name: value if _is_image_array(value) else value.reshape(len(value), -1)
            for name, value in observations.items()
        }
    rows = [value.reshape(len(value), -1) for value in observations.values()]
    return np.concatenate(rows, axis=1, dtype=np.float32)


def _is_image(box: Any) -> bool:
    return len(box.shape) == 3 and box.dtype == np.uint8


def _is_image_array(value: Shaped[np.ndarray, "b ..."]) -> bool:
    return value.ndim == 4 and value.dtype == np.uint8


def _flat_box(box: spaces.Space[Any]) -> spaces.Space[Any]:
    if not isinstance(box, spaces.Box) or len(box.shape) < 2 or _is_image(box):
        return box
    return spaces.Box(np.ravel(box.low), np.ravel(box.high), dtype=box.low.dtype.type)
