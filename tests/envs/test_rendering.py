"""Rendering of the single environment: images, the window, forecasts and plans."""

import copy
import subprocess
import sys
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pygame
import pytest
from gymnasium.utils.env_checker import check_env

from asp_env.data.predictor import constant_velocity, make_forecast
from asp_env.envs.replay import ReplayEnv
from asp_env.errors import AspEnvError, MissingExtraError
from asp_env.render.frames import draw_frame
from tests.render.screens import open_screen

ZERO_ACTION = np.zeros(2, dtype=np.float32)


def _make(crossing: str, mode: str | None = "rgb_array", **options: Any) -> ReplayEnv:
    env = ReplayEnv(crossing, observations=("state",), render_mode=mode, **options)
    env.reset(options={"scenario": 1})
    return env


def _forecast(env: ReplayEnv, steps: int = 10):
    scene = env.scene()
    states = constant_velocity(scene, steps=steps)[:, None]
    return make_forecast(
        scene,
        states=states,
        actions=None,
        log_probs=np.zeros((len(states), 1), dtype=np.float32),
        valid=np.ones(len(states), dtype=bool),
    )


def test_gymnasiums_checker_passes_in_human_mode(crossing):
    """It opens and closes every mode; warnings are errors."""
    made = gymnasium.make(
        "asp_env/Replay-v0", data=crossing, observations=("state",), render_mode="human"
    )
    check_env(made.unwrapped)


def test_the_window_shows_every_tick(crossing, monkeypatch):
    """After reset and after every step, for the length of a tick; `render` returns None."""
    env = ReplayEnv(crossing, observations=("state",), render_mode="human", dt_s=0.04)
    shown, waited = [], []
    assert env._live._window is not None
    monkeypatch.setattr(env._live._window, "show", shown.append)
    monkeypatch.setattr(env._live._window, "wait_s", waited.append)
    env.reset(options={"scenario": 1})
    for _ in range(3):
        env.step(ZERO_ACTION)
    assert len(shown) == 4
    assert waited == [pytest.approx(25.0)] * 4
    assert np.array_equal(shown[-1], draw_frame(env.scene()))
    assert env.render() is None
    env.show(forecast=_forecast(env))
    assert len(shown) == 6
    assert len(waited) == 4
    assert env.metadata["render_fps"] == 25
    assert ReplayEnv.metadata["render_fps"] == 5


def test_the_episode_continues_after_the_user_closes_the_window(crossing):
    """`close` may be called twice."""
    env = _make(crossing, "human")
    env.step(ZERO_ACTION)
    pygame.event.post(pygame.Event(pygame.QUIT))
    for _ in range(3):
        env.step(ZERO_ACTION)
    assert env._live._window is not None
    assert env._live._window.closed
    env.reset()
    env.close()
    env.close()
    never = ReplayEnv(crossing, observations=("state",), render_mode="human")
    never.close()
    never.close()


def test_a_copy_has_its_own_window(crossing):
    env = _make(crossing, "human")
    twin = copy.deepcopy(env)
    twin.step(ZERO_ACTION)
    assert env._live._window is not None
    assert twin._live._window is not None
    assert env._live._window._window is not twin._live._window._window
    twin.close()
    env.step(ZERO_ACTION)
    assert env._live._window._window is not None
    env.close()


def test_the_overlay_shows_the_remaining_ticks(crossing):
    """All 10 steps at first, 6 of them 4 ticks later, then none."""
    env = _make(crossing)
    bare = env.render()
    forecast = _forecast(env)
    plan = forecast.states[0, 0]
    env.show(forecast=forecast, plan=plan)
    shown = env.render()
    assert np.array_equal(shown, draw_frame(env.scene(), forecast=forecast, plan=plan))
    assert not np.array_equal(shown, bare)
    for _ in range(4):
        env.step(ZERO_ACTION)
    late = draw_frame(env.scene(), forecast=forecast, plan=plan[4:])
    assert np.array_equal(env.render(), late)
    assert not np.array_equal(late, draw_frame(env.scene()))
    for _ in range(6):
        env.step(ZERO_ACTION)
    assert np.array_equal(env.render(), draw_frame(env.scene()))


