"""Values computed once per road map."""

from collections.abc import Callable
from typing import Generic, TypeVar, final

from asp_env.data.bounded_cache import BoundedCache
from asp_env.data.road_map import RoadMap

DEFAULT_LIMIT_BYTES = 128 * 2**20
"""Memory of one cache. Chosen by hand: what views and rules need of a map has less than 0.2 MB, so
that this covers about 700 maps."""

Value = TypeVar("Value")


@final
class MapCache(Generic[Value]):
    """Caches the latest results of a function of a road map.

    Maps of equal geometry share a result: those of several environments with the same data, and of
    data that are opened again.
    """

    def __init__(
        self, make: Callable[[RoadMap], Value], limit_bytes: int = DEFAULT_LIMIT_BYTES
    ) -> None:
        """Creates an empty cache.

        Args:
            make: the function. Its results must not depend on the name of the map.
            limit_bytes: memory of all results.
        """
        self._make = make
        self.results = BoundedCache[Value](limit_bytes)

    def __call__(self, road_map: RoadMap) -> Value:
        """The value of `make(road_map)`."""
        return self.results.get(road_map.geometry_hash, lambda: self._make(road_map))
