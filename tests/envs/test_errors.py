"""Errors of the single environment: one line that names what was given and what is expected."""

import gymnasium
import numpy as np
import pytest

from asp_env.envs.replay import ReplayEnv
from asp_env.errors import AspEnvError


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"observations": ("stat",)}, r"unknown observation 'stat' \(did you mean 'state'"),
        ({"observations": ()}, "no observation given"),
        ({"view": "chaufeurnet"}, r"unknown view 'chaufeurnet' \(did you mean 'chauffeurnet'"),
        ({"raster_px": (90, 61)}, "square pixels"),
        ({"traffic": "idn"}, r"unknown driver 'idn' \(did you mean 'idm'"),
        ({"dt_s": 0.13}, "0.13 s"),
        ({"dt_s": 0.07}, "3 s is no whole number of ticks of 0.07 s: choose"),
        ({"reward_weights": {"progres": 2.0}}, "unknown reward weight 'progres'"),
        ({"reward_weights": {"comfort": float("nan")}}, "expected a finite number"),
        ({"render_mode": "ansi"}, "expected human, rgb_array or None"),
    ],
    ids=lambda value: next(iter(value)) if isinstance(value, dict) else None,
)
def test_invalid_arguments_are_rejected(crossing, options, message):
    with pytest.raises(AspEnvError, match=message) as caught:
        ReplayEnv(crossing, **options)
    assert "\n" not in str(caught.value)


def test_missing_data_are_rejected(tmp_path):
    with pytest.raises(AspEnvError, match="does not exist"):
        ReplayEnv(str(tmp_path / "nothing"))
    with pytest.raises(AspEnvError, match="unknown sample 'motorway'"):
        ReplayEnv("sample:motorway")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"scenari": 3}, r"unknown reset option 'scenari' \(did you mean 'scenario'"),
        ({"scenario": 6}, "scenario 6: expected 0 to 5"),
        ({"scenario": -1}, "scenario -1: expected 0 to 5"),
        ({"scenario": 1.5}, "scenario 1.5: expected 0 to 5"),
        ({"scenario": "first"}, "unknown scenario 'first'"),
    ],
)
def test_invalid_reset_options_are_rejected(crossing, options, message):
    with pytest.raises(AspEnvError, match=message):
        ReplayEnv(crossing, observations=("state",)).reset(options=options)


@pytest.mark.parametrize(
    ("action", "message"),
    [
        (np.array([np.nan, 0.0]), "expected two finite numbers"),
        (np.array([0.0, np.inf]), "expected two finite numbers"),
        (np.zeros(3), r"shape \(3,\): expected two"),
        (np.zeros((100, 100)), r"shape \(100, 100\): expected two"),
        (0.5, r"shape \(\): expected two"),
        ("left", "expected two finite numbers"),
        (None, "expected"),
    ],
    ids=["nan", "infinite", "three", "table", "number", "text", "nothing"],
)
def test_invalid_actions_are_rejected(crossing, action, message):
    """The episode continues with a valid one."""
    env = ReplayEnv(crossing, observations=("state",))
    env.reset(seed=0)
    with pytest.raises(AspEnvError, match=message) as caught:
        env.step(action)
    assert "\n" not in str(caught.value)
    info = env.step(np.zeros(2))[4]
    assert info["tick"] == 1


def test_step_scene_and_render_need_a_reset(crossing):
    env = ReplayEnv(crossing, observations=("state",), render_mode="rgb_array")
    for call in (lambda: env.step(np.zeros(2)), env.scene, env.render):
        with pytest.raises(gymnasium.error.ResetNeeded):
            call()
