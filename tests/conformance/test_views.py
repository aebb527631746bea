"""What holds for every registered view, and for one of another package.

That one is the view of `examples/own_view.py`, registered under its name.
"""

import copy
import dataclasses
import json
import math
import pickle

import numpy as np
import pytest

from asp_env.data.scene import Scene
from asp_env.data.signals import SceneSignals
from asp_env.errors import AspEnvError
from asp_env.views import (
    BinaryView,
    RasterView,
    SceneView,
    VectorShape,
    make_view,
    view_from_config,
    view_names,
    with_history,
)
from tests.views.own_view import OWN, register_own_view
from tests.views.scenes import busy_scene

NAMES = (*view_names(), OWN)


@pytest.fixture(autouse=True)
def own_view(monkeypatch: pytest.MonkeyPatch) -> None:
    """Registers the view of the example."""
    register_own_view(monkeypatch)


@pytest.fixture(params=NAMES)
def view(request: pytest.FixtureRequest) -> SceneView:
    """Every view, rasters at a quarter of their resolution."""
    whole = make_view(request.param)
    if not isinstance(whole, RasterView):
        return whole
    _, height, width = whole.shape
    return make_view(request.param, pixels=(height // 4, width // 4))


def scene_with_signals(seed: int = 0) -> Scene:
    """Three situations with two, none and two signals near the targets."""
    scene = busy_scene(seed)
    rng = np.random.default_rng(seed)
    stop_lines = rng.uniform(-15, 15, (3, 2, 2, 2))
    states = rng.integers(1, 4, (3, 2, scene.history + 1)).astype(np.int8)
    states[1] = 0
    return dataclasses.replace(scene, signals=SceneSignals(stop_lines=stop_lines, states=states))


def arrays(view: SceneView, scene: Scene) -> tuple[np.ndarray, ...]:
    """What the view renders, as arrays whose first axis is the targets."""
    drawn = view.render(scene)
    return (drawn,) if isinstance(drawn, np.ndarray) else tuple(drawn)


def assert_same(one: tuple[np.ndarray, ...], other: tuple[np.ndarray, ...]) -> None:
    for each, expected in zip(one, other, strict=True):
        np.testing.assert_array_equal(each, expected)


def test_the_name_is_that_of_the_registry(view: SceneView, request: pytest.FixtureRequest) -> None:
    name = request.node.callspec.params["view"]
    assert view.name == name == view.config()["name"]


def test_a_stored_configuration_gives_the_same_view(view: SceneView) -> None:
    again = view_from_config(json.loads(json.dumps(view.config())))
    assert again == view
    assert_same(arrays(again, scene_with_signals()), arrays(view, scene_with_signals()))


def test_unknown_fields_of_a_configuration_are_rejected(view: SceneView) -> None:
    with pytest.raises(AspEnvError, match="zoom") as caught:
        view_from_config({**view.config(), "zoom": 2.0})
    assert "\n" not in str(caught.value)


def test_arrays_have_the_shape_of_the_view(view: SceneView) -> None:
    """uint8 rasters with named channels, or the four arrays of vectors."""
    drawn, shape = arrays(view, scene_with_signals()), view.shape
    if isinstance(view, RasterView):
        assert [(each.shape, each.dtype) for each in drawn] == [((5, *view.shape), np.uint8)]
        assert len(view.channels) == len(set(view.channels)) == view.shape[0]
        return
    assert isinstance(shape, VectorShape)
    agents, lines = (5, shape.agents, shape.ticks), (5, shape.lines, shape.points)
    assert [(each.shape, each.dtype) for each in drawn] == [
        ((*agents, shape.agent_fields), np.float32),
        (agents, np.bool_),
        ((*lines, shape.line_fields), np.float32),
        (lines, np.bool_),
    ]


def test_rendering_into_arrays_equals_rendering_new_ones(view: SceneView) -> None:
    """`out` is returned and holds the same, regardless of its content before."""
    if not isinstance(view, RasterView):
        pytest.skip("vectors are rendered into a tuple of arrays, see tests/views/test_vectors.py")
    scene = scene_with_signals()
    scene.valid[0, 3, -1] = False
    out = np.full((len(scene.targets), *view.shape), 77, dtype=np.uint8)
    assert view.render(scene, out) is out
    np.testing.assert_array_equal(out, view.render(scene))


def test_packed_rasters_are_the_bits_of_the_rasters(view: SceneView) -> None:
    if not isinstance(view, BinaryView):
        pytest.skip("the view packs no bits")
    raster = view.render(scene_with_signals())
    assert set(np.unique(raster)) == {0, 255}
    packed = np.packbits(raster, axis=-1)
    np.testing.assert_array_equal(view.render_packed(scene_with_signals()), packed)


def test_targets_do_not_depend_on_each_other(view: SceneView) -> None:
    scene = scene_with_signals()
    together = arrays(view, scene)
    backwards = arrays(view, scene.with_targets(scene.targets[::-1].copy()))
    assert_same(tuple(each[::-1] for each in backwards), together)
    for row, target in enumerate(scene.targets):
        alone = arrays(view, scene.with_targets(target[None]))
        assert_same(alone, tuple(each[row : row + 1] for each in together))


def test_a_scene_without_targets_gives_no_rows(view: SceneView) -> None:
    scene = scene_with_signals()
    assert all(len(each) == 0 for each in arrays(view, scene.with_targets(scene.targets[:0])))


def test_situations_do_not_depend_on_each_other(view: SceneView) -> None:
    scene = scene_with_signals()
    together = arrays(view, scene)
    for number in range(3):
        rows = scene.targets[:, 0] == number
        assert_same(arrays(view, scene.situation(number)), tuple(each[rows] for each in together))


def test_order_of_slots_does_not_matter(view: SceneView) -> None:
    scene = scene_with_signals()
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
    assert_same(arrays(view, shuffled), arrays(view, scene))


@pytest.mark.parametrize("garbage", [math.nan, math.inf, 1e30, 3.0])
def test_entries_that_are_not_valid_have_no_effect(garbage: float, view: SceneView) -> None:
    """States that are not valid, and sizes and classes of absent agents, may be any number."""
    scene = scene_with_signals()
    scene.valid[:, 4] = False
    clean = arrays(view, scene)
    states, sizes, classes = scene.states.copy(), scene.sizes.copy(), scene.classes.copy()
    states[~scene.valid] = garbage
    sizes[:, 4] = garbage
    classes[:, 4] = 99
    dirty = dataclasses.replace(scene, states=states, sizes=sizes, classes=classes)
    assert_same(arrays(view, dirty), clean)


def test_an_absent_target_has_only_zeros(view: SceneView) -> None:
    """What is rendered of the other targets is unchanged, apart from that agent."""
    scene = scene_with_signals()
    whole = arrays(view, scene)
    scene = dataclasses.replace(scene, targets=scene.targets[[0, 1, 3, 4]])
    scene.valid[0, 3, -1] = False
    scene.states[0, 3, -1] = math.nan
    drawn = arrays(view, scene)
    assert not any(each[1].any() for each in drawn)
    assert_same(tuple(e[[0, 2, 3]] for e in drawn), tuple(e[[0, 3, 4]] for e in whole))


def test_earlier_ticks_than_the_history_have_no_effect(view: SceneView) -> None:
    scene = scene_with_signals()
    signals = scene.signals
    assert signals is not None
    before = np.random.default_rng(5).normal(size=(*scene.states.shape[:2], 3, 4))
    states = np.concatenate([before.astype(np.float32), scene.states], axis=2)
    longer = dataclasses.replace(
        scene,
        states=states,
        actions=np.zeros((*states.shape[:2], states.shape[2] - 1, 2), dtype=np.float32),
        valid=np.pad(scene.valid, ((0, 0), (0, 0), (3, 0))),
        signals=SceneSignals(
            stop_lines=signals.stop_lines,
            states=np.pad(signals.states, ((0, 0), (0, 0), (3, 0)), constant_values=1),
        ),
    )
    assert_same(arrays(view, longer), arrays(view, scene))


def test_a_short_history_is_rejected(view: SceneView) -> None:
    scene = scene_with_signals()
    now = scene.history - view.history + 1
    short = dataclasses.replace(
        scene,
        states=scene.states[:, :, now:],
        actions=scene.actions[:, :, now:],
        valid=scene.valid[:, :, now:],
        signals=None,
    )
    with pytest.raises(AspEnvError, match=f"needs {view.history} past ticks") as caught:
        view.render(short)
    assert "\n" not in str(caught.value)


def test_another_history_is_shown_and_stored(view: SceneView) -> None:
    """12 of 15 past ticks, unless the view shows fewer: the earlier ones have no effect."""
    other = with_history(view, 12)
    assert other.history <= 12
    assert view_from_config(json.loads(json.dumps(other.config()))) == other
    scene = scene_with_signals()
    signals = scene.signals
    assert signals is not None
    short = dataclasses.replace(
        scene,
        states=scene.states[:, :, 3:],
        actions=scene.actions[:, :, 3:],
        valid=scene.valid[:, :, 3:],
        signals=dataclasses.replace(signals, states=signals.states[..., 3:]),
    )
    assert_same(arrays(other, short), arrays(other, scene))


def test_copies_contain_only_the_configuration(view: SceneView) -> None:
    """Pickled and copied views are equal, render the same and contain no cached map."""
    empty = len(pickle.dumps(view))
    drawn = arrays(view, scene_with_signals())
    for again in (pickle.loads(pickle.dumps(view)), copy.deepcopy(view)):
        assert again == view
        assert_same(arrays(again, scene_with_signals()), drawn)
    assert len(pickle.dumps(view)) == empty


def test_a_scene_without_signals_is_one_with_unknown_signals(view: SceneView) -> None:
    """A view that reads signals shows nothing of them where there are none."""
    scene = scene_with_signals()
    signals = scene.signals
    assert signals is not None
    unknown = dataclasses.replace(signals, states=np.zeros_like(signals.states))
    without = arrays(view, dataclasses.replace(scene, signals=None))
    assert_same(arrays(view, dataclasses.replace(scene, signals=unknown)), without)
