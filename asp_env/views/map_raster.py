"""The boundaries of a road map as straight pieces, ready to be drawn from any pose."""

from collections import OrderedDict

import numpy as np
from jaxtyping import Float

from asp_env.data.road_map import LineType, RoadMap

BOUNDARIES = (LineType.CURB, LineType.SOLID)
"""What a vehicle is not to cross. Dashed and virtual lines are no boundary."""


def boundary_segments(road_map: RoadMap) -> Float[np.ndarray, "segments 4"]:
    """The straight pieces [x, y, x, y] of all curbs and solid lines."""
    pieces = [np.zeros((0, 4))]
    for line, kind in enumerate(road_map.line_types):
        if kind in BOUNDARIES:
            points = road_map.lines[line]
            pieces.append(np.concatenate([points[:-1], points[1:]], axis=1))
    return np.concatenate(pieces)


class BoundaryCache:
    """The boundaries of the maps that were drawn last, each worked out once."""

    def __init__(self, size: int = 64) -> None:
        """Keeps the boundaries of up to `size` maps."""
        self._size = size
        self._entries: OrderedDict[int, tuple[RoadMap, np.ndarray]] = OrderedDict()

    def __call__(self, road_map: RoadMap) -> Float[np.ndarray, "segments 4"]:
        """The boundaries of `road_map`."""
        # The entry holds its map, so an id cannot pass to another map while the entry lives.
        entry = self._entries.get(id(road_map))
        if entry is None:
            entry = (road_map, boundary_segments(road_map))
            self._entries[id(road_map)] = entry
            while len(self._entries) > self._size:
                self._entries.popitem(last=False)
        return entry[1]
