"""Training data: choice and order of snippets, range of actions, batches."""

import dataclasses
import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from asp_env.data.classes import AgentClass
from asp_env.data.snippets import gather_future, gather_present, gather_scene, index_snippets
from asp_env.dynamics import inverse
from asp_env.errors import AspEnvError
from asp_env.views import make_raster_view
from predictors.training import data as training_data
from predictors.training.command import Train
from predictors.training.data import (
    Batches,
    action_range,
    choose_snippets,
    epoch_rows,
    moving_snippets,
    open_training_data,
)
from tests.builders import Drive, make_recording
from tests.crossing_files import write_crossing
from tests.predictors.tiny import tiny_config, write_data

EAST = Drive(kind=AgentClass.CAR, start=(-50.0, 2.0, 0.0, 10.0))
WAITING = Drive(kind=AgentClass.CAR, start=(20.0, -2.0, 0.0, 0.0), appears_s=0.4)
"""Stands all the time, but is absent in the first frame, so it is not parked."""

SMALL = make_raster_view("chauffeurnet", pixels=(36, 24))


@given(
    count=st.integers(1, 30),
    per_epoch=st.integers(1, 70),
    seed=st.integers(0, 3),
    epochs=st.integers(1, 4),
)
def test_epochs_are_stretches_of_whole_shuffles(
    count: int, per_epoch: int, seed: int, epochs: int
) -> None:
    """Consecutive epochs contain every snippet once before any is repeated."""
    rows = np.concatenate(
        [epoch_rows(count, per_epoch=per_epoch, epoch=epoch, seed=seed) for epoch in range(epochs)]
    )
    assert len(rows) == per_epoch * epochs
    complete = len(rows) // count * count
    for shuffle in rows[:complete].reshape(-1, count):
        assert sorted(shuffle) == list(range(count))
    assert len(set(rows[complete:])) == len(rows) - complete


def test_epochs_differ_in_order() -> None:
    """Two epochs of all 50 snippets, and two seeds, are different shuffles."""
    first, second, other = (
        epoch_rows(50, per_epoch=50, epoch=epoch, seed=seed)
        for epoch, seed in ((0, 0), (1, 0), (0, 1))
    )
    assert first.tolist() != second.tolist()
    assert first.tolist() != other.tolist()


def test_share_of_standing_targets_is_limited() -> None:
    """A share of 0.2 leaves one standing target for every four that move."""
    recordings = [make_recording(drives=(EAST, WAITING), duration_s=16.0)]
    index = index_snippets(recordings, dt_s=0.2, horizon_s=3.0)
    is_moving = moving_snippets(recordings, index)
    num_moving = int(is_moving.sum())
    assert num_moving == np.sum(index.track == 0)
    chosen = choose_snippets(recordings, index, standing_share=0.2, max_snippets=None, seed=0)
    assert np.sum(chosen.track == 0) == num_moving
    assert np.sum(chosen.track == 1) == num_moving // 4
    every = choose_snippets(recordings, index, standing_share=1.0, max_snippets=None, seed=0)
    assert len(every) == len(index)


def test_traffic_without_moving_targets_is_refused() -> None:
    """With a share of 0.5 for standing targets and no moving ones, no snippet is left."""
    recordings = [make_recording(drives=(EAST, WAITING), duration_s=16.0)]
    index = index_snippets(recordings, dt_s=0.2, horizon_s=3.0)
    index = index.select(index.track == 1)
    assert len(index) > 0
    with pytest.raises(
        AspEnvError, match=rf"none of the {len(index)} training snippets .* at most 0\.5"
    ) as caught:
        choose_snippets(recordings, index, standing_share=0.5, max_snippets=None, seed=0)
    assert "\n" not in str(caught.value)
    every = choose_snippets(recordings, index, standing_share=1.0, max_snippets=None, seed=0)
    assert len(every) == len(index)


def test_max_snippets_are_random_and_in_order() -> None:
    """Five snippets, equal for equal seeds, ordered by time."""
    recordings = [make_recording(duration_s=16.0)]
    index = index_snippets(recordings, dt_s=0.2, horizon_s=3.0)
    chosen, again = (
        choose_snippets(recordings, index, standing_share=1.0, max_snippets=5, seed=3)
        for _ in range(2)
    )
    assert len(chosen) == 5
    assert chosen.tick.tolist() == again.tick.tolist()
    assert chosen.tick.tolist() == sorted(chosen.tick.tolist())


def test_action_range_is_that_of_the_futures() -> None:
    """A car that brakes at 2 m/s² and steers 0.2 rad has the range (2, 0.2)."""
    braking = Drive(kind=AgentClass.CAR, start=(0.0, 0.0, 0.0, 25.0), phases=((60.0, -2.0, 0.2),))
    recordings = [make_recording(drives=(braking,), duration_s=8.0)]
    index = index_snippets(recordings, dt_s=0.2, horizon_s=3.0)
    acceleration, steering = action_range(recordings, index)
    assert acceleration == pytest.approx(2.0, abs=0.01)
    assert steering == pytest.approx(0.2, abs=0.01)


