"""Augmentation: what it changes, what it leaves, and what its draws depend on."""

import dataclasses

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from asp_env.data.scene import Scene
from asp_env.data.snippets import gather_scene, index_snippets
from asp_env.errors import AspEnvError
from asp_env.views import make_view
from predictors.models.batch import Batch, VectorTensors, make_batch
from predictors.models.network import rollout_from_now
from predictors.training.augmentation import (
    FAST_MPS,
    Augmentation,
    measured_again,
    off_the_map,
    one_situation_each,
    reshaped,
    reshaped_labels,
    sample_keys,
)
from predictors.training.data import Batches
from tests.builders import make_recording
from tests.predictors.tiny import draw_samples

ROWS = (8, 30, 41, 55)

NONE = Augmentation(
    mirrored=0.0,
    largest_scale=1.0,
    position_m=(1e-9, 1e-9),
    heading_rad=(1e-9, 1e-9),
    speed_mps=(1e-9, 1e-9),
    largest_size=1.0,
    absent_agents=0.0,
    late_agents=1e-9,
    map_offset_m=0.0,
    map_turn_rad=0.0,
    no_map=0.0,
    no_kind=0.0,
    no_line=0.0,
)
"""Ranges that change nothing."""


def scene_of(rows: tuple[int, ...] = ROWS) -> Scene:
    recordings = [make_recording()]
    index = index_snippets(recordings, dt_s=0.2, horizon_s=3.0)
    return one_situation_each(gather_scene(recordings, index.select(np.array(rows))))


def batches(rows: np.ndarray, size: int, ranges: Augmentation | None) -> Batches:
    recordings = [make_recording()]
    index = index_snippets(recordings, dt_s=0.2, horizon_s=3.0)
    whole = Batches(
        recordings,
        index,
        view=make_view("vectors"),
        batch_size=size,
        later_ticks=(15,),
        augmentation=ranges,
        seed=3,
    )
    return whole.reordered(rows, visited=100)


def tensors(batch: Batch) -> list[torch.Tensor]:
    observation = batch.observation
    assert isinstance(observation, VectorTensors)
    return [*observation, batch.actions, batch.motion, batch.length_m]


def test_ranges_of_nothing_change_nothing() -> None:
    (plain, labels), (same, same_labels) = (
        next(iter(batches(np.array(ROWS), 4, ranges))) for ranges in (None, NONE)
    )
    for before, after in zip(tensors(plain), tensors(same), strict=True):
        torch.testing.assert_close(after, before, atol=1e-4, rtol=1e-4)
    torch.testing.assert_close(same_labels.states, labels.states, atol=1e-4, rtol=1e-4)
    for before, after in zip(tensors(labels.later[0]), tensors(same_labels.later[0]), strict=True):
        torch.testing.assert_close(after, before, atol=1e-4, rtol=1e-4)


def test_a_sample_does_not_depend_on_its_batch() -> None:
    """Batches of one and of four snippets hold the same samples, bit for bit."""
    together = next(iter(batches(np.array(ROWS), 4, Augmentation())))
    alone = list(batches(np.array(ROWS), 1, Augmentation()))
    for row, (batch, labels) in enumerate(alone):
        for whole, part in zip(tensors(together[0]), tensors(batch), strict=True):
            assert torch.equal(whole[row : row + 1], part)
        assert torch.equal(together[1].states[row : row + 1], labels.states)


def test_a_snippet_looks_different_when_it_is_visited_again() -> None:
    first, again = (
        next(iter(batches(np.array(rows), 4, Augmentation())))[0].motion
        for rows in ((8, 30, 41, 55), (30, 8, 41, 55))
    )
    assert torch.equal(first[2:], again[2:])
    assert not torch.isclose(first[0], again[1]).any()


@given(seed=st.integers(0, 50))
def test_mirroring_and_scaling_map_trajectories_of_the_bicycle_model_to_others(seed: int) -> None:
    """The rollout of changed actions from a changed state is the changed rollout."""
    ranges = dataclasses.replace(NONE, mirrored=0.5, largest_scale=1.5)
    keys = sample_keys(seed, np.arange(4))
    before, _ = draw_samples(ROWS, view="vectors")
    after = reshaped(before, keys, ranges)
    rollouts = [
        rollout_from_now(batch.actions[:, None], batch, 0.2, "heun")[:, 0]
        for batch in (before, after)
    ]
    expected = reshaped_labels(rollouts[0], keys, ranges)
    torch.testing.assert_close(rollouts[1], expected, atol=1e-3, rtol=1e-3)


