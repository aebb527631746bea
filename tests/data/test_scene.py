"""Contents of scenes: slots, padding, actions, and no future."""

import dataclasses
import math

import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import given, settings

from asp_env.data.classes import AgentClass
from asp_env.data.recording import Recording
from asp_env.data.scene import Scene, infer_actions
from asp_env.data.snippets import SnippetIndex, gather_scene, index_snippets
from asp_env.errors import AspEnvError
from tests.builders import Drive, make_map, make_recording

RECORDING = make_recording()
INDEX = index_snippets([RECORDING], dt_s=0.2, horizon_s=3.0)


def scene_at(tick: int, recording: Recording = RECORDING) -> Scene:
    """The situation of all snippets at one tick."""
    return gather_scene([recording], INDEX.select(INDEX.tick == tick))


def assert_equal(scene: Scene, other: Scene) -> None:
    """All arrays of two scenes are equal."""
    for field in dataclasses.fields(Scene):
        if field.name not in ("maps", "dt_s"):
            one, two = getattr(scene, field.name), getattr(other, field.name)
            np.testing.assert_array_equal(one, two, err_msg=field.name)


def test_order_of_slots() -> None:
    """The first target, then the others by first frame, then id; at tick 36 all are present.

    Track 8 appears at 2 s and track 7 at 4 s; all others are present from the start.
    """
    scene = scene_at(36)
    assert scene.ids.tolist() == [[1, 2, 3, 4, 5, 6, 9, 10, 8, 7]]
    assert scene.targets.tolist() == [[0, slot] for slot in (0, 1, 2, 3, 4, 5, 9)]
    assert scene.classes[0, 9] == AgentClass.MOTORCYCLE
    np.testing.assert_allclose(scene.sizes[0, 9], [2.2, 0.8])


def test_situation_equals_a_scene_of_its_tick() -> None:
    """Except for padding."""
    both = gather_scene([RECORDING], INDEX.select(np.isin(INDEX.tick, (36, 60))))
    alone, expected = both.situation(1), scene_at(60)
    names = ("states", "actions", "valid", "sizes", "classes", "ids")
    agents = expected.ids.shape[1]
    trimmed = {name: getattr(alone, name)[:, :agents] for name in names}
    assert_equal(dataclasses.replace(alone, **trimmed), expected)
    assert len(alone.targets) < len(both.targets)


def test_first_target_is_the_ego() -> None:
    """The first track of the index is in slot 0."""
    at = INDEX.select(INDEX.tick == 36)
    scene = gather_scene([RECORDING], at.select(np.array([6, 3])))
    assert scene.ids.tolist() == [[7, 1, 2, 3, 4, 5, 6, 9, 10, 8]]
    assert scene.targets.tolist() == [[0, 0], [0, 4]]


def test_tracks_that_appear_together_are_sorted_by_id() -> None:
    ids = np.array([70, 60, 50, 40, 30, 20, 10, 9, 8, 7])
    scene = scene_at(36, dataclasses.replace(RECORDING, track_ids=ids))
    assert scene.ids.tolist() == [[70, 7, 8, 20, 30, 40, 50, 60, 9, 10]]


def test_agents_have_slots_if_present_within_the_history() -> None:
    leaves = Drive(kind=AgentClass.CAR, start=(0.0, 9.0, 0.0, 5.0), leaves_s=4.0)  # tick 20
    appears = Drive(kind=AgentClass.CAR, start=(0.0, 18.0, 0.0, 5.0), appears_s=7.0)  # tick 35
    always = Drive(kind=AgentClass.CAR, start=(0.0, 0.0, 0.0, 5.0))
    recording = make_recording(drives=(leaves, appears, always))

    def slots(tick: int) -> tuple[list[int], list[int]]:
        index = index_snippets([recording], dt_s=0.2, horizon_s=3.0)
        scene = gather_scene([recording], index.select((index.tick == tick) & (index.track == 2)))
        return scene.ids[0].tolist(), scene.valid[0].sum(axis=1).tolist()

    assert slots(33) == ([3, 1], [16, 3])  # ticks 18 to 33: track 1 at 18, 19, 20
    assert slots(36) == ([3, 2], [16, 2])  # ticks 21 to 36: track 2 at 35, 36


def test_empty_slots_are_zeros_with_id_minus_one() -> None:
    scene = gather_scene([RECORDING], INDEX.select((INDEX.tick == 15) | (INDEX.tick == 36)))
    assert scene.tick.tolist() == [15, 36]
    assert scene.ids[0].tolist() == [1, 2, 3, 4, 5, 6, 9, 10, 8, -1]
    for array in (scene.states, scene.actions, scene.sizes, scene.classes, scene.valid):
        assert not array[0, 9].any()
    assert not scene.states[~scene.valid].any()


