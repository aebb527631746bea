"""Options as configuration files, specifications and players give them."""

import pickle
import sys
import warnings
from collections.abc import Iterator, Sequence
from typing import Any

import gymnasium
import numpy as np
import pygame
import pytest
from gymnasium.envs.registration import EnvSpec
from gymnasium.wrappers.vector import HumanRendering

import asp_env
from asp_env.envs.keyboard import KEYS, keyboard_actions
from asp_env.envs.options import raster_size
from asp_env.envs.replay import ReplayEnv
from tests.envs.same import same

OPTIONS: dict[str, Any] = {"observations": ("state",), "render_mode": "rgb_array"}


class _Listed(Sequence[Any]):
    """A sequence that is neither a list nor a tuple, as OmegaConf's `ListConfig`."""

    def __init__(self, *values: Any) -> None:
        self._values = values

    def __getitem__(self, index: Any) -> Any:
        return self._values[index]

    def __len__(self) -> int:
        return len(self._values)

    def __iter__(self) -> Iterator[Any]:
        return iter(self._values)


def test_any_sequence_is_accepted_for_a_list(crossing):
    """Observations, pixels, times of forecasts, and options of a vector environment's reset."""
    given: dict[str, Any] = {
        "observations": _Listed("raster", "state"),
        "raster_px": _Listed(45, 30),
        "predictor": "constant-velocity",
        "forecast": {"at_s": _Listed(1.0, 2.0)},
    }
    expected = {
        "observations": ("raster", "state"),
        "raster_px": (45, 30),
        "predictor": "constant-velocity",
        "forecast": {"at_s": (1.0, 2.0)},
    }
    one, other = (asp_env.ReplayVectorEnv(2, crossing, **each) for each in (given, expected))
    same(
        list(one.reset(seed=0, options={"scenario": _Listed(1, 2)})),
        list(other.reset(seed=0, options={"scenario": [1, 2]})),
    )


def test_hydras_configurations_are_accepted(crossing):
    omegaconf = pytest.importorskip("omegaconf")
    config = omegaconf.OmegaConf.create(
        {
            "observations": ["raster", "state"],
            "raster_px": [45, 30],
            "reward_weights": {"comfort": 0.1},
            "traffic": {"car": "idm", "default": "log"},
        }
    )
    env = gymnasium.make("asp_env/Replay-v0", data=crossing, **config)
    assert env.reset(seed=0)[0]["raster"].shape == (12, 45, 30)


def test_raster_px_is_one_number_or_two(crossing):
    env = ReplayEnv(crossing, observations=("raster",), raster_px=24)
    assert env.reset(seed=0)[0]["raster"].shape == (12, 24, 24)
    assert raster_size(96) == raster_size((96, 96)) == (96, 96)
    assert raster_size(None) is None
    for wrong in ((1, 2, 3), (24,), True):
        with pytest.raises(asp_env.AspEnvError, match="expected height and width in pixels"):
            raster_size(wrong)


@pytest.mark.parametrize("suffix", ["", "Vectors", "State"])
def test_specifications_go_through_json(crossing, suffix):
    """With the wrapper `FlatParts` where observations are tables."""
    env: Any = gymnasium.make(f"asp_env/Replay{suffix}-v0", data=crossing)
    env = env if suffix else asp_env.FlatParts(env)
    assert env.spec is not None
    again = gymnasium.make(EnvSpec.from_json(env.spec.to_json()))
    assert again.observation_space == env.observation_space
    same(again.reset(seed=0)[0], env.reset(seed=0)[0])


def test_a_pickled_environment_continues_in_the_same_way(crossing):
    env = gymnasium.make("asp_env/Replay-v0", data=crossing, traffic="idm", **OPTIONS)
    env.reset(seed=0)
    env.step(np.zeros(2))
    twin = pickle.loads(pickle.dumps(env))
    for _ in range(5):
        same(list(env.step(np.zeros(2))), list(twin.step(np.zeros(2))))
    same(env.render(), twin.render())


