"""What `ReplayVectorEnv` promises beside being equal: memory, seeds, options, refusals."""

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
from tests.envs.same import same

STILL = np.zeros((3, 2), dtype=np.float32)


def _make(crossing: str, **options: Any) -> ReplayVectorEnv:
    return ReplayVectorEnv(3, crossing, **{"observations": ("state", "vectors"), **options})


def _held(told: Any) -> list[np.ndarray]:
    """All arrays of numbers in what an environment returned."""
    if isinstance(told, dict):
        told = list(told.values())
    if isinstance(told, list | tuple):
        return [array for each in told for array in _held(each)]
    return [told] if isinstance(told, np.ndarray) and told.dtype != object else []


@pytest.mark.parametrize("mode", list(AutoresetMode), ids=lambda mode: mode.value)
def test_what_is_held_is_never_written_again(crossing, mode):
    """Whole arrays, views of them and tensors on them keep their bits while others are made."""
    envs = _make(crossing, autoreset_mode=mode, observations=("state", "vectors", "raster"))
    arrays = _held(envs.reset(seed=0))
    held: list[tuple[Any, bytes]] = [(array, array.tobytes()) for array in arrays]
    rng = np.random.default_rng(0)
    for step in range(40):
        told = envs.step(rng.uniform((0.0, -0.5), (1.0, 0.5), size=(3, 2)))
        if step % 3 == 0:
            keep = _held(told)
        elif step % 3 == 1:
            keep = [array[1:, ...] for array in _held(told)]
        else:
            keep = [torch.from_numpy(array).numpy() for array in _held(told)]
        held += [(array, array.tobytes()) for array in keep]
        over = told[2] | told[3]
        if mode is AutoresetMode.DISABLED and over.any():
            envs.reset(options={"reset_mask": over.copy()})
        del told, keep
    assert all(array.tobytes() == bits for array, bits in held)


def test_memory_is_used_again_once_nobody_holds_it(crossing):
    """Where the caller keeps only the latest observation, few arrays are made."""
    envs = _make(crossing)
    envs.reset(seed=0)
    places = {envs.step(STILL)[0]["lines"].ctypes.data for _ in range(30)}
    assert len(places) <= 3


def test_seeds(crossing):
    """A number seeds each environment with the next one; a list gives each its own."""
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
    """One value goes to all environments, a list gives each its own."""
    envs = _make(crossing)
    names = [scenario.name for scenario in envs.scenarios]
    infos = envs.reset(options={"scenario": 2})[1]
    assert infos["scenario"].tolist() == [names[2]] * 3
    infos = envs.reset(options={"scenario": [0, names[4], np.int64(1)]})[1]
    assert infos["scenario"].tolist() == [names[0], names[4], names[1]]
    infos = envs.reset(options={"ego": [1, 2, 6]})[1]
    assert envs.scene().ids[:, 0].tolist() == [1, 2, 6]


def test_options_are_not_changed(crossing):
    """The caller's mask is still there after the reset."""
    envs = _make(crossing, autoreset_mode="Disabled")
    envs.reset(seed=0)
    options = {"reset_mask": np.array([True, False, False]), "scenario": 1}
    envs.reset(options=options)
    assert set(options) == {"reset_mask", "scenario"}


@pytest.mark.parametrize(
    ("mask", "what"),
    [
        ([True, False, False], "expected a bool array"),
        (np.array([1, 0, 0]), "expected a bool array"),
        (np.array([True, False]), "expected a bool array"),
        (np.zeros(3, dtype=bool), "with a true entry"),
    ],
    ids=["list", "numbers", "two", "nobody"],
)
def test_a_wrong_mask_is_refused(crossing, mask, what):
    """The episodes go on."""
    envs = _make(crossing, autoreset_mode=AutoresetMode.DISABLED)
    envs.reset(seed=0)
    with pytest.raises(AspEnvError, match=what):
        envs.reset(options={"reset_mask": mask})
    envs.step(STILL)


def test_the_first_reset_is_of_all(crossing):
    """A mask that leaves somebody out who never began is refused; so are steps and scenes."""
    envs = _make(crossing, autoreset_mode="Disabled")
    with pytest.raises(gymnasium.error.ResetNeeded, match="reset all"):
        envs.reset(options={"reset_mask": np.array([True, False, True])})
    for ask in (lambda: envs.step(STILL), envs.scene, envs.snapshot):
        with pytest.raises(gymnasium.error.ResetNeeded):
            ask()


