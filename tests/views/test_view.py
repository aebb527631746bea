"""Views: where a point of the world lies in the picture, and how a view is made."""

import dataclasses
import json
import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from asp_env.data.geometry import from_frame
from asp_env.errors import AspEnvError
from asp_env.views import VIEWS, PictureView, make_view, view_from_config
from asp_env.views.chauffeurnet import ChauffeurNet
from asp_env.views.view import View


def pixel(view: View, pose: tuple[float, float, float], point: tuple[float, float]) -> np.ndarray:
    """(column, row) of a point seen from a pose."""
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
    """The default view reaches 57.6 m ahead, 14.4 m back and 24 m to either side."""
    pose = (31.0, -7.0, heading)
    # Ahead and left are (cos, sin) and (-sin, cos): whole numbers at these headings.
    cos, sin = round(math.cos(heading)), round(math.sin(heading))
    point = (31.0 + ahead_m * cos - left_m * sin, -7.0 + ahead_m * sin + left_m * cos)
    np.testing.assert_allclose(pixel(View(), pose, point), [column, row], atol=1e-9)


def test_anchor_off_the_centre() -> None:
    """With the anchor at row 8, column 2 and 0.5 m pixels, 3 m ahead and 1 m left is (0, 2)."""
    view = View(
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
    """Columns fall by 5 a metre to the left, rows fall by 5 a metre ahead, at any pose."""
    x, y = from_frame(np.array([ahead, left]), np.array(pose))
    expected = [120 - 5 * left, 288 - 5 * ahead]
    np.testing.assert_allclose(pixel(View(), pose, (x, y)), expected, atol=1e-8)


def test_poses_keep_their_axes() -> None:
    """Poses (4, 3, n) give matrices (4, 3, 2, 3), one for each."""
    poses = np.random.default_rng(0).normal(size=(4, 3, 4)).astype(np.float32)
    matrices = View().pixels_from_world(poses)
    assert matrices.shape == (4, 3, 2, 3)
    np.testing.assert_array_equal(matrices[2, 1], View().pixels_from_world(poses[2, 1]))


@pytest.mark.parametrize(("height", "width"), [(360, 240), (180, 120), (90, 60), (45, 30)])
def test_scaled_shows_the_same_extent(height: int, width: int) -> None:
    """72 m by 48 m and the anchor at 80 % from the top, in any number of pixels."""
    view = View.scaled(height, width)
    assert (view.height_px, view.width_px) == (height, width)
    assert view.metres_per_pixel * height == pytest.approx(72)
    assert view.metres_per_pixel * width == pytest.approx(48)
    assert view.anchor_row_px == pytest.approx(0.8 * height)
    assert view.anchor_column_px == pytest.approx(0.5 * width)


def test_scaled_to_its_own_size_is_the_default() -> None:
    """360x240 is the default view itself."""
    assert View.scaled(360, 240) == View()


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
def test_impossible_views_are_refused(fields: dict[str, Any]) -> None:
    """Each impossible value gives one line that says what it was."""
    with pytest.raises(AspEnvError, match="view") as caught:
        View(**fields)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(("height", "width"), [(90, 90), (0, 0), (90, 61)])
def test_scaled_refuses_oblong_pixels(height: int, width: int) -> None:
    """Sizes that are not 3 to 2 are refused, with sizes that are."""
    with pytest.raises(AspEnvError, match="360x240"):
        View.scaled(height, width)


def test_configuration_survives_json() -> None:
    """A view written to JSON and read back draws the same pictures, by equality."""
    view = ChauffeurNet(View.scaled(90, 60))
    again = view_from_config(json.loads(json.dumps(view.config())))
    assert again == view
    assert again != ChauffeurNet()


def test_configuration_names_every_field() -> None:
    """Nothing that decides the picture is left out of the configuration."""
    fields = {field.name for field in dataclasses.fields(View)}
    assert set(ChauffeurNet().config()) == fields | {"name"}


@pytest.mark.parametrize("name", list(VIEWS))
def test_make_view_knows_every_name(name: str) -> None:
    """Every registered view comes in the size asked for and knows its own name."""
    view = make_view(name, height_px=90, width_px=60)
    assert isinstance(view, PictureView)
    assert view.name == name
    assert view.shape == (len(view.channels), 90, 60)
    assert view_from_config(view.config()) == view


def test_unknown_names_list_the_known() -> None:
    """A misspelt view is refused with the known names."""
    with pytest.raises(AspEnvError, match="did you mean 'chauffeurnet'"):
        make_view("chaufeurnet", height_px=90, width_px=60)
    with pytest.raises(AspEnvError, match="known are chauffeurnet"):
        view_from_config({})


@pytest.mark.parametrize(
    "config", [{"name": "mtp"}, {}, {"name": "chauffeurnet", "zoom": 2.0}], ids=str
)
def test_foreign_configurations_are_refused(config: dict[str, object]) -> None:
    """Another view's configuration, none, or an unknown field is refused in one line."""
    with pytest.raises(AspEnvError, match="configuration"):
        ChauffeurNet.from_config(config)
