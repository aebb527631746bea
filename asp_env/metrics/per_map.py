"""What is worked out once per map and kept while the map is in use."""

from collections import OrderedDict
from collections.abc import Callable
from typing import Generic, TypeVar, final

from asp_env.data.road_map import RoadMap

KEPT = 32

T = TypeVar("T")


@final
class PerMap(Generic[T]):
    """A function of a map whose latest results are kept, told apart by the map's identity."""

    def __init__(self, make: Callable[[RoadMap], T]) -> None:
        """Nothing is worked out yet."""
        self._make = make
        self._made: OrderedDict[int, tuple[RoadMap, T]] = OrderedDict()

    def __call__(self, road_map: RoadMap) -> T:
        """What `make` says of the map."""
        key = id(road_map)  # the map is kept too, so that its identity stays its own
        if key not in self._made:
            self._made[key] = (road_map, self._make(road_map))
            while len(self._made) > KEPT:
                self._made.popitem(last=False)
        self._made.move_to_end(key)
        return self._made[key][1]
