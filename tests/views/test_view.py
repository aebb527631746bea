"""Viewports, and views made by name and from configurations."""

import dataclasses
import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from asp_env.errors import AspEnvError
from asp_env.geometry import from_frame
from asp_env.views import (
    MTP,
    ChauffeurNet,
    RasterView,
    Viewport,
    make_raster_view,
    make_view,
    raster_view_names,
    view_from_config,
    view_names,
)
from tests.views.scenes import RASTER_VIEWS


def pixel(
    view: Viewport, pose: tuple[float, float, float], point: tuple[float, float]
) -> np.ndarray:
    """(column, row) of a point in the viewport around a pose."""
    return view.pixels_from_world(np.array(pose)) @ np.array([*point, 1.0])


@pytest.mark.parametrize(
    ("ahead_m", "left_m", "column", "row"),
    [
        (0.0, 0.0, 120.0, 288.0),
        (57.6, 0.0, 120.0, 0.0),
        (-14.4, 0.0, 120.0, 360.0),
        (0.0, 24.0, 0.0, 288.0),
        (0.0, -24.0, 240.0, 288.0),
        (10.0, 4.0, 100.0, 238.0),
    ],
)
@pytest.mark.parametrize("heading", [0.0, 0.5 * math.pi, math.pi, -0.5 * math.pi])
def test_known_points_at_four_headings(
    ahead_m: float, left_m: float, column: float, row: float, heading: float
) -> None:
    """The default viewport shows 57.6 m ahead, 14.4 m behind and 24 m to either side."""
    pose = (31.0, -7.0, heading)
    # ahead and left are (cos, sin) and (-sin, cos), integers at these headings
    cos, sin = round(math.cos(heading)), round(math.sin(heading))
    point = (31.0 + ahead_m * cos - left_m * sin, -7.0 + ahead_m * sin + left_m * cos)
    np.testing.assert_allclose(pixel(Viewport(), pose, point), [column, row], atol=1e-9)


def test_anchor_off_the_centre() -> None:
    """With the anchor at row 8, column 2 and 0.5 m pixels, 3 m ahead and 1 m left is (0, 2)."""
    view = Viewport(
        height_px=10, width_px=9, metres_per_pixel=0.5, anchor_row_px=8.0, anchor_column_px=2.0
    )
    np.testing.assert_allclose(pixel(view, (0.0, 0.0, 0.0), (3.0, 1.0)), [0, 2], atol=1e-12)


@given(
    pose=st.tuples(*[st.floats(-1e3, 1e3)] * 2, st.floats(-10, 10)),
    ahead=st.floats(-50, 50),
    left=st.floats(-50, 50),
)
def test_agrees_with_the_vehicle_frame(
    pose: tuple[float, float, float], ahead: float, left: float
) -> None:
    """Columns decrease by 5 per metre to the left, rows by 5 per metre ahead, at any pose."""
    x, y = from_frame(np.array([ahead, left]), np.array(pose))
    expected = [120 - 5 * left, 288 - 5 * ahead]
    np.testing.assert_allclose(pixel(Viewport(), pose, (x, y)), expected, atol=1e-8)


def test_leading_axes_of_poses_are_preserved() -> None:
    """Poses (4, 3, n) give matrices (4, 3, 2, 3)."""
    poses = np.random.default_rng(0).normal(size=(4, 3, 4)).astype(np.float32)
    matrices = Viewport().pixels_from_world(poses)
    assert matrices.shape == (4, 3, 2, 3)
    np.testing.assert_array_equal(matrices[2, 1], Viewport().pixels_from_world(poses[2, 1]))


@pytest.mark.parametrize(("height", "width"), [(360, 240), (180, 120), (90, 60), (45, 30)])
def test_scaled_viewports_show_the_same_extent(height: int, width: int) -> None:
    """72 m by 48 m with the anchor at 80 % from the top, in any resolution."""
    view = Viewport().scaled((height, width))
    assert (view.height_px, view.width_px) == (height, width)
    assert view.metres_per_pixel * height == pytest.approx(72)
    assert view.metres_per_pixel * width == pytest.approx(48)
    assert view.anchor_row_px == pytest.approx(0.8 * height)
    assert view.anchor_column_px == pytest.approx(0.5 * width)


def test_scaling_to_the_same_size_or_none_changes_nothing() -> None:
    assert Viewport().scaled((360, 240)) == Viewport().scaled(None) == Viewport()


@pytest.mark.parametrize("side", [360, 96, 84])
def test_a_square_raster_shows_more_to_both_sides(side: int) -> None:
    """72 m by 72 m: 57.6 m ahead as before, and 36 m instead of 24 m to either side."""
    view = ChauffeurNet.make((side, side)).viewport
    per_metre = side / 72
    for point, expected in (
        ((57.6, 36.0), (0, 0)),
        ((-14.4, -36.0), (side, side)),
        ((0.0, 0.0), (36 * per_metre, 57.6 * per_metre)),
    ):
        np.testing.assert_allclose(pixel(view, (0.0, 0.0, 0.0), point), expected, atol=1e-9)


