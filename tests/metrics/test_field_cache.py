"""Memory and cache of distance fields."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from asp_env.data.source import open_data
from asp_env.metrics import drivable
from asp_env.metrics.drivable import CELL_M, MARGIN_M, TILE_CELLS, drivable_field, road_edge_m
from tests.builders import make_map

PLACES = 100
"""A suite has up to 96."""


def test_the_places_of_a_suite_have_their_fields_made_once(monkeypatch: pytest.MonkeyPatch) -> None:
    road_map = open_data("sample:roundabout")[0].road_map
    left, low, right, high = road_map.extent_m
    maps = [
        dataclasses.replace(road_map, region_m=(left, low, right, high + place))
        for place in range(PLACES)
    ]
    field, made = drivable_field(road_map), []
    monkeypatch.setattr(drivable._fields, "_make", lambda each: made.append(each) or field)
    for _ in range(2):
        for each in maps:
            drivable_field(each)
    assert len(made) == PLACES


def test_environments_with_the_same_data_share_a_field() -> None:
    first, second = (open_data("sample:intersection")[0].road_map for _ in range(2))
    assert first is not second
    assert drivable_field(first) is drivable_field(second)


def test_tiles_hold_a_fraction_of_the_grid() -> None:
    """Two roads of 7 m on a square of 210 m: most of it is more than 5 m off them."""
    field = drivable_field(make_map())
    assert field.tiles.nbytes + field.tile_of.nbytes < 0.2 * 4 * np.prod(field.shape)


@given(st.integers(1, 3 * TILE_CELLS), st.integers(1, 3 * TILE_CELLS), st.integers(0, 2**32 - 1))
def test_tiles_give_every_cell_of_the_grid(rows: int, columns: int, seed: int) -> None:
    """Grids of any size, with constant and with mixed tiles, and the margin around them."""
    rng = np.random.default_rng(seed)
    grid = rng.choice(np.array([0.0, 1.25, MARGIN_M], dtype=np.float32), size=(rows, columns))
    grid[: rows // 2], grid[:, : columns // 3] = 0.0, MARGIN_M
    field = drivable._tiled(grid, (10.0, -20.0))
    around = np.pad(grid, 3, constant_values=MARGIN_M)
    row, column = np.indices(around.shape) - 3
    points = np.stack([10.0 + column * CELL_M, -20.0 + row * CELL_M], axis=-1)
    np.testing.assert_array_equal(field.distance_m(points), around)
    assert field.drivable_m2() == (grid <= 0).sum() * CELL_M**2


def test_the_signed_field_equals_the_field_outside() -> None:
    road_map = make_map()
    states = np.random.default_rng(0).uniform(-100, 100, (500, 4)).astype(np.float32)
    sizes = np.full((500, 2), (4.5, 1.9), dtype=np.float32)
    outside = drivable.off_road_m(road_map, states, sizes)
    np.testing.assert_array_equal(np.maximum(road_edge_m(road_map, states, sizes), 0), outside)
