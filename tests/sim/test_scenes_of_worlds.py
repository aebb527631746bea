"""Scenes of a world: all of the present and the past, nothing of the future."""

import dataclasses

import numpy as np
import pytest

from asp_env.data.recording import Recording
from tests.builders import make_recording
from tests.sim.worlds import DT_S, HISTORY, drive, on_road, replay, scenario, simulate


def test_shapes_and_content_of_a_scene():
    """15 past ticks and now, actions between them; targets are the present agents but the ego."""
    recording = make_recording()
    simulation = simulate(recording, [scenario(1, length=20), scenario(3, start=30)])
    drive(simulation, [(0.0, 0.0)] * 2)
    scene = simulation.world.scene()
    agents = scene.ids.shape[1]
    assert scene.states.shape == (2, agents, 16, 4)
    assert scene.actions.shape == (2, agents, 15, 2)
    assert scene.tick.tolist() == [17, 32]
    assert scene.dt_s == DT_S
    present = {(b, a) for b, a in np.argwhere(scene.valid[..., -1]).tolist() if a}
    assert {(b, a) for b, a in scene.targets.tolist()} == present
    absent = ~scene.valid.any(axis=-1)
    assert absent.any()
    assert (scene.ids[absent] == -1).all()
    assert not scene.sizes[absent].any()
    assert not scene.states[~scene.valid].any()


def test_actions_of_a_scene_are_inferred_from_its_states():
    """After a step with (2 m/s², 0.1 rad) the last action of the ego is that."""
    simulation = simulate(on_road(), scenario())
    drive(simulation, [(2.0, 0.1)])
    action = simulation.world.scene().actions[0, 0, -1]
    assert action == pytest.approx([2.0, 0.1], abs=2e-3)


def _with_other_future(recording: Recording, frame: int, unchanged: int) -> Recording:
    """The recording with the rows of all tracks but one changed after a frame."""
    states = recording.states.copy()
    for track in range(len(recording)):
        first = int(recording.first_frames[track])
        rows = states[recording.starts[track] : recording.starts[track + 1]]
        if track != unchanged:
            rows[max(frame + 1 - first, 0) :, :3] += 7.0
    return dataclasses.replace(recording, states=states)


@pytest.mark.parametrize("traffic", ["log", "idm"])
def test_a_scene_holds_no_future(traffic):
    """Changing other tracks after the present frame leaves the bits of the scene unchanged."""
    recording = make_recording()
    steps, start = 8, HISTORY
    changed = _with_other_future(recording, frame=5 * start, unchanged=0)
    scenes = []
    for each in (recording, changed):
        scenes.append(simulate(each, scenario(1, start=start), traffic).world.scene())
    for field in dataclasses.fields(scenes[0]):
        before, after = (getattr(scene, field.name) for scene in scenes)
        if isinstance(before, np.ndarray):
            assert before.tobytes() == after.tobytes(), field.name
    if traffic == "log":
        late = _with_other_future(recording, frame=5 * (start + steps), unchanged=0)
        pair = [simulate(each, scenario(1, start=start)) for each in (recording, late)]
        for each in pair:
            replay(each, steps)
        first, second = (each.world.scene() for each in pair)
        assert first.states.tobytes() == second.states.tobytes()


def test_earlier_scenes_are_not_overwritten():
    """Steps and resets do not change the arrays of earlier scenes and events."""
    simulation = simulate(make_recording(), scenario(1))
    scene, events = simulation.world.scene(), simulation.world.events()
    arrays = {
        (kind, field.name): getattr(given, field.name)
        for kind, given in (("scene", scene), ("events", events))
        for field in dataclasses.fields(given)
        if isinstance(getattr(given, field.name), np.ndarray)
    }
    copies = {name: array.copy() for name, array in arrays.items()}
    drive(simulation, [(1.0, 0.1)] * 3)
    simulation.reset([scenario(3, start=20)], [np.random.default_rng(1)])
    drive(simulation, [(1.0, 0.1)] * 2)
    for name, array in arrays.items():
        assert array.tobytes() == copies[name].tobytes(), name
