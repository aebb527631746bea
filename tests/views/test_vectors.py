"""The vector view: numbers derived by hand, and what must not change them."""

import copy
import dataclasses
import json
import math
import pickle

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from asp_env.data.classes import AgentClass
from asp_env.data.road_map import LineType, Ragged, RoadMap
from asp_env.data.scene import Scene
from asp_env.errors import AspEnvError
from asp_env.geometry import to_frame
from asp_env.views.vectors import AGENT_FIELDS, KINDS, LINE_FIELDS, Vectors, VectorView, map_pieces
from tests.views.scenes import busy_scene, cross_map, make_map, make_scene, standing, traffic

SMALL = VectorView(agents=4, lines=3)


def assert_equal(one: Vectors, other: Vectors) -> None:
    """Bit for bit."""
    for name in Vectors._fields:
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name), err_msg=name)


def with_lanes(road_map: RoadMap, *lanes: list[tuple[float, float]]) -> RoadMap:
    """The map with the given centre lines."""
    packed = Ragged.pack([np.array(lane, dtype=np.float64) for lane in lanes])
    return dataclasses.replace(road_map, lanes=packed)


def test_shapes() -> None:
    drawn = VectorView().render(busy_scene())
    shape = VectorView().shape
    assert drawn.agents.shape == (5, 16, 16, 12) == (5, shape.agents, shape.ticks, 12)
    assert drawn.lines.shape == (5, 64, 10, 8) == (5, shape.lines, shape.points, 8)
    assert (shape.agent_fields, shape.line_fields) == (len(AGENT_FIELDS), len(LINE_FIELDS))
    assert drawn.agents_valid.shape == (5, 16, 16)
    assert drawn.lines_valid.shape == (5, 64, 10)
    assert drawn.agents.dtype == drawn.lines.dtype == np.float32


def test_a_neighbour_by_hand() -> None:
    """Target at (10, 20) heading north; truck at (7, 24) heading west, 4 m ahead, 3 m left."""
    states = standing([(10.0, 20.0, 0.5 * math.pi), (7.0, 24.0, math.pi)])
    states[0, 1, :, 3] = 5.0
    states[0, 1, 0, :2] = (9.0, 24.0)
    scene = make_scene(states, sizes_m=np.array([[(4.0, 2.0), (9.0, 2.5)]]))
    scene.classes[0, 1] = AgentClass.TRUCK
    drawn = VectorView().render(scene)
    row = dict(zip(AGENT_FIELDS, drawn.agents[0, 1, -1].round(5).tolist(), strict=True))
    assert row == {
        **{"x": 4.0, "y": 3.0, "cos": 0.0, "sin": 1.0, "speed": 5.0, "length": 9.0, "width": 2.5},
        **{"car": 0.0, "heavy": 1.0, "two_wheeler": 0.0, "pedestrian": 0.0, "other": 0.0},
    }
    np.testing.assert_allclose(drawn.agents[0, 1, 0, :2], [4, 1], atol=1e-5)
    own = drawn.agents[0, 0, -1]
    np.testing.assert_allclose(own, [0, 0, 1, 0, 0, 4, 2, 1, 0, 0, 0, 0], atol=1e-7)
    assert drawn.agents_valid[0].sum(axis=1).tolist() == [16, 16, *[0] * 14]


def test_a_lane_and_a_curb_by_hand() -> None:
    """Target at (5, 1) heading east, a lane from (5, 1), a curb 2 m left: ten points over 18 m."""
    road_map = with_lanes(make_map([(LineType.CURB, [(23, 3), (5, 3)])]), [(5, 1), (23, 1)])
    drawn = VectorView().render(make_scene(standing([(5.0, 1.0, 0.0)]), maps=(road_map,)))
    lane, curb = drawn.lines[0, :2]
    at = np.arange(0, 19, 2)
    ones, zeros = np.ones(10), np.zeros(10)
    expected = np.stack([at, zeros, ones, zeros, ones, zeros, zeros, zeros], axis=1)
    np.testing.assert_allclose(lane, expected, atol=1e-6)
    expected = np.stack([at[::-1], 2 * ones, -ones, zeros, zeros, ones, zeros, zeros], axis=1)
    np.testing.assert_allclose(curb, expected, atol=1e-6)
    assert drawn.lines_valid[0].sum(axis=1).tolist() == [10, 10, *[0] * 62]


def test_pieces_by_hand() -> None:
    """An L of 30 and 20 m is two pieces of 25 m; the direction changes at the corner."""
    pieces = map_pieces(with_lanes(make_map(), [(0, 0), (30, 0), (30, 20)]))
    np.testing.assert_allclose(pieces.middles, [[12.5, 30], [0, 7.5]], atol=1e-9)
    np.testing.assert_allclose(pieces.points[0, [0, -1]], [[0, 0, 1, 0], [25, 0, 1, 0]], atol=1e-9)
    np.testing.assert_allclose(pieces.points[1, [0, -1]], [[25, 0, 1, 0], [30, 20, 0, 1]])


