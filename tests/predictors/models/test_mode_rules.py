"""The rules by which a mode learns from a label, on the features of recorded traffic."""

import numpy as np
import pytest
import torch

from asp_env.data.snippets import index_snippets
from asp_env.data.source import open_data
from asp_env.views import make_view
from predictors.inference.checkpoint import shape_for
from predictors.models.batch import Batch, Labels, VectorTensors
from predictors.models.losses import Assignment, best_mode
from predictors.models.network import Modes, TrainingProgress
from predictors.training.data import Batches, choose_snippets
from tests.predictors.tiny import RANGE, make_network, tiny_network

COUNT = 384
"""Snippets of the sample, nine in ten of which move."""

STEPS = 150


@pytest.fixture(scope="module")
def sample() -> tuple[Batch, Labels]:
    """Random snippets of the sample recording as one batch of vectors."""
    recordings = open_data("sample:intersection")
    index = index_snippets(recordings, dt_s=0.2, horizon_s=3.0)
    chosen = choose_snippets(recordings, index, standing_share=0.1, max_snippets=COUNT, seed=0)
    view = make_view("vectors")
    return next(iter(Batches(recordings, chosen, view=view, batch_size=COUNT)))


def rows_of(sample: tuple[Batch, Labels], rows: torch.Tensor) -> tuple[Batch, Labels]:
    """Some rows of a batch."""
    batch, labels = sample
    vectors = batch.observation
    assert isinstance(vectors, VectorTensors)
    observation = VectorTensors(*(each[rows] for each in vectors))
    others = {name: getattr(batch, name)[rows] for name in batch._fields if name != "observation"}
    return Batch(observation=observation, **others), Labels(states=labels.states[rows], later=())


@pytest.mark.parametrize("assignment", ["angle", "distance", "angle-random"])
def test_modes_do_not_collapse_on_recorded_traffic(
    assignment: Assignment, sample: tuple[Batch, Labels]
) -> None:
    """After 150 steps of FFW-ASP each of three modes is nearest to at least 5 % of the labels.

    With equal inputs `distance` collapses, see `test_mtp`.
    """
    batch, labels = sample
    config = tiny_network("ffw-asp", "vectors", assignment=assignment, features=32, gru_width=32)
    shape = shape_for(make_view("vectors"), history=15, horizon=15, dt_s=0.2, action_range=RANGE)
    network = make_network("ffw-asp", config, shape)
    optimizer = torch.optim.Adam(network.parameters(), lr=3e-3)
    rng = np.random.default_rng(0)
    for _ in range(STEPS):
        some = rows_of(sample, torch.from_numpy(rng.choice(COUNT, 64, replace=False)))
        optimizer.zero_grad()
        network.training_loss(*some, TrainingProgress())["loss"].backward()
        optimizer.step()
    with torch.no_grad():
        modes: Modes = network(batch)
    nearest = best_mode(modes.states[..., :2], labels.states[..., :2], "distance")
    shares = torch.bincount(nearest, minlength=3) / COUNT
    assert float(shares.min()) >= 0.05, shares