def test_disabled_waits_for_a_reset(crossing):
    """A step with a finished episode in it is refused, and says which it is."""
    envs = _make(crossing, autoreset_mode="Disabled")
    envs.reset(options={"scenario": [1, 5, 1]})
    told = [envs.step(STILL) for _ in range(35)][-1]
    assert told[2].tolist() == [False, True, False]
    with pytest.raises(gymnasium.error.ResetNeeded, match=r"the episodes \[1\] are over"):
        envs.step(STILL)
    obs, infos = envs.reset(options={"reset_mask": told[2].copy(), "scenario": 0})
    assert infos["_scenario"].tolist() == [False, True, False]
    assert infos["tick"].tolist() == [0, 0, 0]
    for name in obs:
        assert obs[name][[0, 2]].tobytes() == told[0][name][[0, 2]].tobytes()
    assert envs.step(STILL)[4]["tick"].tolist() == [36, 1, 36]


def test_actions_that_are_ignored_may_be_anything(crossing):
    """In the step that resets an episode, its action is not looked at."""
    envs = _make(crossing)
    envs.reset(options={"scenario": [1, 5, 1]})
    told = [envs.step(STILL) for _ in range(35)][-1]
    assert told[2].tolist() == [False, True, False]
    wild = np.array([(0.0, 0.0), (np.nan, np.inf), (0.0, 0.0)])
    told = envs.step(wild)
    assert told[1][1] == 0.0
    assert told[4]["tick"].tolist() == [36, 0, 36]
    with pytest.raises(AspEnvError, match=r"action \[nan, inf\]"):
        envs.step(wild)


@pytest.mark.parametrize(
    ("actions", "what"),
    [
        (np.zeros(2), r"shape \(2,\).*\(3, 2\)"),
        (np.zeros((2, 2)), r"shape \(2, 2\)"),
        (np.full((3, 2), np.nan), r"action \[nan, nan\]"),
        ([[0, 0], [0], [0, 0]], "for each environment"),
        (None, "for each environment"),
    ],
    ids=["single", "two", "nan", "ragged", "nothing"],
)
def test_wrong_actions_are_refused(crossing, actions, what):
    """One line; the episodes can go on with right ones."""
    envs = _make(crossing)
    envs.reset(seed=0)
    with pytest.raises(AspEnvError, match=what) as caught:
        envs.step(actions)
    assert "\n" not in str(caught.value)
    assert envs.step(STILL)[4]["tick"].tolist() == [1, 1, 1]


@pytest.mark.parametrize(
    ("options", "what"),
    [
        ({"num_envs": 0}, "num_envs 0: expected at least 1"),
        ({"autoreset_mode": "Later"}, "autoreset_mode 'Later': expected one of NextStep"),
        ({"observation": ("state",)}, r"unknown argument 'observation' \(did you mean"),
        ({"render_mode": "ansi"}, "render mode 'ansi'"),
    ],
    ids=lambda value: next(iter(value)) if isinstance(value, dict) else None,
)
def test_wrong_arguments_are_refused(crossing, options, what):
    """In one line."""
    with pytest.raises(AspEnvError, match=what):
        ReplayVectorEnv(**{"num_envs": 3, "data": crossing, **options})


@pytest.mark.parametrize(
    ("reset", "what"),
    [
        ({"seed": [1, 2]}, "2 seeds: expected 3"),
        ({"options": {"scenario": [1, 2]}}, "of 2 values: expected one or 3"),
        ({"options": {"scenari": 1}}, "unknown reset option 'scenari'"),
    ],
)
def test_wrong_resets_are_refused(crossing, reset, what):
    """In one line."""
    with pytest.raises(AspEnvError, match=what):
        _make(crossing).reset(**reset)


def test_gymnasiums_wrappers_understand_the_infos(crossing):
    """A list of dictionaries as of single environments; statistics of episodes."""
    envs = DictInfoToList(RecordEpisodeStatistics(_make(crossing)))
    envs.reset(options={"scenario": [1, 5, 1]})
    infos: Any = [envs.step(STILL)[4] for _ in range(35)][-1]
    assert "episode" not in infos[0]
    assert infos[1]["episode"]["l"] == 35
    assert infos[1]["ending"] == "GOAL"
    assert set(infos[1]["reward_terms"]) == {"progress", "comfort", "collision", "off_road"}


def test_made_by_gymnasium(crossing):
    """Without a warning; with its id, its spec, batched spaces, and the mode in the metadata."""
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


def test_a_deep_copy_goes_on_in_the_same_way(crossing):
    """And shares the recordings."""
    envs = _make(crossing)
    envs.reset(seed=0)
    twin = copy.deepcopy(envs)
    assert twin.recordings is envs.recordings
    same([twin.step(STILL) for _ in range(90)], [envs.step(STILL) for _ in range(90)])
