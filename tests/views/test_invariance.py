"""Raster views: what must not change the raster."""

import copy
import dataclasses
import math
import pickle

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
    busy_scene,
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


@pytest.mark.parametrize("view", [*RASTER_VIEWS, ChauffeurNet(), MTP()], ids=lambda view: view.name)
def test_rendering_into_an_array_equals_rendering_a_new_one(view: RasterView) -> None:
    """`out` is returned and equals a new raster bit for bit, regardless of its content before."""
    scene = busy_scene()
    scene.valid[0, 3, -1] = False  # one of the targets is absent
    out = np.full((len(scene.targets), *view.shape), 77, dtype=np.uint8)
    assert view.render(scene, out) is out
    np.testing.assert_array_equal(out, view.render(scene))


@EACH
def test_targets_do_not_depend_on_each_other(view: RasterView) -> None:
    scene = busy_scene()
    together = view.render(scene)
    reversed_ = view.render(scene.with_targets(scene.targets[::-1].copy()))
    np.testing.assert_array_equal(reversed_[::-1], together)
    for row, target in enumerate(scene.targets):
        alone = view.render(scene.with_targets(target[None]))
        np.testing.assert_array_equal(alone[0], together[row])


@EACH
def test_order_of_slots_does_not_matter(view: RasterView) -> None:
    scene = busy_scene()
    order = np.random.default_rng(1).permutation(scene.states.shape[1])
    targets = np.stack([scene.targets[:, 0], np.argsort(order)[scene.targets[:, 1]]], axis=1)
    shuffled = dataclasses.replace(
        scene,
        **{
            name: np.ascontiguousarray(getattr(scene, name)[:, order])
            for name in ("states", "actions", "valid", "sizes", "classes", "ids")
        },
        targets=targets,
    )
    np.testing.assert_array_equal(view.render(shuffled), view.render(scene))


@EACH
@pytest.mark.parametrize("garbage", [math.nan, math.inf, 1e30, 3.0])
def test_entries_that_are_not_valid_have_no_effect(garbage: float, view: RasterView) -> None:
    """States that are not valid, and sizes and classes of absent agents, may be any number."""
    scene = busy_scene()
    scene.valid[:, 4] = False
    clean = view.render(scene)
    states, sizes, classes = scene.states.copy(), scene.sizes.copy(), scene.classes.copy()
    states[~scene.valid] = garbage
    sizes[:, 4] = garbage
    classes[:, 4] = 99
    dirty = dataclasses.replace(scene, states=states, sizes=sizes, classes=classes)
    np.testing.assert_array_equal(view.render(dirty), clean)


@EACH
def test_an_absent_target_has_an_empty_raster(view: RasterView) -> None:
    """The rasters of the other targets are unchanged."""
    scene = busy_scene()
    whole = view.render(scene)
    scene.valid[0, 3, -1] = False
    scene.states[0, 3, -1] = math.nan
    rasters = view.render(scene)
    assert not rasters[1].any()
    np.testing.assert_array_equal(rasters[[0, 3, 4]], whole[[0, 3, 4]])
    assert whole.any(axis=(1, 2, 3)).all()


@EACH
def test_copies_contain_only_the_configuration(view: RasterView) -> None:
    """Pickled and copied views are equal, render the same and contain no cached map."""
    empty = len(pickle.dumps(view))
    raster = view.render(busy_scene())
    for again in (pickle.loads(pickle.dumps(view)), copy.deepcopy(view)):
        assert again == view
        np.testing.assert_array_equal(again.render(busy_scene()), raster)
    assert len(pickle.dumps(view)) == empty


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