def test_frame_rates_are_whole_numbers(crossing):
    """`gymnasium.utils.play` and `RecordVideo` require them: of ticks, or of held actions."""
    expected: list[tuple[dict[str, Any], int]] = [
        ({}, 5),
        ({"action_repeat": 5}, 1),
        ({"dt_s": 0.04}, 25),
    ]
    for options, fps in expected:
        single = ReplayEnv(crossing, **OPTIONS, **options)
        vector = asp_env.ReplayVectorEnv(2, crossing, **OPTIONS, **options)
        for env in (single, vector):
            assert type(env.metadata["render_fps"]) is int
            assert env.metadata["render_fps"] == fps
    parallel = asp_env.parallel_env(crossing, **OPTIONS)
    assert parallel.metadata["render_fps"] == 5


def test_videos_have_the_frame_rate_of_the_episode(crossing, tmp_path):
    """Those of Gymnasium, of its vector environments and of stable-baselines3."""
    pytest.importorskip("moviepy")
    from gymnasium.wrappers import RecordVideo
    from gymnasium.wrappers.vector import RecordVideo as VectorRecordVideo
    from stable_baselines3.common.vec_env import VecVideoRecorder

    single = RecordVideo(ReplayEnv(crossing, **OPTIONS), str(tmp_path / "single"))
    vector = VectorRecordVideo(
        asp_env.ReplayVectorEnv(2, crossing, **OPTIONS), str(tmp_path / "vector")
    )
    adapter = VecVideoRecorder(
        asp_env.sb3_vec_env(2, crossing, **OPTIONS), str(tmp_path / "sb3"), lambda step: step == 0
    )
    assert single.frames_per_sec == vector.frames_per_sec == adapter.frames_per_sec == 5


def test_play_drives_with_the_keyboard(crossing, monkeypatch):
    """W is pressed from the first frame on; the episode then runs until the window is closed."""
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    monkeypatch.setitem(sys.modules, "matplotlib", None)  # `play` would choose its backend
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        from gymnasium.utils.play import play
    seen: list[np.ndarray] = []

    def follow(before: Any, after: Any, action: np.ndarray, *rest: Any) -> None:
        del before, after, rest
        seen.append(action)
        if len(seen) == 1:
            pygame.event.post(pygame.Event(pygame.KEYDOWN, key=ord("w")))
        if len(seen) == 2:
            pygame.event.post(pygame.Event(pygame.KEYDOWN, key=pygame.K_LEFT))
        if len(seen) == 3:
            pygame.event.post(pygame.Event(pygame.QUIT))

    play(gymnasium.make("asp_env/Replay-v0", data=crossing, **OPTIONS), callback=follow, fps=1000)
    np.testing.assert_allclose(seen, [(0.0, 0.0), (0.4, 0.0), (0.4, 0.2)])


def test_keys_of_the_arrows_are_those_of_the_window():
    """Every combination of the eight keys has an action; opposite ones cancel or add up."""
    arrows = (pygame.K_UP, pygame.K_DOWN, pygame.K_LEFT, pygame.K_RIGHT)
    assert tuple(KEYS)[4:] == arrows
    actions = keyboard_actions()
    assert len(actions) == 2**8
    np.testing.assert_allclose(actions["w", pygame.K_UP], (0.4, 0.0))
    np.testing.assert_allclose(actions["a", "d"], (0.0, 0.0))
    assert np.abs(list(actions.values())).max() <= 1.0


def test_a_window_shows_a_vector_environment(crossing, monkeypatch):
    """Gymnasium's vector `HumanRendering`."""
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    envs = HumanRendering(asp_env.ReplayVectorEnv(2, crossing, **OPTIONS), screen_size=(400, 200))
    envs.reset(seed=0)
    envs.step(np.zeros((2, 2)))
    window = pygame.display.get_surface()
    assert window is not None
    assert window.get_size() == (400, 200)
    envs.close()


@pytest.mark.parametrize("mode", ["NextStep", "SameStep", "Disabled"])
def test_the_autoreset_mode_is_an_attribute(crossing, mode):
    """TorchRL reads it."""
    envs = asp_env.ReplayVectorEnv(2, crossing, autoreset_mode=mode, observations=("state",))
    assert envs.autoreset_mode is envs.metadata["autoreset_mode"]
    assert envs.autoreset_mode.value == mode