def test_pieces_of_every_kind_but_virtual() -> None:
    """Virtual lines, repeated points and single points give no pieces."""
    lines = [(kind, [(0, 0), (0, 0), (3, 4)]) for kind in LineType]
    pieces = map_pieces(make_map([*lines, (LineType.CURB, [(1, 1)])]))
    assert [KINDS[kind] for kind in pieces.kinds] == ["curb", "solid", "dashed"]
    np.testing.assert_allclose(pieces.points[:, -1], [[3, 4, 0.6, 0.8]] * 3)


def test_a_map_without_lines_gives_no_lines() -> None:
    drawn = VectorView().render(make_scene(standing([(0.0, 0.0, 0.0)])))
    assert not drawn.lines_valid.any()
    assert not drawn.lines.any()


def test_agents_are_sorted_by_distance_and_id() -> None:
    """At 9, 3, 6 and 3 m with the ids 1 to 4: ids 2, 4, 3; there is no room for the farthest."""
    places = [(0.0, 0.0), (9.0, 0.0), (-3.0, 0.0), (0.0, 6.0), (0.0, -3.0)]
    drawn = SMALL.render(make_scene(standing([(*place, 0.0) for place in places])))
    np.testing.assert_array_equal(
        drawn.agents[0, :, -1, :2], np.array([(0, 0), (-3, 0), (0, -3), (0, 6)])
    )


def test_lines_ahead_are_preferred() -> None:
    """Of curbs 30 m behind, beside and ahead, and 50 m ahead, there is no room for that behind."""
    places = [(-30, 0), (0, 30), (30, 0), (50, 0)]
    lines = [(LineType.CURB, [(x - 1, y), (x + 1, y)]) for x, y in places]
    drawn = SMALL.render(make_scene(standing([(0.0, 0.0, 0.0)]), maps=(make_map(lines),)))
    np.testing.assert_allclose(drawn.lines[0, :, 0, :2], [(-1, 30), (29, 0), (49, 0)])


def test_of_equally_near_lines_the_first_are_chosen() -> None:
    """Of ten curbs with the same middle the first three are chosen."""
    lines = [(LineType.CURB, [(20.0 - i, 0.0), (20.0 + i, 0.0)]) for i in range(1, 11)]
    drawn = SMALL.render(make_scene(standing([(0.0, 0.0, 0.0)]), maps=(make_map(lines),)))
    np.testing.assert_allclose(drawn.lines[0, :, 0, 0], [19, 18, 17])


def test_agents_that_are_absent_now_are_left_out() -> None:
    """An agent observed until the previous tick is left out; a gap in the past remains a gap."""
    scene = make_scene(standing([(0.0, 0.0, 0.0), (5.0, 0.0, 0.0), (7.0, 0.0, 0.0)]))
    scene.valid[0, 1, -1] = False
    scene.valid[0, 2, 4] = False
    drawn = VectorView().render(scene)
    assert drawn.agents_valid[0].sum(axis=1).tolist() == [16, 15, *[0] * 14]
    assert not drawn.agents[0, 1, 4].any()
    assert drawn.agents[0, 1, 5, 0] == 7


@given(
    seed=st.integers(0, 10_000),
    turn=st.floats(-math.pi, math.pi),
    shift=st.tuples(st.floats(-500, 500), st.floats(-500, 500)),
)
def test_vectors_do_not_depend_on_the_pose_of_the_world(
    seed: int, turn: float, shift: tuple[float, float]
) -> None:
    """World and agents rotated and translated together; float32 resolves 500 m to 0.1 mm."""
    states = traffic(seed)
    moved = states.copy()
    moved[..., :2] = to_frame(states[..., :2], np.array([0.0, 0.0, -turn])) + np.array(shift)
    moved[..., 2] += turn
    before = VectorView().render(make_scene(states, maps=(cross_map(),)))
    after = VectorView().render(make_scene(moved, maps=(cross_map(turn, shift),)))
    np.testing.assert_allclose(after.agents, before.agents, atol=2e-4)
    np.testing.assert_allclose(after.lines, before.lines, atol=2e-4)
    np.testing.assert_array_equal(after.agents_valid, before.agents_valid)
    np.testing.assert_array_equal(after.lines_valid, before.lines_valid)
    assert before.lines_valid.any()
    assert before.agents_valid[0, 1:].any()


def test_left_is_left() -> None:
    """An agent on the left of the target that heads to the right has y > 0 and sin < 0."""
    states = standing([(0.0, 0.0, 0.7), (-5 * math.sin(0.7), 5 * math.cos(0.7), 0.7 - 1.0)])
    row = VectorView().render(make_scene(states)).agents[0, 1, -1]
    np.testing.assert_allclose(row[:4], [0, 5, math.cos(1), -math.sin(1)], atol=1e-6)


def test_targets_do_not_depend_on_each_other() -> None:
    scene = busy_scene()
    together = SMALL.render(scene)
    reversed_ = SMALL.render(scene.with_targets(scene.targets[::-1].copy()))
    assert_equal(Vectors(*(array[::-1] for array in reversed_)), together)
    for row, target in enumerate(scene.targets):
        alone = SMALL.render(scene.with_targets(target[None]))
        assert_equal(alone, Vectors(*(array[row : row + 1] for array in together)))


