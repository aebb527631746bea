"""Values that are computed once per map, within a stated amount of memory."""

import gc
import weakref
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from asp_env.data.map_cache import MapCache
from asp_env.data.road_map import RoadMap
from tests.builders import make_map

KILOBYTE = np.zeros(1000, dtype=np.uint8)


@dataclass
class Table:
    name: str
    columns: tuple[np.ndarray, ...]


class Nested(NamedTuple):
    table: Table
    extra: np.ndarray


def test_a_value_is_made_once_per_map() -> None:
    made: list[RoadMap] = []
    cache = MapCache(lambda road_map: made.append(road_map) or KILOBYTE.copy())
    first, second = make_map(), make_map()
    assert cache(first) is cache(first)
    assert cache(first) is not cache(second)
    assert len(made) == 2


def test_the_least_recently_used_value_is_removed_above_the_limit() -> None:
    """Three values of 1,000 bytes where 2,500 are allowed."""
    cache = MapCache(lambda _: KILOBYTE.copy(), 2500)
    maps = [make_map() for _ in range(3)]
    values = [cache(road_map) for road_map in maps[:2]]
    assert cache(maps[0]) is values[0]
    cache(maps[2])
    assert (len(cache), cache.size_bytes) == (2, 2000)
    assert cache(maps[0]) is values[0]
    assert cache(maps[1]) is not values[1]


def test_a_value_above_the_limit_is_kept_until_the_next() -> None:
    cache = MapCache(lambda _: KILOBYTE.copy(), 100)
    first, second = make_map(), make_map()
    assert cache(first) is cache(first)
    cache(second)
    assert len(cache) == 1


def test_a_value_is_removed_with_its_map() -> None:
    cache = MapCache(lambda _: KILOBYTE.copy())
    road_map, kept = make_map(), make_map()
    cache(road_map)
    cache(kept)
    del road_map
    gc.collect()
    assert (len(cache), cache.size_bytes) == (1, 1000)


def test_a_cache_is_not_kept_by_the_maps_in_it() -> None:
    cache, road_map = MapCache(lambda _: KILOBYTE.copy()), make_map()
    cache(road_map)
    gone = weakref.ref(cache)
    gc.disable()  # no cycle has to be collected
    try:
        del cache
        assert gone() is None
    finally:
        gc.enable()


def test_arrays_in_tuples_and_dataclasses_count() -> None:
    """1,000 bytes of a table with two columns of 400 and 600, and 800 of 100 float64."""
    table = Table(name="a", columns=(KILOBYTE[:400], KILOBYTE[:600]))
    cache = MapCache(lambda _: Nested(table=table, extra=np.zeros(100)))
    road_map = make_map()
    cache(road_map)
    assert cache.size_bytes == 1800
