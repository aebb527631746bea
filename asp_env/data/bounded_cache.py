"""Caches of arrays that hold no more than a stated amount of memory."""

import dataclasses
from collections import OrderedDict
from collections.abc import Callable, Hashable
from typing import Generic, TypeVar, final

import numpy as np

from asp_env.data.road_map import RoadMap

DEFAULT_LIMIT_BYTES = 128 * 2**20
"""Memory of one cache of maps. Chosen by hand: what views and rules need of a map has less than
0.2 MB, so that this covers about 700 maps."""

Value = TypeVar("Value")


@final
class BoundedCache(Generic[Value]):
    """Holds the latest values whose arrays fit in a number of bytes."""

    def __init__(self, limit_bytes: int) -> None:
        """Creates an empty cache.

        Args:
            limit_bytes: memory of the arrays in all values; above it the least recently used value
                is removed first. The latest value is always kept.
        """
        self._limit_bytes = limit_bytes
        self._entries: OrderedDict[Hashable, tuple[Value, int]] = OrderedDict()
        self.size_bytes = 0
        """Memory of the arrays in all values."""

    def __len__(self) -> int:
        return len(self._entries)

    def get(self, key: Hashable, make: Callable[[], Value]) -> Value:
        """The value of a key, which is made if it is absent.

        Args:
            key: what the value depends on.
            make: makes the value: an array, or tuples and dataclasses that contain arrays.
        """
        if key not in self._entries:
            value = make()
            self._entries[key] = value, size_bytes(value)
            self.size_bytes += self._entries[key][1]
            while len(self._entries) > 1 and self.size_bytes > self._limit_bytes:
                _, (_, removed_bytes) = self._entries.popitem(last=False)
                self.size_bytes -= removed_bytes
        self._entries.move_to_end(key)
        return self._entries[key][0]


def size_bytes(value: object) -> int:
    """Memory of all arrays in a value, which may be nested in tuples, lists and dataclasses."""
    if isinstance(value, np.ndarray):
        return value.nbytes
    if isinstance(value, tuple | list):
        return sum(size_bytes(each) for each in value)
    if dataclasses.is_dataclass(value):
        return sum(size_bytes(getattr(value, each.name)) for each in dataclasses.fields(value))
    return 0


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
