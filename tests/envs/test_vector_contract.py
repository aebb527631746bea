"""`ReplayVectorEnv`: memory, seeds, options, autoreset modes and errors."""

import copy
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.vector import AutoresetMode
from gymnasium.wrappers.vector import DictInfoToList, RecordEpisodeStatistics

from asp_env.envs.vector import ReplayVectorEnv
from asp_env.errors import AspEnvError
from asp_env.sim.reward import REWARD_TERMS
from tests.envs.same import same

ZERO_ACTIONS = np.zeros((3, 2), dtype=np.float32)


def _make(crossing: str, **options: Any) -> ReplayVectorEnv:
    return ReplayVectorEnv(3, crossing, **{"observations": ("state", "vectors"), **options})


def _arrays(returned: Any) -> list[np.ndarray]:
    """All arrays of numbers in what an environment returned."""
    if isinstance(returned, dict):
        returned = list(returned.values())
    if isinstance(returned, list | tuple):
        return [array for each in returned for array in _arrays(each)]
    is_numeric = isinstance(returned, np.ndarray) and returned.dtype != object
    return [returned] if is_numeric else []


@pytest.mark.parametrize("mode", list(AutoresetMode), ids=lambda mode: mode.value)
def test_referenced_arrays_are_never_overwritten(crossing, mode):
    """Whole arrays, views of them and tensors on them."""
    envs = _make(crossing, autoreset_mode=mode, observations=("state", "vectors", "raster"))
    arrays = _arrays(envs.reset(seed=0))
    copies: list[tuple[Any, bytes]] = [(array, array.tobytes()) for array in arrays]
    rng = np.random.default_rng(0)
    for step in range(40):
        returned = envs.step(rng.uniform((0.0, -0.5), (1.0, 0.5), size=(3, 2)))
        if step % 3 == 0:
            keep = _arrays(returned)
        elif step % 3 == 1:
            keep = [array[1:, ...] for array in _arrays(returned)]
        else:
            keep = [torch.from_numpy(array).numpy() for array in _arrays(returned)]
        copies += [(array, array.tobytes()) for array in keep]
        over = returned[2] | returned[3]
        if mode is AutoresetMode.DISABLED and over.any():
            envs.reset(options={"reset_mask": over.copy()})
        del returned, keep
    assert all(array.tobytes() == bits for array, bits in copies)


def test_unreferenced_arrays_are_reused(crossing):
    """A caller that keeps only the latest observation gets at most three arrays."""
    envs = _make(crossing)
    envs.reset(seed=0)
    addresses = {envs.step(ZERO_ACTIONS)[0]["lines"].ctypes.data for _ in range(30)}
    assert len(addresses) <= 3


def test_seeds(crossing):
    """Environments count up from one seed; a list has a seed for each."""
    first = _make(crossing).reset(seed=7)
    same(_make(crossing).reset(seed=[7, 8, 9]), first)
    envs = _make(crossing)
    envs.reset(seed=7)
    assert envs.np_random_seed == (7, 8, 9)
    assert len(envs.np_random) == 3
    before = envs.np_random[0].bit_generator.state
    envs.reset(seed=[None, 1, None])
    assert envs.np_random_seed == (7, 1, 9)
    assert envs.np_random[0].bit_generator.state != before


def test_options_for_all_and_for_each(crossing):
    envs = _make(crossing)
    names = [scenario.name for scenario in envs.scenarios]
    infos = envs.reset(options={"scenario": 2})[1]
    assert infos["scenario"].tolist() == [names[2]] * 3
    infos = envs.reset(options={"scenario": [0, names[4], np.int64(1)]})[1]
    assert infos["scenario"].tolist() == [names[0], names[4], names[1]]
    infos = envs.reset(options={"ego": [1, 2, 6]})[1]
    assert envs.scene().ids[:, 0].tolist() == [1, 2, 6]


def test_reset_does_not_change_the_options(crossing):
    envs = _make(crossing, autoreset_mode="Disabled")
    envs.reset(seed=0)
    options = {"reset_mask": np.array([True, False, False]), "scenario": 1}
    envs.reset(options=options)
    assert set(options) == {"reset_mask", "scenario"}


@pytest.mark.parametrize(
    ("mask", "message"),
    [
        ([True, False, False], "expected a bool array"),
        (np.array([1, 0, 0]), "expected a bool array"),
        (np.array([True, False]), "expected a bool array"),
        (np.zeros(3, dtype=bool), "with a true entry"),
    ],
    ids=["list", "numbers", "two", "empty"],
)
def test_invalid_masks_are_rejected(crossing, mask, message):
    """The episodes continue."""
    envs = _make(crossing, autoreset_mode=AutoresetMode.DISABLED)
    envs.reset(seed=0)
    with pytest.raises(AspEnvError, match=message):
        envs.reset(options={"reset_mask": mask})
    envs.step(ZERO_ACTIONS)


def test_the_first_reset_is_of_all_environments(crossing):
    """Steps, scenes and snapshots need it."""
    envs = _make(crossing, autoreset_mode="Disabled")
    with pytest.raises(gymnasium.error.ResetNeeded, match="reset all"):
        envs.reset(options={"reset_mask": np.array([True, False, True])})
    for call in (lambda: envs.step(ZERO_ACTIONS), envs.scene, envs.snapshot):
        with pytest.raises(gymnasium.error.ResetNeeded):
            call()


