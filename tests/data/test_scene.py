"""What a scene holds: whose slot is whose, and nothing of the future."""

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


def same(scene: Scene, other: Scene) -> None:
    """Every array of two scenes agrees to the last bit."""
    for field in dataclasses.fields(Scene):
        if field.name not in ("maps", "dt_s"):
            mine, its = getattr(scene, field.name), getattr(other, field.name)
            np.testing.assert_array_equal(mine, its, err_msg=field.name)


def test_slots() -> None:
    """The first target, then the others by first appearance, then id; at tick 36 all are there.

    8 came at 2 s, 7 at 4 s, all others were there from the start.
    """
    scene = scene_at(36)
    assert scene.ids.tolist() == [[1, 2, 3, 4, 5, 6, 9, 10, 8, 7]]
    assert scene.targets.tolist() == [[0, slot] for slot in (0, 1, 2, 3, 4, 5, 9)]
    assert scene.classes[0, 9] == AgentClass.MOTORCYCLE
    np.testing.assert_allclose(scene.sizes[0, 9], [2.2, 0.8])


def test_one_situation_alone() -> None:
    """Of two ticks side by side the second is what it is by itself, but for padding."""
    both = gather_scene([RECORDING], INDEX.select(np.isin(INDEX.tick, (36, 60))))
    alone, expected = both.situation(1), scene_at(60)
    names = ("states", "actions", "valid", "sizes", "classes", "ids")
    agents = expected.ids.shape[1]
    trimmed = {name: getattr(alone, name)[:, :agents] for name in names}
    same(dataclasses.replace(alone, **trimmed), expected)
    assert len(alone.targets) < len(both.targets)


def test_first_target_is_first() -> None:
    """An index that starts with another track puts that one into slot 0."""
    at = INDEX.select(INDEX.tick == 36)
    scene = gather_scene([RECORDING], at.select(np.array([6, 3])))
    assert scene.ids.tolist() == [[7, 1, 2, 3, 4, 5, 6, 9, 10, 8]]
    assert scene.targets.tolist() == [[0, 0], [0, 4]]


def test_ids_decide_among_equals() -> None:
    """Of those who came together the lower id comes first, wherever it stands in the table."""
    ids = np.array([70, 60, 50, 40, 30, 20, 10, 9, 8, 7])
    scene = scene_at(36, dataclasses.replace(RECORDING, track_ids=ids))
    assert scene.ids.tolist() == [[70, 7, 8, 20, 30, 40, 50, 60, 9, 10]]


def test_those_who_left_and_those_to_come() -> None:
    """Whoever was seen within the history has a slot, whoever comes later has none."""
    gone = Drive(kind=AgentClass.CAR, start=(0.0, 9.0, 0.0, 5.0), leaves_s=4.0)  # tick 20
    late = Drive(kind=AgentClass.CAR, start=(0.0, 18.0, 0.0, 5.0), appears_s=7.0)  # tick 35
    here = Drive(kind=AgentClass.CAR, start=(0.0, 0.0, 0.0, 5.0))
    recording = make_recording(drives=(gone, late, here))

    def slots(tick: int) -> tuple[list[int], list[int]]:
        index = index_snippets([recording], dt_s=0.2, horizon_s=3.0)
        scene = gather_scene([recording], index.select((index.tick == tick) & (index.track == 2)))
        return scene.ids[0].tolist(), scene.valid[0].sum(axis=1).tolist()

    assert slots(33) == ([3, 1], [16, 3])  # ticks 18 to 33: track 1 at 18, 19, 20
    assert slots(36) == ([3, 2], [16, 2])  # ticks 21 to 36: track 2 at 35, 36


def test_situations_and_padding() -> None:
    """One situation a tick; slots that nobody has are zeros with id -1."""
    scene = gather_scene([RECORDING], INDEX.select((INDEX.tick == 15) | (INDEX.tick == 36)))
    assert scene.tick.tolist() == [15, 36]
    assert scene.ids[0].tolist() == [1, 2, 3, 4, 5, 6, 9, 10, 8, -1]
    for array in (scene.states, scene.actions, scene.sizes, scene.classes, scene.valid):
        assert not array[0, 9].any()
    assert not scene.states[~scene.valid].any()


