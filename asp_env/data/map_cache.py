"""Values computed once per road map, within a stated amount of memory."""

import dataclasses
import weakref
from collections import OrderedDict
from collections.abc import Callable
from functools import partial
from typing import Any, Generic, NamedTuple, TypeVar, final

import numpy as np

from asp_env.data.road_map import RoadMap

DEFAULT_LIMIT_BYTES = 128 * 2**20
"""Memory of the arrays of one cache. Chosen by hand: what views and rules need of a map has less
than 0.2 MB, so that this covers about 700 maps."""

Value = TypeVar("Value")


class _Entry(NamedTuple, Generic[Value]):
    road_map: "weakref.ref[RoadMap]"
    value: Value
    size_bytes: int


@final
class MapCache(Generic[Value]):
    """Caches the latest results of a function of a road map, by the identity of the map.

    A result is removed as soon as nothing else refers to its map.
    """

    def __init__(
        self, make: Callable[[RoadMap], Value], limit_bytes: int = DEFAULT_LIMIT_BYTES
    ) -> None:
        """Creates an empty cache.

        Args:
            make: the function. Its results must not refer to the map.
            limit_bytes: memory of the arrays in all results; above it the least recently used
                result is removed first. The latest result is always kept.
        """
        self._make = make
        self._limit_bytes = limit_bytes
        self._entries: OrderedDict[int, _Entry[Value]] = OrderedDict()
        self.size_bytes = 0
        """Memory of the arrays in all results."""

    def __len__(self) -> int:
        return len(self._entries)

    def __call__(self, road_map: RoadMap) -> Value:
        """The value of `make(road_map)`."""
        key = id(road_map)
        entry = self._entries.get(key)
        if entry is None:
            value = self._make(road_map)
            # A result is removed before another map can get the id. The callback must not refer to
            # the cache itself, which would become part of a cycle.
            removed = weakref.ref(road_map, partial(_remove, weakref.ref(self), key))
            entry = _Entry(removed, value, _size_bytes(value))
            self._entries[key] = entry
            self.size_bytes += entry.size_bytes
            while len(self._entries) > 1 and self.size_bytes > self._limit_bytes:
                self._remove(next(iter(self._entries)))
        self._entries.move_to_end(key)
        return entry.value

    def _remove(self, key: int) -> None:
        entry = self._entries.pop(key, None)
        if entry is not None:
            self.size_bytes -= entry.size_bytes


def _remove(cache: "weakref.ref[MapCache[Any]]", key: int, _: object) -> None:
    alive = cache()
    if alive is not None:
        alive._remove(key)


def _size_bytes(value: object) -> int:
    """Memory of all arrays in a value, which may be nested in tuples and dataclasses."""
    if isinstance(value, np.ndarray):
        return value.nbytes
    if isinstance(value, tuple | list):
        return sum(_size_bytes(each) for each in value)
    if dataclasses.is_dataclass(value):
        return sum(_size_bytes(getattr(value, each.name)) for each in dataclasses.fields(value))
    return 0