def test_a_mirrored_and_enlarged_sample_by_hand() -> None:
    """Left becomes right, and lengths and speeds grow by the same factor; directions stay units."""
    ranges = dataclasses.replace(NONE, mirrored=1.0)
    before, _ = draw_samples(ROWS, view="vectors")
    after = reshaped(before, sample_keys(0, np.arange(4)), ranges)
    seen, mirrored = before.observation, after.observation
    assert isinstance(seen, VectorTensors)
    assert isinstance(mirrored, VectorTensors)
    signs = torch.ones(seen.agents.shape[-1])
    signs[[1, 3]] = -1  # y and sin
    torch.testing.assert_close(mirrored.agents, seen.agents * signs)
    torch.testing.assert_close(after.motion, before.motion * torch.tensor([1.0, 1.0, -1.0]))
    torch.testing.assert_close(after.actions[..., 1], -before.actions[..., 1])


def test_errors_of_speeds_have_the_asked_deviation_and_correlation() -> None:
    """Speeds of 0.2 m/s with a time constant of 0.3 s: over 400 visits, within a tenth."""
    scene = scene_of((8,) * 400)
    ranges = dataclasses.replace(NONE, speed_mps=(0.2, 0.2), correlation_s=(0.3, 0.3))
    again = measured_again(scene, sample_keys(0, np.arange(400)), ranges)
    error = (again.states - scene.states)[np.arange(400), scene.targets[:, 1]]
    assert error[..., 3].std() == pytest.approx(0.2, rel=0.1)
    lag = np.corrcoef(error[:, 5, 3], error[:, 6, 3])[0, 1]
    assert lag == pytest.approx(np.exp(-0.2 / 0.3), abs=0.15)


def test_errors_of_speeds_belong_to_those_of_positions() -> None:
    """Half to all of the rate of the errors along the heading, which have the asked deviation."""
    scene = scene_of((8,) * 400)
    ranges = dataclasses.replace(NONE, position_m=(0.1, 0.1), smoothing_s=(0.4, 0.4))
    again = measured_again(scene, sample_keys(0, np.arange(400)), ranges)
    rows = (np.arange(400), scene.targets[:, 1])
    before, error = scene.states[rows], (again.states - scene.states)[rows]
    assert before[..., 3].min() > FAST_MPS
    assert error[..., :2].std() == pytest.approx(0.1, rel=0.1)
    along = error[..., 0] * np.cos(before[..., 2]) + error[..., 1] * np.sin(before[..., 2])
    rate = (along[:, 2:] - along[:, :-2]) / 0.4  # about 0.9 of the slope of such an error
    share = (rate * error[:, 1:-1, 3]).sum(axis=1) / (rate**2).sum(axis=1)
    assert 0.5 < share.min() < 0.6
    assert 0.95 < share.max() < 1.15


def test_the_target_is_always_seen() -> None:
    ranges = dataclasses.replace(NONE, absent_agents=1.0, late_agents=1.0)
    scene = scene_of()
    again = measured_again(scene, sample_keys(0, np.arange(4)), ranges)
    rows, slots = again.targets.T
    assert again.valid[rows, slots].all()
    assert again.valid.sum() < scene.valid.sum()
    assert not again.states[~again.valid].any()


def test_the_map_is_displaced_against_all_agents_alike() -> None:
    """Distances between agents, and angles between their headings, do not change."""
    scene = scene_of()
    ranges = dataclasses.replace(NONE, map_offset_m=1.0, map_turn_rad=0.2)
    about = scene.target_states[:, :2].astype(np.float64)
    moved = off_the_map(scene, about, sample_keys(1, np.arange(4)), ranges)
    for row in range(4):
        seen = scene.valid[row, :, -1]
        before, after = scene.states[row, seen, -1], moved.states[row, seen, -1]
        apart = [np.hypot(*(s[:, None, :2] - s[None, :, :2]).T) for s in (before, after)]
        np.testing.assert_allclose(apart[1], apart[0], atol=1e-3)
        turn = [np.cos(s[:, None, 2] - s[None, :, 2]) for s in (before, after)]
        np.testing.assert_allclose(turn[1], turn[0], atol=1e-5)
    assert np.abs(moved.target_states[:, :2] - about).max() > 0.1


def test_lines_of_a_missing_kind_are_all_missing() -> None:
    before, _ = draw_samples(ROWS, view="vectors")
    for ranges in (dataclasses.replace(NONE, no_kind=1.0), dataclasses.replace(NONE, no_map=1.0)):
        after = reshaped(before, sample_keys(0, np.arange(4)), ranges).observation
        assert isinstance(after, VectorTensors)
        assert not after.lines_valid.any()
        assert not after.lines.any()


def test_rasters_are_refused() -> None:
    scene = scene_of()
    batch = make_batch(scene, make_view("chauffeurnet", pixels=(36, 24)), 15)
    with pytest.raises(AspEnvError, match="take vectors"):
        reshaped(batch, sample_keys(0, np.arange(4)), Augmentation())
