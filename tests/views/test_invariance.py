"""Views of pictures: what must not change the picture."""

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
from asp_env.views import BinaryView, PictureView
from asp_env.views.chauffeurnet import ChauffeurNet
from asp_env.views.mtp import MTP
from asp_env.views.view import View
from tests.views.scenes import (
    PICTURES,
    busy_scene,
    channel,
    cross_map,
    make_map,
    make_scene,
    standing,
    traffic,
)

EACH = pytest.mark.parametrize("view", PICTURES, ids=lambda view: view.name)


def near(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Where a pixel (rows, columns) of `one` is found in `other` at most one pixel away."""
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
    view=st.sampled_from([*PICTURES, ChauffeurNet(), MTP()]),
)
def test_turning_the_world_changes_nothing(
    seed: int, turn: float, shift: tuple[float, float], view: PictureView
) -> None:
    """World and ego turned and moved together give the same picture, up to edge pixels."""
    states = traffic(seed)
    classes = np.random.default_rng(seed).integers(0, len(AgentClass), states.shape[:2])
    moved = states.copy()
    moved[..., :2] = to_frame(states[..., :2], np.array([0.0, 0.0, -turn])) + np.array(shift)
    moved[..., 2] += turn
    before = view.draw(make_scene(states, classes=classes, maps=(cross_map(),)))[0]
    after = view.draw(make_scene(moved, classes=classes, maps=(cross_map(turn, shift),)))[0]
    assert (before != after).mean() < 1e-3
    if not isinstance(view, BinaryView):  # a pixel is a colour
        before, after = (np.dot([1, 256, 65536], p.reshape(3, -1)) for p in (before, after))
        before, after = (p.reshape(1, *view.shape[1:]) for p in (before, after))
    for one, other in zip(before, after, strict=True):
        assert near(one, other).all()
        assert near(other, one).all()


@pytest.mark.parametrize("kind", [ChauffeurNet, MTP])
@pytest.mark.parametrize("seed", range(10))
def test_a_smaller_view_is_a_cut_out(seed: int, kind: type[ChauffeurNet] | type[MTP]) -> None:
    """What reaches in from outside is drawn as far as it does: the middle third of a larger view.

    Pixels of 0.5 m and anchors on whole pixels make the coordinates of both views agree exactly.
    """
    scene = make_scene(traffic(seed, agents=30), size_m=(6.0, 5.0), maps=(cross_map(),))
    whole = kind(
        View(
            height_px=90,
            width_px=90,
            metres_per_pixel=0.5,
            anchor_row_px=50.0,
            anchor_column_px=45.0,
        )
    )
    middle = kind(
        View(
            height_px=30,
            width_px=30,
            metres_per_pixel=0.5,
            anchor_row_px=20.0,
            anchor_column_px=15.0,
        )
    )
    np.testing.assert_array_equal(middle.draw(scene), whole.draw(scene)[:, :, 30:60, 30:60])


def test_ego_box_is_the_same_at_every_pose() -> None:
    """Bit for bit, although its edges lie on pixel centres: 19 by 7 pixels of 0.25 m."""
    poses = np.random.default_rng(0).uniform(-3, 3, (200, 3)) * [300, 300, 1]
    states = np.concatenate([standing([pose]) for pose in poses])
    scene = make_scene(states, size_m=(4.75, 1.75), targets=[(i, 0) for i in range(200)])
    boxes = ChauffeurNet(View(metres_per_pixel=0.25)).draw(scene)[:, channel("ego_box")]
    assert (boxes == boxes[0]).all()
    assert (boxes[0] > 0).sum() == 19 * 7
    view = MTP(dataclasses.replace(MTP().view, metres_per_pixel=0.25))
    boxes = (view.draw(scene) == np.array([255, 0, 0])[:, None, None]).all(axis=1)
    assert (boxes == boxes[0]).all()
    assert boxes[0].sum() == 19 * 7


@pytest.mark.parametrize("view", [*PICTURES, ChauffeurNet(), MTP()], ids=lambda view: view.name)
def test_drawing_in_place_equals_a_fresh_call(view: PictureView) -> None:
    """`out` is returned, whatever it held before, and equals a fresh picture bit for bit."""
    scene = busy_scene()
    scene.valid[0, 3, -1] = False  # one of the targets is not there
    out = np.full((len(scene.targets), *view.shape), 77, dtype=np.uint8)
    assert view.draw(scene, out) is out
    np.testing.assert_array_equal(out, view.draw(scene))


@EACH
def test_targets_do_not_depend_on_each_other(view: PictureView) -> None:
    """Any order and any selection of targets gives the same picture for each."""
    scene = busy_scene()
    together = view.draw(scene)
    reversed_ = view.draw(scene.with_targets(scene.targets[::-1].copy()))
    np.testing.assert_array_equal(reversed_[::-1], together)
    for row, target in enumerate(scene.targets):
        alone = view.draw(scene.with_targets(target[None]))
        np.testing.assert_array_equal(alone[0], together[row])


@EACH
def test_order_of_slots_does_not_matter(view: PictureView) -> None:
    """Agents in other slots give the same pictures, bit for bit."""
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
    np.testing.assert_array_equal(view.draw(shuffled), view.draw(scene))


@EACH
@pytest.mark.parametrize("garbage", [math.nan, math.inf, 1e30, 3.0])
def test_what_is_not_valid_changes_nothing(garbage: float, view: PictureView) -> None:
    """Numbers in states that are not valid, and sizes and classes of the absent, are not seen."""
    scene = busy_scene()
    scene.valid[:, 4] = False
    clean = view.draw(scene)
    states, sizes, classes = scene.states.copy(), scene.sizes.copy(), scene.classes.copy()
    states[~scene.valid] = garbage
    sizes[:, 4] = garbage
    classes[:, 4] = 99
    dirty = dataclasses.replace(scene, states=states, sizes=sizes, classes=classes)
    np.testing.assert_array_equal(view.draw(dirty), clean)


@EACH
def test_a_target_that_is_not_there_has_an_empty_picture(view: PictureView) -> None:
    """Without a pose now there is no frame to draw in; the other targets are drawn."""
    scene = busy_scene()
    whole = view.draw(scene)
    scene.valid[0, 3, -1] = False
    scene.states[0, 3, -1] = math.nan
    pictures = view.draw(scene)
    assert not pictures[1].any()
    np.testing.assert_array_equal(pictures[[0, 3, 4]], whole[[0, 3, 4]])
    assert whole.any(axis=(1, 2, 3)).all()


@EACH
def test_copies_carry_the_configuration_alone(view: PictureView) -> None:
    """Pickled and copied views are equal and draw the same, and carry no map with them."""
    empty = len(pickle.dumps(view))
    picture = view.draw(busy_scene())
    for again in (pickle.loads(pickle.dumps(view)), copy.deepcopy(view)):
        assert again == view
        np.testing.assert_array_equal(again.draw(busy_scene()), picture)
    assert len(pickle.dumps(view)) == empty


@EACH
def test_many_maps(view: PictureView) -> None:
    """A view that has drawn more maps than it keeps draws the first one as before."""
    kept = copy.deepcopy(view)
    states = standing([(0.0, 0.0, 0.0)])
    scenes = [
        make_scene(states, maps=(make_map([(LineType.CURB, [(5, 0.1 * i), (20, 5)])]),))
        for i in range(80)
    ]
    for scene in [*scenes, scenes[0]]:
        np.testing.assert_array_equal(kept.draw(scene), copy.deepcopy(view).draw(scene))