@pytest.mark.parametrize("count", [1, 2, 3, 70, 131])
def test_action_range_is_the_percentile_of_all_actions(
    count: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In chunks of 7 and by NumPy at once: equal bit for bit."""
    weaving = Drive(
        kind=AgentClass.CAR,
        start=(0.0, 0.0, 0.0, 12.0),
        phases=((9.0, 1.3, 0.1), (14.0, -1.1, -0.3), (80.0, 0.3, 0.2)),
    )
    recordings = [make_recording(drives=(weaving, EAST), duration_s=60.0)]
    index = index_snippets(recordings, dt_s=0.2, horizon_s=3.0)
    index = index.select(np.arange(count))
    now, lengths = gather_present(recordings, index)
    future = gather_future(recordings, index).states
    before = np.concatenate([now[:, None], future[:, :-1]], axis=1)
    every = np.abs(inverse(before, future, lengths[:, None], 0.2)).reshape(-1, 2)
    expected = np.percentile(every.astype(np.float64), 99.9, axis=0)
    monkeypatch.setattr(training_data, "CHUNK", 7)
    low = np.array(training_data.MIN_ACTION_RANGE)
    assert action_range(recordings, index) == tuple(np.maximum(expected, low).tolist())


def test_action_range_stays_within_limits() -> None:
    """Standing still has the lowest range; braking at 9 m/s² has the limit of 5 m/s²."""
    wild = Drive(kind=AgentClass.CAR, start=(0.0, 0.0, 0.0, 30.0), phases=((9.0, -9.0, 0.0),))
    for drive, expected in ((WAITING, (0.5, 0.05)), (wild, (5.0, 0.05))):
        recordings = [make_recording(drives=(drive,), duration_s=8.0)]
        index = index_snippets(recordings, dt_s=0.2, horizon_s=3.0)
        assert action_range(recordings, index) == pytest.approx(expected)


def test_batches_hold_every_snippet_in_order() -> None:
    """Ten snippets in batches of 4, 4 and 2, with the observations drawn at once."""
    recordings = [make_recording()]
    index = index_snippets(recordings, dt_s=0.2, horizon_s=3.0)
    chosen = index.select(np.array([9, 3, 50, 41, 7, 60, 2, 1, 80, 30]))
    batches = Batches(recordings, chosen, view=SMALL, batch_size=4)
    assert len(batches) == 3
    samples = list(batches)
    assert [len(batch.actions) for batch, _ in samples] == [4, 4, 2]
    scene = gather_scene(recordings, chosen)
    packed = np.concatenate([np.asarray(batch.observation) for batch, _ in samples])
    np.testing.assert_array_equal(packed, np.packbits(SMALL.render(scene), axis=-1))
    actions = np.concatenate([batch.actions.numpy() for batch, _ in samples])
    index = (scene.targets[:, 0], scene.targets[:, 1])
    np.testing.assert_array_equal(actions, scene.actions[index])


def test_labels_are_in_the_frame_of_the_target() -> None:
    """A car that heads south at 10 m/s is at (30, 0) after 3 s."""
    south = Drive(kind=AgentClass.CAR, start=(5.0, 60.0, -math.pi / 2, 10.0))
    recordings = [make_recording(drives=(south,), duration_s=8.0)]
    index = index_snippets(recordings, dt_s=0.2, horizon_s=3.0)
    ((_, labels),) = Batches(recordings, index, view=SMALL, batch_size=100)
    np.testing.assert_allclose(labels.states[:, -1], [[30, 0, 0, 10]] * len(index), atol=1e-3)
    assert gather_future(recordings, index).valid.all()


def test_error_in_the_loading_thread_is_raised() -> None:
    """The error is raised where batches are read."""
    recordings = [make_recording()]
    index = index_snippets(recordings, dt_s=0.2, horizon_s=3.0, history_s=1.0)
    with pytest.raises(ValueError, match="needs 15 past ticks"):
        next(iter(Batches(recordings, index, view=SMALL, batch_size=4)))


def test_several_data_are_split_each_on_its_own(tmp_path: Path) -> None:
    """The parts of every recording are those of its own data set, though locations are equal."""
    folders = [write_data(tmp_path / str(cars), cars=cars) for cars in (2, 4)]
    config = tiny_config()
    alone = [open_training_data(config, folder) for folder in folders]
    both = open_training_data(config, folders)
    expected = {**alone[0].trained_on.parts, **alone[1].trained_on.parts}
    assert dict(both.trained_on.parts) == expected
    assert sorted(expected.values()) == ["test"] * 2 + ["train"] * 2 + ["validation"] * 2
    assert both.trained_on.source == ", ".join(folders)
    for part in ("training", "validation"):
        counts = [len(getattr(each, part).snippets) for each in (*alone, both)]
        assert counts[0] + counts[1] == counts[2] > 0


def test_several_validation_data(tmp_path: Path) -> None:
    """All of DATA is trained on, and all of the validation data are validated on."""
    first, second, third = (write_data(tmp_path / str(cars), cars=cars) for cars in (2, 3, 4))
    config = dataclasses.replace(tiny_config(), validation=(second, third))
    parts = open_training_data(config, first).trained_on.parts
    assert sorted(parts.values()) == ["train"] * 3 + ["validation"] * 6


@pytest.mark.parametrize("parked", [False, True])
def test_parked_vehicles_are_trained_on_if_asked_for(tmp_path: Path, parked: bool) -> None:
    """Both cars have 14 snippets, see `tests/evaluation/open_loop/test_open_loop.py`."""
    drives = (
        Drive(kind=AgentClass.CAR, start=(-95.0, -1.75, 0.0, 8.0)),
        Drive(kind=AgentClass.CAR, start=(25.0, -6.0, 0.0, 0.0)),
    )
    for name in ("training", "validation"):
        (tmp_path / name).mkdir()
    write_crossing(tmp_path / "training", drives=(drives,), seconds=14.0)
    write_crossing(tmp_path / "validation", drives=(drives[::-1],), seconds=14.0)
    given = Train(predictor="dkm", data=(), out=tmp_path, view="vectors", parked=parked)
    config = dataclasses.replace(
        given.config_for(3.0), validation=(str(tmp_path / "validation"),), standing_share=1.0
    )
    data = open_training_data(config, str(tmp_path / "training"))
    assert len(data.training.snippets) == len(data.validation.snippets) == 14 + 14 * parked