def test_targets_are_in_the_order_of_the_index() -> None:
    some = INDEX.select(np.random.default_rng(3).permutation(len(INDEX))[:40])
    scene = gather_scene([RECORDING], some)
    at = (scene.targets[:, 0], scene.targets[:, 1])
    np.testing.assert_array_equal(scene.ids[at], RECORDING.track_ids[some.track])
    np.testing.assert_array_equal(scene.tick[at[0]], some.tick)
    now = RECORDING.first_frames[some.track], RECORDING.starts[some.track]
    np.testing.assert_array_equal(
        scene.target_states, RECORDING.states[now[1] + 5 * some.tick - now[0]]
    )


@settings(max_examples=10)
@given(tick=st.integers(5, 28).map(lambda k: 3 * k), seed=st.integers(0, 99))
def test_no_future(tick: int, seed: int) -> None:
    """A scene does not depend on later states, or on agents that appear later."""
    states = RECORDING.states.copy()
    rng = np.random.default_rng(seed)
    for track in range(len(RECORDING)):
        later = slice(
            max(5 * tick + 1 - int(RECORDING.first_frames[track]), 0) + RECORDING.starts[track],
            RECORDING.starts[track + 1],
        )
        states[later] = rng.normal(scale=50, size=states[later].shape)
    late_track = rng.normal(size=(10, 4)).astype(np.float32)
    other = dataclasses.replace(
        RECORDING,
        track_ids=np.append(RECORDING.track_ids, 0),
        classes=np.append(RECORDING.classes, np.int32(0)),
        sizes=np.concatenate([RECORDING.sizes, RECORDING.sizes[:1]]),
        first_frames=np.append(RECORDING.first_frames, 5 * tick + 1),
        starts=np.append(RECORDING.starts, len(states) + 10),
        states=np.concatenate([states, late_track]),
    )
    assert not np.array_equal(states, RECORDING.states)
    assert_equal(scene_at(tick, other), scene_at(tick))


def test_actions() -> None:
    """Inferred actions are those of the drives: none, braking by 1.5 m/s², steering 0.18 rad."""
    scene = scene_at(18)  # 0.6 s to 3.6 s, slots in the order of ids up to 6
    assert scene.actions.shape[2] == scene.history == 15
    for slot, action in ((0, (0, 0)), (1, (-1.5, 0)), (5, (0, 0.18))):
        expected = np.tile(np.array(action), (15, 1))
        np.testing.assert_allclose(scene.actions[0, slot], expected, atol=1e-3)


def test_actions_need_both_states() -> None:
    """They are zero next to an absent tick; an absent agent may have size 0."""
    states = np.zeros((1, 4, 4), dtype=np.float32)
    states[0, :, 3] = [1, 2, 3, 5]
    valid = np.array([[False, True, True, True]])
    actions = infer_actions(states, valid, np.array([4.0], dtype=np.float32), 0.5)
    np.testing.assert_allclose(actions, [[(0, 0), (2, 0), (4, 0)]])
    absent = infer_actions(states, ~valid & False, np.zeros(1, dtype=np.float32), 0.5)
    assert not absent.any()
    assert absent.dtype == np.float32


def test_maps() -> None:
    """Recordings of one place share a map, which each situation refers to."""
    shared = make_map()
    recordings = [
        make_recording(name="00", road_map=shared),
        make_recording(name="01", road_map=make_map()),
        make_recording(name="02", road_map=shared),
    ]
    index = index_snippets(recordings, dt_s=0.2, horizon_s=3.0)
    scene = gather_scene(recordings, index.select(index.tick == 15))
    assert len(scene.maps) == 2
    assert scene.map_index.tolist() == [0, 1, 0]
    assert scene.maps[0] is shared


def test_predictable() -> None:
    """A car that is always present is; one that appears late, and other classes, are not."""
    scene = scene_at(15).with_targets(np.array([(0, 0), (0, 6), (0, 8)]))
    assert scene.predictable.tolist() == [True, False, False]  # car, bicycle, pedestrian
    late = SnippetIndex(
        recording=np.zeros(1, dtype=np.int64),
        track=np.array([6]),
        tick=np.array([30]),
        dt_s=0.2,
        history=15,
        horizon_ticks=15,
    )
    assert gather_scene([RECORDING], late).predictable.tolist() == [False]  # from tick 20 on


def test_check_of_the_time_step() -> None:
    scene = scene_at(15)
    scene.check_dt(0.2, "mtp")
    scene.check_dt(math.nextafter(0.2, 1), "mtp")
    with pytest.raises(AspEnvError, match=r"mtp was made for a time step of 0\.1 s.* has 0\.2 s"):
        scene.check_dt(0.1, "mtp")
