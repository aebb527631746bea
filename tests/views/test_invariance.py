"""The ChauffeurNet view: what must not change the picture."""

import copy
import dataclasses
import math
import pickle

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from asp_env.data.geometry import to_frame
from asp_env.data.road_map import LineType
from asp_env.views.chauffeurnet import ChauffeurNet
from asp_env.views.view import View
from tests.views.scenes import (
    COARSE,
    busy_scene,
    channel,
    cross_map,
    make_map,
    make_scene,
    standing,
    traffic,
)


@settings(max_examples=40, deadline=None)
@given(
    seed=st.integers(0, 10_000),
    turn=st.floats(-math.pi, math.pi),
    shift=st.tuples(st.floats(-500, 500), st.floats(-500, 500)),
    coarse=st.booleans(),
)
def test_turning_the_world_changes_nothing(
    seed: int, turn: float, shift: tuple[float, float], coarse: bool
) -> None:
    """World and ego turned and moved together give the same picture, up to edge pixels."""
    view = COARSE if coarse else ChauffeurNet()
    states = traffic(seed)
    moved = states.copy()
    moved[..., :2] = to_frame(states[..., :2], np.array([0.0, 0.0, -turn])) + np.array(shift)
    moved[..., 2] += turn
    before = view.draw(make_scene(states, maps=(cross_map(),)))[0]
    after = view.draw(make_scene(moved, maps=(cross_map(turn, shift),)))[0]
    assert (before != after).mean() < 1e-3
    kernel = np.ones((3, 3), dtype=np.uint8)
    for one, other in zip(before, after, strict=True):
        assert (one <= cv2.dilate(other, kernel)).all()
        assert (other <= cv2.dilate(one, kernel)).all()
        assert (cv2.erode(one, kernel) <= other).all()


@pytest.mark.parametrize("seed", range(10))
def test_a_smaller_view_is_a_cut_out(seed: int) -> None:
    """What reaches in from outside is drawn as far as it does: the middle third of a larger view.

    Pixels of 0.5 m and anchors on whole pixels make the coordinates of both views agree exactly.
    """
    scene = make_scene(traffic(seed, agents=30), size_m=(6.0, 5.0), maps=(cross_map(),))
    whole = ChauffeurNet(
        View(
            height_px=90,
            width_px=90,
            metres_per_pixel=0.5,
            anchor_row_px=50.0,
            anchor_column_px=45.0,
        )
    )
    middle = ChauffeurNet(
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


def test_drawing_in_place_equals_a_fresh_call() -> None:
    """`out` is returned, whatever it held before, and equals a fresh picture bit for bit."""
    for view in (ChauffeurNet(), COARSE):
        scene = busy_scene()
        out = np.full((len(scene.targets), *view.shape), 77, dtype=np.uint8)
        assert view.draw(scene, out) is out
        np.testing.assert_array_equal(out, view.draw(scene))


def test_targets_do_not_depend_on_each_other() -> None:
    """Any order and any selection of targets gives the same picture for each."""
    scene = busy_scene()
    together = COARSE.draw(scene)
    reversed_ = COARSE.draw(scene.with_targets(scene.targets[::-1].copy()))
    np.testing.assert_array_equal(reversed_[::-1], together)
    for row, target in enumerate(scene.targets):
        alone = COARSE.draw(scene.with_targets(target[None]))
        np.testing.assert_array_equal(alone[0], together[row])


def test_order_of_slots_does_not_matter() -> None:
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
    np.testing.assert_array_equal(COARSE.draw(shuffled), COARSE.draw(scene))


@pytest.mark.parametrize("garbage", [math.nan, math.inf, 1e30, 3.0])
def test_what_is_not_valid_changes_nothing(garbage: float) -> None:
    """Any numbers in states that are not valid, and in sizes of absent agents, are not seen."""
    scene = busy_scene()
    scene.valid[:, 4] = False
    clean = COARSE.draw(scene)
    states, sizes = scene.states.copy(), scene.sizes.copy()
    states[~scene.valid] = garbage
    sizes[:, 4] = garbage
    dirty = dataclasses.replace(scene, states=states, sizes=sizes)
    np.testing.assert_array_equal(COARSE.draw(dirty), clean)


def test_a_target_that_is_not_there_has_an_empty_picture() -> None:
    """Without a pose now there is no frame to draw in; the other targets are drawn."""
    scene = busy_scene()
    whole = COARSE.draw(scene)
    scene.valid[0, 3, -1] = False
    scene.states[0, 3, -1] = math.nan
    pictures = COARSE.draw(scene)
    assert not pictures[1].any()
    np.testing.assert_array_equal(pictures[[0, 3, 4]], whole[[0, 3, 4]])
    assert whole.any(axis=(1, 2, 3)).all()


def test_copies_carry_the_configuration_alone() -> None:
    """Pickled and copied views are equal and draw the same, and carry no map with them."""
    view = ChauffeurNet.make((90, 60))
    empty = len(pickle.dumps(view))
    picture = view.draw(busy_scene())
    for again in (pickle.loads(pickle.dumps(view)), copy.deepcopy(view)):
        assert again == view
        np.testing.assert_array_equal(again.draw(busy_scene()), picture)
    assert len(pickle.dumps(view)) == empty


def test_many_maps() -> None:
    """A view that has drawn more maps than it keeps draws the first one as before."""
    view = ChauffeurNet.make((90, 60))
    states = standing([(0.0, 0.0, 0.0)])
    scenes = [
        make_scene(states, maps=(make_map([(LineType.CURB, [(5, 0.1 * i), (20, 5)])]),))
        for i in range(80)
    ]
    for scene in [*scenes, scenes[0]]:
        np.testing.assert_array_equal(view.draw(scene), COARSE.draw(scene))
