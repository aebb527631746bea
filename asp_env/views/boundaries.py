"""The lines of a road map as straight pieces, ready to be drawn from any pose."""

from collections import OrderedDict
from collections.abc import Callable, Collection
from typing import Generic, TypeVar

import numpy as np
from jaxtyping import Float

from asp_env.data.road_map import LineType, RoadMap

Drawn = TypeVar("Drawn")

BOUNDARIES = (LineType.CURB, LineType.SOLID)
"""What a vehicle is not to cross. Dashed and virtual lines are no boundary."""

BOUNDARY_WIDTH_M = 0.3

TOLERANCE_M = 0.05
"""Points that lie this near to a straight piece are left out: a quarter of a pixel of 0.2 m."""


def boundary_pieces(
    road_map: RoadMap, kinds: Collection[LineType] = BOUNDARIES
) -> Float[np.ndarray, "pieces 5"]:
    """The straight pieces of all lines of some kinds: all curbs and solid lines by default.

    Returns:
        Rows [x, y, cos, sin, half length] of the middle, the direction and the extent; metres.
    """
    pieces = [np.zeros((0, 4))]
    for line, kind in enumerate(road_map.line_types):
        if kind in kinds:
            points = _thinned(road_map.lines[line])
            pieces.append(np.concatenate([points[:-1], points[1:]], axis=1))
    ends = np.concatenate(pieces)
    middle, along = 0.5 * (ends[:, :2] + ends[:, 2:]), ends[:, 2:] - ends[:, :2]
    length = np.hypot(along[:, 0], along[:, 1])[:, None]
    keep = length[:, 0] > 0
    return np.concatenate([middle, along / np.maximum(length, 1e-9), 0.5 * length], axis=1)[keep]


def _thinned(points: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "m 2"]:
    """The line without the points that it hardly needs (Douglas and Peucker)."""
    if len(points) < 3:
        return points
    keep = {0, len(points) - 1}
    spans = [(0, len(points) - 1)]
    while spans:
        first, last = spans.pop()
        if last - first < 2:
            continue
        start, along = points[first], points[last] - points[first]
        offsets = points[first + 1 : last] - start
        share = np.clip(offsets @ along / max(float(along @ along), 1e-12), 0, 1)
        distances = np.hypot(*(offsets - share[:, None] * along).T)
        farthest = int(distances.argmax())
        if distances[farthest] > TOLERANCE_M:
            middle = first + 1 + farthest
            keep.add(middle)
            spans += [(first, middle), (middle, last)]
    return points[sorted(keep)]


class MapCache(Generic[Drawn]):
    """What was made of the maps that were drawn last, of each once."""

    def __init__(self, make: Callable[[RoadMap], Drawn], size: int = 512) -> None:
        """Keeps what `make` gives for up to `size` maps."""
        self._make = make
        self._size = size
        self._entries: OrderedDict[int, tuple[RoadMap, Drawn]] = OrderedDict()

    def __call__(self, road_map: RoadMap) -> Drawn:
        """What `make` gives for `road_map`."""
        # The entry holds its map, so an id cannot pass to another map while the entry lives.
        entry = self._entries.get(id(road_map))
        if entry is None:
            entry = (road_map, self._make(road_map))
            self._entries[id(road_map)] = entry
            while len(self._entries) > self._size:
                self._entries.popitem(last=False)
        return entry[1]