def test_targets_in_any_order() -> None:
    """Targets keep the order of the index, and name the tracks that it names."""
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
    """Whatever happens after now, and whoever comes then, the scene stays the same."""
    states = RECORDING.states.copy()
    rng = np.random.default_rng(seed)
    for track in range(len(RECORDING)):
        later = slice(
            max(5 * tick + 1 - int(RECORDING.first_frames[track]), 0) + RECORDING.starts[track],
            RECORDING.starts[track + 1],
        )
        states[later] = rng.normal(scale=50, size=states[later].shape)
    newcomer = rng.normal(size=(10, 4)).astype(np.float32)
    other = dataclasses.replace(
        RECORDING,
        track_ids=np.append(RECORDING.track_ids, 0),
        classes=np.append(RECORDING.classes, np.int32(0)),
        sizes=np.concatenate([RECORDING.sizes, RECORDING.sizes[:1]]),
        first_frames=np.append(RECORDING.first_frames, 5 * tick + 1),
        starts=np.append(RECORDING.starts, len(states) + 10),
        states=np.concatenate([states, newcomer]),
    )
    assert not np.array_equal(states, RECORDING.states)
    same(scene_at(tick, other), scene_at(tick))


def test_actions() -> None:
    """They are what the cars did: braking by 1.5 m/s², circling at 0.18 rad, going straight."""
    scene = scene_at(18)  # 0.6 s to 3.6 s, slots in the order of ids up to 6
    assert scene.actions.shape[2] == scene.history == 15
    for slot, action in ((0, (0, 0)), (1, (-1.5, 0)), (5, (0, 0.18))):
        expected = np.tile(np.array(action), (15, 1))
        np.testing.assert_allclose(scene.actions[0, slot], expected, atol=1e-3)


def test_actions_need_both_ends() -> None:
    """No action leads into or out of an unseen tick, not even for an agent without a size."""
    states = np.zeros((1, 4, 4), dtype=np.float32)
    states[0, :, 3] = [1, 2, 3, 5]
    valid = np.array([[False, True, True, True]])
    actions = infer_actions(states, valid, np.array([4.0], dtype=np.float32), 0.5)
    np.testing.assert_allclose(actions, [[(0, 0), (2, 0), (4, 0)]])
    nobody = infer_actions(states, ~valid & False, np.zeros(1, dtype=np.float32), 0.5)
    assert not nobody.any()
    assert nobody.dtype == np.float32


def test_maps() -> None:
    """Recordings of one place share a map; each situation knows its own."""
    here = make_map()
    recordings = [
        make_recording(name="00", road_map=here),
        make_recording(name="01", road_map=make_map()),
        make_recording(name="02", road_map=here),
    ]
    index = index_snippets(recordings, dt_s=0.2, horizon_s=3.0)
    scene = gather_scene(recordings, index.select(index.tick == 15))
    assert len(scene.maps) == 2
    assert scene.map_index.tolist() == [0, 1, 0]
    assert scene.maps[0] is here


def test_predictable() -> None:
    """A car seen throughout is; one seen late, a bicycle and an empty slot are not."""
    scene = scene_at(15).with_targets(np.array([(0, 0), (0, 6), (0, 8)]))
    assert scene.predictable.tolist() == [True, False, False]  # car, bicycle, pedestrian
    late = SnippetIndex(
        recording=np.zeros(1, dtype=np.int64),
        track=np.array([6]),
        tick=np.array([30]),
        dt_s=0.2,
        history=15,
        horizon=15,
    )
    assert gather_scene([RECORDING], late).predictable.tolist() == [False]  # comes at tick 20


def test_time_step() -> None:
    """A predictor made for another time step is refused, one for the same is not."""
    scene = scene_at(15)
    scene.check_dt(0.2, "it")
    scene.check_dt(math.nextafter(0.2, 1), "it")
    with pytest.raises(AspEnvError, match=r"it was made for a time step of 0\.1 s.* has 0\.2 s"):
        scene.check_dt(0.1, "it")
