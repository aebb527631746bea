"""The boundaries of a road map as straight pieces, ready to be drawn from any pose."""

from collections import OrderedDict

import numpy as np
from jaxtyping import Float

from asp_env.data.road_map import LineType, RoadMap

BOUNDARIES = (LineType.CURB, LineType.SOLID)
"""What a vehicle is not to cross. Dashed and virtual lines are no boundary."""


def boundary_pieces(road_map: RoadMap) -> Float[np.ndarray, "pieces 5"]:
    """The straight pieces of all curbs and solid lines.

    Returns:
        Rows [x, y, cos, sin, half length] of the middle, the direction and the extent; metres.
    """
    pieces = [np.zeros((0, 4))]
    for line, kind in enumerate(road_map.line_types):
        if kind in BOUNDARIES:
            points = road_map.lines[line]
            pieces.append(np.concatenate([points[:-1], points[1:]], axis=1))
    ends = np.concatenate(pieces)
    middle, along = 0.5 * (ends[:, :2] + ends[:, 2:]), ends[:, 2:] - ends[:, :2]
    length = np.hypot(along[:, 0], along[:, 1])[:, None]
    keep = length[:, 0] > 0
    return np.concatenate([middle, along / np.maximum(length, 1e-9), 0.5 * length], axis=1)[keep]


class BoundaryCache:
    """The boundaries of the maps that were drawn last, each worked out once."""

    def __init__(self, size: int = 64) -> None:
        """Keeps the boundaries of up to `size` maps."""
        self._size = size
        self._entries: OrderedDict[int, tuple[RoadMap, np.ndarray]] = OrderedDict()

    def __call__(self, road_map: RoadMap) -> Float[np.ndarray, "pieces 5"]:
        """The boundaries of `road_map`."""
        # The entry holds its map, so an id cannot pass to another map while the entry lives.
        entry = self._entries.get(id(road_map))
        if entry is None:
            entry = (road_map, boundary_pieces(road_map))
            self._entries[id(road_map)] = entry
            while len(self._entries) > self._size:
                self._entries.popitem(last=False)
        return entry[1]
