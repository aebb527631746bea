"""Traffic signals of recordings and scenes."""

import dataclasses

import numpy as np
import pytest

from asp_env.data.causal import causal_histories
from asp_env.data.recording import Recording
from asp_env.data.scenarios import find_scenarios
from asp_env.data.signals import Signals, SignalState
from asp_env.data.snippets import gather_scene, gather_signals, index_snippets
from asp_env.errors import DataError
from asp_env.sim.world import ReplayWorld
from predictors.delayed import Delayed
from predictors.plugs import ConstantVelocity
from tests.builders import make_recording

STOP_LINE = ((-5.0, 0.0), (-5.0, -3.5))
RED_FRAMES = 250
"""The signal of `with_signal` is red for 10 s at 25 Hz, then green."""


def with_signal(**options: object) -> Recording:
    """The synthetic crossing with one signal."""
    recording = make_recording(**options)  # pyright: ignore[reportArgumentType]
    states = np.full((1, recording.num_frames), SignalState.GREEN, dtype=np.int8)
    states[:, :RED_FRAMES] = SignalState.RED
    return dataclasses.replace(
        recording, signals=Signals(stop_lines=np.array([STOP_LINE]), states=states)
    )


def test_scene_shows_the_states_up_to_now() -> None:
    """Ticks of five frames: tick 49 is frame 245 and red, tick 50 is frame 250 and green."""
    signals = gather_signals([with_signal()] * 2, np.array([49, 52]), history=3, dt_s=0.2)
    assert signals is not None
    np.testing.assert_array_equal(signals.stop_lines, [[STOP_LINE]] * 2)
    red, green = SignalState.RED, SignalState.GREEN
    assert signals.states.tolist() == [[[red] * 4], [[red, green, green, green]]]


def test_ticks_outside_the_recording_are_unknown() -> None:
    """It has 501 frames: tick 100 is the last one."""
    signals = gather_signals([with_signal()] * 2, np.array([1, 101]), history=2, dt_s=0.2)
    assert signals is not None
    assert signals.states[0, 0].tolist() == [0, SignalState.RED, SignalState.RED]
    assert signals.states[1, 0].tolist() == [SignalState.GREEN, SignalState.GREEN, 0]


def test_recordings_without_signals() -> None:
    """None alone; unknown beside a recording that has signals."""
    bare = make_recording()
    assert gather_signals([bare], np.array([20]), history=1, dt_s=0.2) is None
    both = gather_signals([bare, with_signal()], np.array([20, 20]), history=1, dt_s=0.2)
    assert both is not None
    assert both.states[:, 0].tolist() == [[0, 0], [1, 1]]
    assert not both.stop_lines[0].any()


def test_snippets_and_episodes_show_the_same() -> None:
    recordings = [with_signal()]
    scenarios = find_scenarios(recordings, source="crossing", dt_s=0.2, history=15)
    world = ReplayWorld(recordings, num_episodes=1, dt_s=0.2, history=15)
    world.reset([scenarios[0]], [np.random.default_rng(0)])
    seen = set()
    for _ in range(20):
        scene = world.scene()
        expected = gather_signals(recordings, scene.tick, history=15, dt_s=0.2)
        assert scene.signals is not None
        assert expected is not None
        np.testing.assert_array_equal(scene.signals.states, expected.states)
        np.testing.assert_array_equal(scene.signals.stop_lines, expected.stop_lines)
        seen |= set(scene.signals.states[0, 0].tolist())
        world.step(np.zeros((1, scene.ids.shape[1], 2)), np.zeros(scene.ids.shape, dtype=bool))
    assert seen <= {SignalState.RED, SignalState.GREEN}


def test_situation_and_causal_histories_have_the_signals() -> None:
    recordings = causal_histories([with_signal()])
    index = index_snippets(recordings, dt_s=0.2, horizon_s=3.0)
    scene = gather_scene(recordings, index)
    assert scene.signals is not None
    situation = len(scene.tick) - 1
    signals = scene.situation(situation).signals
    assert signals is not None
    np.testing.assert_array_equal(signals.states, scene.signals.states[[situation]])
    assert {int(state) for state in scene.signals.states[:, 0, -1]} == {1, 3}
    twice = scene.signals.of_situations(np.array([situation, 0, situation]))
    np.testing.assert_array_equal(twice.states[[0, 2]], signals.states.repeat(2, axis=0))
    np.testing.assert_array_equal(twice.stop_lines[1], scene.signals.stop_lines[0])


def test_a_delayed_predictor_shows_the_signals_of_then() -> None:
    """Two ticks ago tick 51 was tick 49, when the signal was red."""
    index = index_snippets([with_signal()], dt_s=0.2, horizon_s=3.0)
    index = index.select(np.flatnonzero(index.tick == 51))
    scene = gather_scene([with_signal()], index)
    shown = []

    class Watcher(ConstantVelocity):
        def predict(self, scene, future=None):
            assert scene.signals is not None
            shown.append(scene.signals.states[:, 0].tolist())
            return super().predict(scene, future)

    inner = Watcher.from_name("", horizon=15, dt_s=0.2)
    Delayed(inner=inner, ticks=2, horizon=13).predict(scene)
    assert shown == [[[SignalState.RED] * 14]]


@pytest.mark.parametrize(
    ("lines", "states", "message"),
    [
        (np.zeros((2, 2, 2)), np.zeros((1, 5), dtype=np.int8), "2 stop lines but .* 1 signals"),
        (np.full((1, 2, 2), np.inf), np.zeros((1, 5), dtype=np.int8), "expected finite"),
        (np.zeros((1, 2, 2)), np.full((1, 5), 4, dtype=np.int8), r"0 \(unknown\), 1 \(red\)"),
    ],
)
def test_wrong_signals_are_rejected(lines: np.ndarray, states: np.ndarray, message: str) -> None:
    with pytest.raises(DataError, match=message):
        Signals(stop_lines=lines, states=states)


def test_signals_of_another_length_are_rejected() -> None:
    signals = Signals(stop_lines=np.zeros((1, 2, 2)), states=np.zeros((1, 5), dtype=np.int8))
    with pytest.raises(DataError, match="signals with 5 frames, expected 501"):
        dataclasses.replace(make_recording(), signals=signals)
