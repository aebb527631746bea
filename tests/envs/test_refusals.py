"""What the environment refuses, each in one line that tells what to do."""

import gymnasium
import numpy as np
import pytest

from asp_env.envs.replay import ReplayEnv
from asp_env.errors import AspEnvError


@pytest.mark.parametrize(
    ("options", "what"),
    [
        ({"observations": ("stat",)}, r"unknown observation 'stat' \(did you mean 'state'"),
        ({"observations": ()}, "no observation given"),
        ({"view": "chaufeurnet"}, r"unknown view 'chaufeurnet' \(did you mean 'chauffeurnet'"),
        ({"raster_px": (90, 61)}, "square pixels"),
        ({"traffic": "idn"}, r"unknown driver 'idn' \(did you mean 'idm'"),
        ({"dt_s": 0.13}, "0.13 s"),
        ({"dt_s": 0.15}, "does not divide recordings of 25 Hz"),
        ({"reward_weights": {"progres": 2.0}}, "unknown reward weight 'progres'"),
        ({"reward_weights": {"comfort": float("nan")}}, "expected a finite number"),
        ({"render_mode": "ansi"}, "expected human, rgb_array or None"),
    ],
    ids=lambda value: next(iter(value)) if isinstance(value, dict) else None,
)
def test_a_wrong_argument_is_refused(crossing, options, what):
    """An `AspEnvError` of one line that names what is expected."""
    with pytest.raises(AspEnvError, match=what) as caught:
        ReplayEnv(crossing, **options)
    assert "\n" not in str(caught.value)


def test_data_that_is_not_there_is_refused(tmp_path):
    """A folder that does not exist, and a sample that is not shipped."""
    with pytest.raises(AspEnvError, match="does not exist"):
        ReplayEnv(str(tmp_path / "nothing"))
    with pytest.raises(AspEnvError, match="unknown sample 'motorway'"):
        ReplayEnv("sample:motorway")


@pytest.mark.parametrize(
    ("options", "what"),
    [
        ({"scenari": 3}, r"unknown reset option 'scenari' \(did you mean 'scenario'"),
        ({"scenario": 6}, "scenario 6: expected 0 to 5"),
        ({"scenario": -1}, "scenario -1: expected 0 to 5"),
        ({"scenario": 1.5}, "scenario 1.5: expected 0 to 5"),
        ({"scenario": "first"}, "unknown scenario 'first'"),
    ],
)
def test_a_wrong_reset_option_is_refused(crossing, options, what):
    """The error says which scenarios there are."""
    with pytest.raises(AspEnvError, match=what):
        ReplayEnv(crossing, observations=("state",)).reset(options=options)


@pytest.mark.parametrize(
    ("action", "what"),
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
def test_a_wrong_action_is_refused(crossing, action, what):
    """One line, and the episode can go on with a right one."""
    env = ReplayEnv(crossing, observations=("state",))
    env.reset(seed=0)
    with pytest.raises(AspEnvError, match=what) as caught:
        env.step(action)
    assert "\n" not in str(caught.value)
    info = env.step(np.zeros(2))[4]
    assert info["tick"] == 1


def test_nothing_happens_before_reset(crossing):
    """Step, scene and render ask for a reset first."""
    env = ReplayEnv(crossing, observations=("state",), render_mode="rgb_array")
    for ask in (lambda: env.step(np.zeros(2)), env.scene, env.render):
        with pytest.raises(gymnasium.error.ResetNeeded):
            ask()