@pytest.mark.parametrize("side", [360, 180, 90, 45])
def test_mtp_shows_the_same_extent(side: int) -> None:
    """57.6 m ahead, 14.4 m behind and 36 m to either side, in any resolution."""
    view = MTP.make((side, side)).viewport
    per_metre = side / 72
    for point, expected in (
        ((57.6, 36.0), (0, 0)),
        ((-14.4, -36.0), (side, side)),
        ((0.0, 0.0), (36 * per_metre, 57.6 * per_metre)),
    ):
        np.testing.assert_allclose(pixel(view, (0.0, 0.0, 0.0), point), expected, atol=1e-9)


@pytest.mark.parametrize(
    "fields",
    [
        {"height_px": 0},
        {"width_px": -1},
        {"metres_per_pixel": 0.0},
        {"metres_per_pixel": math.nan},
        {"anchor_row_px": 361.0},
        {"anchor_column_px": -1.0},
    ],
)
def test_impossible_viewports_are_rejected(fields: dict[str, Any]) -> None:
    with pytest.raises(AspEnvError, match="view") as caught:
        Viewport(**fields)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("view", "pixels", "good"),
    [
        ("chauffeurnet", (90, 80), "72 m x 48 m .* 360x240, 180x120, 90x60$"),
        ("chauffeurnet", (0, 0), "360x240"),
        ("chauffeurnet", (90, 61), "360x240"),
        ("mtp", (90, 60), "72 m x 72 m .* 360x360, 180x180, 90x90$"),
        ("mtp", (-90, -90), "360x360"),
    ],
)
def test_pixels_that_are_not_square_are_rejected(
    view: str, pixels: tuple[int, int], good: str
) -> None:
    """The error is one line that suggests sizes with the aspect ratio of the extent."""
    with pytest.raises(AspEnvError, match=good) as caught:
        make_view(view, pixels=pixels)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("view", RASTER_VIEWS, ids=lambda view: view.name)
def test_configurations_contain_every_field(view: RasterView) -> None:
    fields = {field.name for field in dataclasses.fields(Viewport)} | {"name", "history"}
    extra = {"ego_trail"} if isinstance(view, ChauffeurNet) else set()
    assert set(view.config()) == fields | extra


@pytest.mark.parametrize("name", [view.name for view in RASTER_VIEWS])
def test_make_raster_view_makes_every_view_in_the_given_size(name: str) -> None:
    whole = make_raster_view(name)
    channels, height, width = whole.shape
    view = make_raster_view(name, pixels=(height // 4, width // 4))
    assert isinstance(view, RasterView)
    assert view.name == whole.name == name
    assert len(view.channels) == channels
    assert view.shape == (channels, height // 4, width // 4)
    assert view_from_config(view.config()) == view != whole


def test_all_registered_views_but_the_vector_views_are_raster_views() -> None:
    names = {view.name for view in RASTER_VIEWS}
    assert set(raster_view_names()) == names
    assert set(view_names()) - names == {"vectors", "vectors-no-trail"}


def test_unknown_names_are_rejected_with_the_known_names() -> None:
    with pytest.raises(AspEnvError, match="did you mean 'chauffeurnet'"):
        make_view("chaufeurnet", pixels=(90, 60))
    with pytest.raises(AspEnvError, match="known are chauffeurnet"):
        view_from_config({})


@pytest.mark.parametrize("make", [ChauffeurNet.from_config, MTP.from_config], ids=["binary", "mtp"])
@pytest.mark.parametrize(
    "config",
    [
        {"name": "vectors"},
        {},
        {**ChauffeurNet().config(), "zoom": 2.0},
        {**MTP().config(), "zoom": 2.0},
        {"name": "chauffeurnet"},
        {"name": "mtp"},
    ],
    ids=str,
)
def test_wrong_configurations_are_rejected(
    make: Callable[[dict[str, Any]], RasterView], config: dict[str, Any]
) -> None:
    """The configuration of another view, none, an unknown field or a missing one."""
    with pytest.raises(AspEnvError, match="configuration") as caught:
        make(config)
    assert "\n" not in str(caught.value)


def test_configurations_of_older_checkpoints_have_the_ego_trail() -> None:
    """They contain no field `ego_trail`."""
    config = ChauffeurNet.make((90, 60)).config()
    del config["ego_trail"]
    assert view_from_config(config) == ChauffeurNet.make((90, 60))


@pytest.mark.parametrize(
    "fields",
    [
        {"ego_trail": False},
        {"name": "chauffeurnet-no-trail"},
        {"ego_trail": 1},
        {"ego_trail": None},
    ],
    ids=str,
)
def test_a_trail_that_contradicts_the_name_is_rejected(fields: dict[str, Any]) -> None:
    with pytest.raises(AspEnvError, match="ego_trail"):
        view_from_config({**ChauffeurNet().config(), **fields})
