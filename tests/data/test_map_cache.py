"""Values that are computed once per map, within a stated amount of memory."""

import dataclasses
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import pytest

from asp_env.data.bounded_cache import MapCache
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


def _map(number: int) -> RoadMap:
    """The crossing, with a speed limit of its own on all eight lanes."""
    lanes = make_map()
    count = len(lanes.lanes)
    return dataclasses.replace(
        lanes,
        areas=lanes.lanes,
        two_way=np.zeros(count, dtype=bool),
        limits_mps=np.full(count, float(number)),
        limited=np.ones(count, dtype=bool),
    )


def test_maps_of_equal_geometry_share_a_value() -> None:
    made: list[RoadMap] = []
    cache = MapCache(lambda road_map: made.append(road_map) or KILOBYTE.copy())
    assert cache(_map(1)) is cache(_map(1))
    assert cache(dataclasses.replace(_map(1), name="another")) is cache(_map(1))
    assert cache(_map(1)) is not cache(_map(2))
    assert len(made) == 2


@pytest.mark.parametrize(
    "change",
    [
        {"region_m": (0.0, 0.0, 1.0, 1.0)},
        {"line_types": np.ones(8, dtype=np.int64)},
        {"drivable": make_map().lanes},
        {"successors": np.zeros((0, 2), dtype=np.int64)},
        {"two_way": np.ones(8, dtype=bool)},
    ],
    ids=lambda change: next(iter(change)),
)
def test_every_part_of_the_geometry_counts(change: dict[str, Any]) -> None:
    assert dataclasses.replace(_map(1), **change).geometry_hash != _map(1).geometry_hash


def test_the_least_recently_used_value_is_removed_above_the_limit() -> None:
    """Three values of 1,000 bytes where 2,500 are allowed."""
    cache = MapCache(lambda _: KILOBYTE.copy(), 2500)
    values = [cache(_map(number)) for number in range(2)]
    assert cache(_map(0)) is values[0]
    cache(_map(2))
    assert (len(cache.results), cache.results.size_bytes) == (2, 2000)
    assert cache(_map(0)) is values[0]
    assert cache(_map(1)) is not values[1]


def test_a_value_above_the_limit_is_kept_until_the_next() -> None:
    cache = MapCache(lambda _: KILOBYTE.copy(), 100)
    assert cache(_map(0)) is cache(_map(0))
    cache(_map(1))
    assert (len(cache.results), cache.results.size_bytes) == (1, 1000)


def test_arrays_in_tuples_and_dataclasses_count() -> None:
    """1,000 bytes of a table with two columns of 400 and 600, and 800 of 100 float64."""
    table = Table(name="a", columns=(KILOBYTE[:400], KILOBYTE[:600]))
    cache = MapCache(lambda _: Nested(table=table, extra=np.zeros(100)))
    cache(make_map())
    assert cache.results.size_bytes == 1800
