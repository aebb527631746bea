"""MTP: states along positions by hand, and that its modes do not collapse."""

import math
from typing import Any

import numpy as np
import pytest
import torch

from predictors.models.batch import Batch, Labels, VectorTensors
from predictors.models.mtp import states_along
from predictors.models.network import Modes, TrainingProgress
from tests.predictors.tiny import draw_samples, make_network, tiny_network, tiny_shape


def test_states_along_by_hand() -> None:
    """2 m ahead, 2 m to the left, 5 cm back (too short to tell a heading), 4 m back.

    At 0.2 s a tick the speeds are 10, 10, 0.25 and 20 m/s.
    """
    positions = torch.tensor([[[[2.0, 0.0], [2.0, 2.0], [1.95, 2.0], [-2.05, 2.0]]]])
    states = states_along(positions, 0.2)
    assert torch.equal(states[..., :2], positions)
    half = math.pi / 2
    np.testing.assert_allclose(states[0, 0, :, 2], [0, half, half, math.pi], atol=1e-6)
    np.testing.assert_allclose(states[0, 0, :, 3], [10, 10, 0.25, 20], atol=1e-4)


def test_who_has_not_moved_yet_keeps_its_heading() -> None:
    """Steps of 1 cm to the left from the start: heading 0."""
    positions = torch.zeros(1, 1, 3, 2)
    positions[..., 1] = torch.tensor([0.01, 0.02, 0.03])
    assert not states_along(positions, 0.2)[..., 2].any()


def test_gradients_pass_through_positions_alone() -> None:
    """Headings and speeds are read off, not learned from; positions have gradient 1."""
    positions = torch.ones(1, 1, 2, 2, requires_grad=True)
    states = states_along(positions, 0.2)
    (gradient,) = torch.autograd.grad(states.sum(), positions)
    assert torch.equal(gradient, torch.ones_like(positions))


def test_positions_are_not_bound_by_any_limit() -> None:
    """It has no actions, and goes where its outputs say: 1000 m in one tick."""
    network = make_network("mtp", tiny_network("mtp"), tiny_shape())
    linear = network.get_submodule("head.layers.2")
    with torch.no_grad():
        linear.get_parameter("bias").fill_(100.0)
        modes: Modes = network.eval()(draw_samples([8, 30])[0])
    assert modes.actions is None
    assert modes.states[..., 0].min() > 900


def bimodal() -> tuple[Batch, Labels]:
    """The same target four times: it goes straight on three times, and to the left once."""
    batch, labels = draw_samples([8] * 4, view="vectors")
    ahead = torch.arange(1.0, 16.0)
    states = torch.zeros_like(labels.states)
    states[..., 0] = ahead
    states[3, :, :2] = torch.stack([ahead.sqrt() * 2, ahead], dim=-1)
    return batch, Labels(states=states, later=())


class Uninformed(torch.nn.Module):
    """Features that do not depend on what is seen."""

    def __init__(self) -> None:
        """Eight."""
        super().__init__()
        self.z = torch.nn.Parameter(torch.linspace(-1, 1, 8))

    def forward(self, seen: VectorTensors) -> torch.Tensor:
        """The same for all."""
        return self.z.expand(len(seen.agents), -1)


def train_on_bimodal(modes: int, seed: int, **changes: Any) -> tuple[Modes, dict[str, float]]:
    """What MTP says after 400 steps on them, and its losses."""
    batch, labels = bimodal()
    config = tiny_network("mtp", "vectors", hidden=32, modes=modes, **changes)
    network = make_network("mtp", config, tiny_shape("vectors"), seed=seed)
    network.add_module("encoder", Uninformed())
    optimizer = torch.optim.Adam(network.parameters(), lr=1e-2)
    falling = torch.optim.lr_scheduler.LinearLR(
        optimizer, start_factor=1.0, end_factor=0.0, total_iters=400
    )
    for step in range(400):
        optimizer.zero_grad()
        network.training_loss(batch, labels, TrainingProgress(share=step / 400))["loss"].backward()
        optimizer.step()
        falling.step()
    with torch.no_grad():
        found = network(batch)
        terms = network.loss(found, labels, TrainingProgress())
    return found, {name: float(value) for name, value in terms.items()}


@pytest.mark.parametrize(
    ("modes", "changes"),
    [(3, {"assignment": "angle-random"}), (2, {"annealed": True})],
    ids=["as published", "annealed"],
)
@pytest.mark.parametrize("seed", [0, 1])
def test_modes_do_not_collapse(seed: int, modes: int, changes: dict[str, Any]) -> None:
    """On 75/25 data the classification loss reaches their entropy, 0.5623 ± 0.01; both are found.

    Nothing tells the two apart: 0.75 ln 4/3 + 0.25 ln 4 = 0.5623. The regression goes to zero.
    """
    found, terms = train_on_bimodal(modes, seed, **changes)
    assert terms["classification"] == pytest.approx(0.5623, abs=0.01)
    assert terms["regression"] < 0.001
    _, labels = bimodal()
    away = found.states[0, :, :, :2] - labels.states[[0, 3]][:, None, :, :2]
    nearest = torch.linalg.vector_norm(away, dim=-1).mean(dim=-1).argmin(dim=1)
    probabilities = found.logits[0].softmax(dim=0)
    np.testing.assert_allclose(probabilities[nearest], [0.75, 0.25], atol=0.02)


def test_modes_collapse_where_the_best_one_takes_all() -> None:
    """Why chance or annealing is needed: by distance one mode may win both, and is sure of it."""
    _, terms = train_on_bimodal(3, 1, assignment="distance")
    assert terms["classification"] < 0.01
    assert terms["regression"] > 1