@pytest.mark.parametrize("seed", range(5))
def test_order_of_slots_does_not_matter(seed: int) -> None:
    scene = busy_scene(seed)
    order = np.random.default_rng(seed).permutation(scene.states.shape[1])
    shuffled = dataclasses.replace(
        scene,
        **{
            name: np.ascontiguousarray(getattr(scene, name)[:, order])
            for name in ("states", "actions", "valid", "sizes", "classes", "ids")
        },
        targets=np.stack([scene.targets[:, 0], np.argsort(order)[scene.targets[:, 1]]], axis=1),
    )
    assert_equal(SMALL.render(shuffled), SMALL.render(scene))


@pytest.mark.parametrize("garbage", [math.nan, math.inf, 1e30, 3.0])
def test_entries_that_are_not_valid_have_no_effect(garbage: float) -> None:
    """States that are not valid, and sizes and classes of absent agents, may be any number."""
    scene = busy_scene()
    scene.valid[:, 4] = False
    clean = VectorView().render(scene)
    for values, valid in ((clean.agents, clean.agents_valid), (clean.lines, clean.lines_valid)):
        assert not values[~valid].any()
        assert values[valid].any(axis=-1).all()
    states, sizes, classes = scene.states.copy(), scene.sizes.copy(), scene.classes.copy()
    states[~scene.valid] = garbage
    sizes[:, 4] = garbage
    classes[:, 4] = 1_000_000
    dirty = dataclasses.replace(scene, states=states, sizes=sizes, classes=classes)
    assert_equal(VectorView().render(dirty), clean)


def test_an_absent_target_has_only_zeros() -> None:
    """The vectors of the other targets are unchanged."""
    scene = busy_scene()
    whole = VectorView().render(scene)
    scene = dataclasses.replace(scene, targets=scene.targets[[0, 1, 3, 4]])
    scene.valid[0, 3, -1] = False
    scene.states[0, 3, -1] = math.nan
    drawn = VectorView().render(scene)
    assert not any(array[1].any() for array in drawn)
    others = Vectors(*(array[[0, 2, 3]] for array in drawn))
    assert_equal(others, Vectors(*(array[[0, 3, 4]] for array in whole)))


def test_without_own_past_only_the_targets_ticks_before_now_are_missing() -> None:
    scene = busy_scene()
    whole, now = VectorView().render(scene), VectorView(own_past=False).render(scene)
    assert not now.agents_valid[:, 0, :-1].any()
    assert not now.agents[:, 0, :-1].any()
    assert whole.agents_valid[:, 0, :-1].any()
    now.agents[:, 0, :-1] = whole.agents[:, 0, :-1]
    now.agents_valid[:, 0, :-1] = whole.agents_valid[:, 0, :-1]
    assert_equal(now, whole)


def test_longer_histories_are_cut_and_shorter_ones_rejected() -> None:
    states = traffic(0)
    longer = np.concatenate([states[:, :, :4] + 7, states], axis=2)
    assert_equal(SMALL.render(make_scene(longer)), SMALL.render(make_scene(states)))
    with pytest.raises(AspEnvError, match="needs 15 past ticks, the scene has 14"):
        SMALL.render(make_scene(states[:, :, 1:]))


def test_a_scene_without_targets_gives_empty_arrays() -> None:
    scene: Scene = busy_scene().with_targets(np.zeros((0, 2), dtype=np.int64))
    assert [len(array) for array in SMALL.render(scene)] == [0, 0, 0, 0]


@pytest.mark.parametrize("view", [VectorView(), SMALL, VectorView(own_past=False)], ids=str)
def test_configurations_can_be_stored_as_json_and_pickled(view: VectorView) -> None:
    """Views restored from JSON, pickles and copies are equal and contain no cached map."""
    assert VectorView.from_config(json.loads(json.dumps(view.config()))) == view
    empty = len(pickle.dumps(view))
    drawn = view.render(busy_scene())
    assert len(pickle.dumps(view)) == empty
    for again in (pickle.loads(pickle.dumps(view)), copy.deepcopy(view)):
        assert again == view
        assert_equal(again.render(busy_scene()), drawn)
    fields = {each.name for each in dataclasses.fields(view) if each.compare}
    assert set(view.config()) == fields | {"name"}


@pytest.mark.parametrize(
    "config",
    [
        {"name": "chauffeurnet"},
        {},
        {"name": "vectors", "zoom": 2},
        {"name": "vectors", "own_past": False},
        {"name": "vectors", "agents": 0},
        {"name": "vectors", "lines": -1},
    ],
    ids=str,
)
def test_wrong_configurations_are_rejected(config: dict[str, object]) -> None:
    with pytest.raises(AspEnvError, match="view") as caught:
        VectorView.from_config(config)
    assert "\n" not in str(caught.value)


def test_pixels_are_rejected() -> None:
    assert VectorView.make(own_past=False) == VectorView(own_past=False)
    with pytest.raises(AspEnvError, match="no rasters"):
        VectorView.make((90, 60))
