"""Raster views: what must not change the raster, besides `tests/conformance/test_views.py`."""

import copy
import dataclasses
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from asp_env.data.classes import AgentClass
from asp_env.data.road_map import LineType
from asp_env.geometry import to_frame
from asp_env.views import MTP, BinaryView, ChauffeurNet, RasterView
from asp_env.views.raster import Viewport
from tests.views.scenes import (
    RASTER_VIEWS,
    channel,
    cross_map,
    make_map,
    make_scene,
    standing,
    traffic,
)

EACH = pytest.mark.parametrize("view", RASTER_VIEWS, ids=lambda view: view.name)


def near(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Mask (rows, columns) of pixels of `one` that occur in `other` at most one pixel away."""
    found = np.zeros(one.shape, dtype=bool)
    padded = np.pad(other, 1, mode="edge")
    for row in range(3):
        for column in range(3):
            found |= one == padded[row:, column:][: one.shape[0], : one.shape[1]]
    return found


@settings(max_examples=60, deadline=None)
@given(
    seed=st.integers(0, 10_000),
    turn=st.floats(-math.pi, math.pi),
    shift=st.tuples(st.floats(-500, 500), st.floats(-500, 500)),
    view=st.sampled_from([*RASTER_VIEWS, ChauffeurNet(), MTP()]),
)
def test_rasters_do_not_depend_on_the_pose_of_the_world(
    seed: int, turn: float, shift: tuple[float, float], view: RasterView
) -> None:
    """World and ego rotated and translated together give the same raster up to edge pixels."""
    states = traffic(seed)
    classes = np.random.default_rng(seed).integers(0, len(AgentClass), states.shape[:2])
    moved = states.copy()
    moved[..., :2] = to_frame(states[..., :2], np.array([0.0, 0.0, -turn])) + np.array(shift)
    moved[..., 2] += turn
    before = view.render(make_scene(states, classes=classes, maps=(cross_map(),)))[0]
    after = view.render(make_scene(moved, classes=classes, maps=(cross_map(turn, shift),)))[0]
    assert (before != after).mean() < 1e-3
    if not isinstance(view, BinaryView):  # compare colours, not channels
        before, after = (np.dot([1, 256, 65536], p.reshape(3, -1)) for p in (before, after))
        before, after = (p.reshape(1, *view.shape[1:]) for p in (before, after))
    for one, other in zip(before, after, strict=True):
        assert near(one, other).all()
        assert near(other, one).all()


@pytest.mark.parametrize("kind", [ChauffeurNet, MTP])
@pytest.mark.parametrize("seed", range(10))
def test_a_smaller_raster_is_a_crop_of_a_larger_one(
    seed: int, kind: type[ChauffeurNet] | type[MTP]
) -> None:
    """Boxes and lines that cross the border are drawn up to it: the middle third of a raster.

    With pixels of 0.5 m and anchors on whole pixels the coordinates of both agree exactly.
    """
    scene = make_scene(traffic(seed, agents=30), size_m=(6.0, 5.0), maps=(cross_map(),))
    whole = kind(
        Viewport(
            height_px=90,
            width_px=90,
            metres_per_pixel=0.5,
            anchor_row_px=50.0,
            anchor_column_px=45.0,
        )
    )
    middle = kind(
        Viewport(
            height_px=30,
            width_px=30,
            metres_per_pixel=0.5,
            anchor_row_px=20.0,
            anchor_column_px=15.0,
        )
    )
    np.testing.assert_array_equal(middle.render(scene), whole.render(scene)[:, :, 30:60, 30:60])


def test_ego_box_is_the_same_at_every_pose() -> None:
    """Bit for bit, although its edges are on pixel centres: 19 by 7 pixels of 0.25 m."""
    poses = np.random.default_rng(0).uniform(-3, 3, (200, 3)) * [300, 300, 1]
    states = np.concatenate([standing([pose]) for pose in poses])
    scene = make_scene(states, size_m=(4.75, 1.75), targets=[(i, 0) for i in range(200)])
    boxes = ChauffeurNet(Viewport(metres_per_pixel=0.25)).render(scene)[:, channel("ego_box")]
    assert (boxes == boxes[0]).all()
    assert (boxes[0] > 0).sum() == 19 * 7
    view = MTP(dataclasses.replace(MTP().viewport, metres_per_pixel=0.25))
    boxes = (view.render(scene) == np.array([255, 0, 0])[:, None, None]).all(axis=1)
    assert (boxes == boxes[0]).all()
    assert boxes[0].sum() == 19 * 7


@EACH
def test_more_maps_than_the_cache_holds(view: RasterView) -> None:
    """A map that has been evicted from the cache is rendered as before."""
    cached = copy.deepcopy(view)
    states = standing([(0.0, 0.0, 0.0)])
    scenes = [
        make_scene(states, maps=(make_map([(LineType.CURB, [(5, 0.1 * i), (20, 5)])]),))
        for i in range(80)
    ]
    for scene in [*scenes, scenes[0]]:
        np.testing.assert_array_equal(cached.render(scene), copy.deepcopy(view).render(scene))