def test_finished_episodes_need_a_reset_in_mode_disabled(crossing):
    envs = _make(crossing, autoreset_mode="Disabled")
    envs.reset(options={"scenario": [1, 5, 1]})
    returned = [envs.step(ZERO_ACTIONS) for _ in range(35)][-1]
    assert returned[2].tolist() == [False, True, False]
    with pytest.raises(gymnasium.error.ResetNeeded, match=r"the episodes \[1\] are over"):
        envs.step(ZERO_ACTIONS)
    obs, infos = envs.reset(options={"reset_mask": returned[2].copy(), "scenario": 0})
    assert infos["_scenario"].tolist() == [False, True, False]
    assert infos["tick"].tolist() == [0, 0, 0]
    for name in obs:
        assert obs[name][[0, 2]].tobytes() == returned[0][name][[0, 2]].tobytes()
    assert envs.step(ZERO_ACTIONS)[4]["tick"].tolist() == [36, 1, 36]


def test_actions_of_resetting_episodes_are_ignored(crossing):
    envs = _make(crossing)
    envs.reset(options={"scenario": [1, 5, 1]})
    returned = [envs.step(ZERO_ACTIONS) for _ in range(35)][-1]
    assert returned[2].tolist() == [False, True, False]
    invalid = np.array([(0.0, 0.0), (np.nan, np.inf), (0.0, 0.0)])
    returned = envs.step(invalid)
    assert returned[1][1] == 0.0
    assert returned[4]["tick"].tolist() == [36, 0, 36]
    with pytest.raises(AspEnvError, match=r"action \[nan, inf\]"):
        envs.step(invalid)


@pytest.mark.parametrize(
    ("actions", "message"),
    [
        (np.zeros(2), r"shape \(2,\).*\(3, 2\)"),
        (np.zeros((2, 2)), r"shape \(2, 2\)"),
        (np.full((3, 2), np.nan), r"action \[nan, nan\]"),
        ([[0, 0], [0], [0, 0]], "for each environment"),
        (None, "for each environment"),
    ],
    ids=["single", "two", "nan", "ragged", "nothing"],
)
def test_invalid_actions_are_rejected(crossing, actions, message):
    """The episodes continue with valid ones."""
    envs = _make(crossing)
    envs.reset(seed=0)
    with pytest.raises(AspEnvError, match=message) as caught:
        envs.step(actions)
    assert "\n" not in str(caught.value)
    assert envs.step(ZERO_ACTIONS)[4]["tick"].tolist() == [1, 1, 1]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"num_envs": 0}, "num_envs 0: expected a whole number of at least 1"),
        ({"autoreset_mode": "Later"}, "autoreset_mode 'Later': expected one of NextStep"),
        ({"observation": ("state",)}, r"unexpected keyword argument 'observation'; did you mean"),
        ({"render_mode": "ansi"}, "render mode 'ansi'"),
    ],
    ids=lambda value: next(iter(value)) if isinstance(value, dict) else None,
)
def test_invalid_arguments_are_rejected(crossing, options, message):
    with pytest.raises(AspEnvError, match=message):
        ReplayVectorEnv(**{"num_envs": 3, "data": crossing, **options})


@pytest.mark.parametrize(
    ("reset", "message"),
    [
        ({"seed": [1, 2]}, "2 seeds: expected 3"),
        ({"options": {"scenario": [1, 2]}}, "of 2 values: expected one or 3"),
        ({"options": {"scenari": 1}}, "unknown reset option 'scenari'"),
    ],
)
def test_invalid_resets_are_rejected(crossing, reset, message):
    with pytest.raises(AspEnvError, match=message):
        _make(crossing).reset(**reset)


@pytest.mark.skipif(
    gymnasium.__version__ == "1.2.0",
    reason="DictInfoToList of Gymnasium 1.2.0 fails on RecordEpisodeStatistics of Gymnasium 1.2.0",
)
def test_gymnasiums_wrappers_of_infos(crossing):
    """`DictInfoToList` and `RecordEpisodeStatistics`."""
    envs = DictInfoToList(RecordEpisodeStatistics(_make(crossing)))
    envs.reset(options={"scenario": [1, 5, 1]})
    infos: Any = [envs.step(ZERO_ACTIONS)[4] for _ in range(35)][-1]
    assert "episode" not in infos[0]
    assert infos[1]["episode"]["l"] == 35
    assert infos[1]["ending"] == "GOAL"
    assert tuple(infos[1]["reward_terms"]) == REWARD_TERMS


def test_gymnasium_makes_the_vector_environment(crossing):
    """Without warnings, with its id, batched spaces and the autoreset mode in the metadata."""
    envs = gymnasium.make_vec(
        "asp_env/Replay-v0",
        num_envs=3,
        vectorization_mode="vector_entry_point",
        data=crossing,
        observations=("state",),
    )
    assert isinstance(envs, ReplayVectorEnv)
    assert str(envs) == "ReplayVectorEnv(asp_env/Replay-v0, num_envs=3)"
    assert envs.metadata["autoreset_mode"] is AutoresetMode.NEXT_STEP
    assert "autoreset_mode" not in ReplayVectorEnv.metadata
    assert isinstance(envs.observation_space, gymnasium.spaces.Dict)
    assert envs.observation_space["state"].shape == (3, 9)
    assert envs.reset(seed=0)[0] in envs.observation_space
    envs.close()
    envs.close()


def test_a_deep_copy_continues_in_the_same_way(crossing):
    """It shares the recordings."""
    envs = _make(crossing)
    envs.reset(seed=0)
    twin = copy.deepcopy(envs)
    assert twin.recordings is envs.recordings
    same([twin.step(ZERO_ACTIONS) for _ in range(90)], [envs.step(ZERO_ACTIONS) for _ in range(90)])
