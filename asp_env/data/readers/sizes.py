"""Sizes of agents: default footprints where files have none, and units that cannot be right."""

import numpy as np
from jaxtyping import Float, Int

from asp_env.data.classes import FOOTPRINTS_M, is_predicted
from asp_env.errors import DataError

LENGTHS_M = (1.0, 40.0)
"""The median length of the vehicles of a recording lies in this range. Chosen by hand."""

SMALLEST_M = 0.001
"""A smaller length or width is unknown: no road user has it."""

WIDTHS_M = (0.4, 5.0)
"""The median width of the vehicles of a recording lies in this range. Chosen by hand: cars of
5.9 feet are outside."""


def with_footprints(
    sizes: Float[np.ndarray, "tracks 2"],
    classes: Int[np.ndarray, " tracks"],
    source: str,
    repairs: list[str],
) -> Float[np.ndarray, "tracks 2"]:
    """Sizes, with the default footprint of the class where length or width is below `SMALLEST_M`.

    Args:
        sizes: length and width of the file, m; NaN or not positive where they are unknown.
        classes: `AgentClass` of each track.
        source: the file, for error messages.
        repairs: a line is added about vehicles without a size; other road users usually have none.

    Raises:
        DataError: length and width of most vehicles are exchanged, or in another unit.
    """
    known = np.asarray((sizes >= SMALLEST_M).all(axis=-1))
    vehicles = is_predicted(classes)
    _check(sizes[known & vehicles], source)
    unknown = int((vehicles & ~known).sum())
    if unknown:
        repairs.append(
            f"{unknown} of {int(vehicles.sum())} vehicles have no length or width: they have the "
            "footprint of their class"
        )
    return np.where(known[:, None], sizes, FOOTPRINTS_M[classes]).astype(np.float32)


def _check(sizes: Float[np.ndarray, "vehicles 2"], source: str) -> None:
    if not len(sizes):
        return
    exchanged = int((sizes[:, 0] < sizes[:, 1]).sum())
    if 2 * exchanged > len(sizes):
        raise DataError(
            f"{source}: {exchanged} of {len(sizes)} vehicles are wider than long, expected length "
            "along the heading: exchange the names of the columns length and width"
        )
    length, width = np.median(sizes, axis=0).tolist()
    for name, value, (low, high) in (("length", length, LENGTHS_M), ("width", width, WIDTHS_M)):
        if not low <= value <= high:
            raise DataError(
                f"{source}: the median {name} of {len(sizes)} vehicles is {value:.3g}, expected "
                f"{low:g} to {high:g} metres: convert length and width to metres"
            )