def test_show_without_arguments_and_reset_remove_the_overlay(crossing):
    env = _make(crossing)
    bare = env.render()
    env.show(forecast=_forecast(env))
    env.show()
    assert np.array_equal(env.render(), bare)
    env.show(forecast=_forecast(env))
    env.reset(options={"scenario": 1})
    assert np.array_equal(env.render(), bare)


def test_invalid_overlays_are_rejected(crossing):
    """A forecast of another scene, a plan of another shape, and values that are not finite."""
    env, other = _make(crossing), _make(crossing)
    other.reset(options={"scenario": 5})
    bare = env.render()
    with pytest.raises(AspEnvError, match=r"forecast: expected one of this environment's scene"):
        env.show(forecast=_forecast(other))
    for plan in (np.zeros(4), np.zeros((3, 1)), np.full((3, 2), np.nan)):
        with pytest.raises(AspEnvError, match="plan of shape"):
            env.show(plan=plan)
    broken = _forecast(env)
    broken.states[0, 0, 0, 0] = np.inf
    with pytest.raises(AspEnvError, match="finite"):
        env.show(forecast=broken)
    assert np.array_equal(env.render(), bare)
    with pytest.raises(gymnasium.error.ResetNeeded):
        ReplayEnv(crossing, observations=("state",)).show()


def test_rgb_array_list_collects_images(crossing):
    """`gymnasium.make` provides this mode: all images since the last call."""
    env = gymnasium.make(
        "asp_env/Replay-v0", data=crossing, observations=("state",), render_mode="rgb_array_list"
    )
    env.reset(seed=0)
    env.step(ZERO_ACTION)
    env.step(ZERO_ACTION)
    pictures: Any = env.render()
    assert [picture.shape for picture in pictures] == [(720, 720, 3)] * 3
    assert env.render() == []


def test_a_missing_package_is_reported_when_the_environment_is_made(crossing, monkeypatch):
    """Pictures need no package."""
    monkeypatch.setattr("asp_env.render.window.find_spec", lambda _: None)
    with pytest.raises(MissingExtraError, match=r"asp-env\[render\]"):
        ReplayEnv(crossing, render_mode="human")
    _make(crossing).render()


def test_a_screen_shows_the_environment(tmp_path: Path, crossing: str) -> None:
    """Under X, the window has the pixels of `rgb_array` for the same episode."""
    script = """
import sys
import numpy as np
from asp_env.envs.replay import ReplayEnv

for mode in ("rgb_array", "human"):
    env = ReplayEnv(sys.argv[1], observations=("state",), render_mode=mode)
    env.reset(options={"scenario": 1})
    for _ in range(3):
        env.step(np.zeros(2, dtype=np.float32))
    if mode == "rgb_array":
        np.save(sys.argv[2], env.render())
print("shown", flush=True)
sys.stdin.readline()
env.close()
env.close()
"""
    expected = tmp_path / "picture.npy"
    with open_screen(tmp_path) as screen:
        before = screen.look()
        done = subprocess.Popen(
            [sys.executable, "-c", script, crossing, str(expected)],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, env=screen.environment, text=True,
        )  # fmt: skip
        assert done.stdin is not None
        assert done.stdout is not None
        lines = iter(done.stdout.readline, "")
        assert "shown\n" in lines
        seen = screen.look()
        done.communicate("go on\n", timeout=60)
        assert done.returncode == 0
    picture = np.load(expected)
    changed = np.argwhere((seen != before).any(axis=-1))
    top, left = changed.min(axis=0)
    height, width = picture.shape[:2]
    assert np.array_equal(seen[top : top + height, left : left + width], picture)
