"""MTP: states along positions by hand, and modes that do not collapse."""

import math
from typing import Any

import numpy as np
import pytest
import torch

from predictors.models.batch import Batch, Labels, VectorTensors
from predictors.models.mtp import states_along
from predictors.models.network import Modes, TrainingProgress
from tests.predictors.tiny import draw_samples, make_network, tiny_network, tiny_shape

FORWARDS = torch.zeros(1, dtype=torch.bool)


def test_a_target_that_backs_up_keeps_its_heading() -> None:
    """Steps of 0.2 m to the rear, then ahead: heading 0 throughout, at -1 and +1 m/s."""
    positions = torch.tensor([[[[-0.2, 0.0], [-0.4, 0.0], [-0.2, 0.0]]]])
    states = states_along(positions, torch.ones(1, dtype=torch.bool), 0.2)
    assert states[0, 0, :, 2].abs().tolist() == [0, 0, 0]
    assert states[0, 0, :, 3].tolist() == pytest.approx([-1, -1, 1])
    forwards = states_along(positions, FORWARDS, 0.2)  # a target that turns on the spot
    assert forwards[0, 0, :, 2].abs().tolist() == pytest.approx([math.pi, math.pi, 0])


def test_states_along_by_hand() -> None:
    """2 m ahead, 2 m to the left, 5 cm back (too short for a heading of its own), 4 m back.

    At ticks of 0.2 s the speeds are 10, 10, 0.25 and 20 m/s.
    """
    positions = torch.tensor([[[[2.0, 0.0], [2.0, 2.0], [1.95, 2.0], [-2.05, 2.0]]]])
    states = states_along(positions, FORWARDS, 0.2)
    assert torch.equal(states[..., :2], positions)
    half = math.pi / 2
    np.testing.assert_allclose(states[0, 0, :, 2], [0, half, half, math.pi], atol=1e-6)
    np.testing.assert_allclose(states[0, 0, :, 3], [10, 10, 0.25, 20], atol=1e-4)


def test_a_target_that_has_not_moved_has_heading_0() -> None:
    """Three steps of 1 cm to the left."""
    positions = torch.zeros(1, 1, 3, 2)
    positions[..., 1] = torch.tensor([0.01, 0.02, 0.03])
    assert not states_along(positions, FORWARDS, 0.2)[..., 2].any()


def test_gradients_pass_through_positions_only() -> None:
    """Positions have gradient 1; headings and speeds have none."""
    positions = torch.ones(1, 1, 2, 2, requires_grad=True)
    states = states_along(positions, FORWARDS, 0.2)
    (gradient,) = torch.autograd.grad(states.sum(), positions)
    assert torch.equal(gradient, torch.ones_like(positions))


def test_positions_have_no_limits() -> None:
    """MTP has no actions: a bias of 100 moves a target by 1000 m in one tick."""
    network = make_network("mtp", tiny_network("mtp"), tiny_shape())
    linear = network.get_submodule("head.layers.2")
    with torch.no_grad():
        linear.get_parameter("bias").fill_(100.0)
        modes: Modes = network.eval()(draw_samples([8, 30])[0])
    assert modes.actions is None
    assert modes.states[..., 0].min() > 900


def bimodal() -> tuple[Batch, Labels]:
    """The same target four times: it continues straight three times, and turns left once."""
    batch, labels = draw_samples([8] * 4, view="vectors")
    ahead = torch.arange(1.0, 16.0)
    states = torch.zeros_like(labels.states)
    states[..., 0] = ahead
    states[3, :, :2] = torch.stack([ahead.sqrt() * 2, ahead], dim=-1)
    return batch, Labels(states=states, later=())


class ConstantEncoder(torch.nn.Module):
    """Eight features that do not depend on the observation."""

    def __init__(self) -> None:
        super().__init__()
        self.z = torch.nn.Parameter(torch.linspace(-1, 1, 8))

    def forward(self, vectors: VectorTensors) -> torch.Tensor:
        return self.z.expand(len(vectors.agents), -1)


def train_on_bimodal(modes: int, seed: int, **changes: Any) -> tuple[Modes, dict[str, float]]:
    """Modes and losses of MTP after 400 steps on `bimodal`."""
    batch, labels = bimodal()
    config = tiny_network("mtp", "vectors", hidden=32, modes=modes, **changes)
    network = make_network("mtp", config, tiny_shape("vectors"), seed=seed)
    network.add_module("encoder", ConstantEncoder())
    optimizer = torch.optim.Adam(network.parameters(), lr=1e-2)
    schedule = torch.optim.lr_scheduler.LinearLR(
        optimizer, start_factor=1.0, end_factor=0.0, total_iters=400
    )
    for step in range(400):
        optimizer.zero_grad()
        network.training_loss(batch, labels, TrainingProgress(share=step / 400))["loss"].backward()
        optimizer.step()
        schedule.step()
    with torch.no_grad():
        predicted = network(batch)
        terms = network.loss(predicted, labels, TrainingProgress())
    return predicted, {name: float(value) for name, value in terms.items()}


@pytest.mark.parametrize(
    ("modes", "changes"),
    [(3, {"assignment": "angle-random"}), (2, {"annealed": True})],
    ids=["as published", "annealed"],
)
@pytest.mark.parametrize("seed", [0, 1])
def test_modes_do_not_collapse(seed: int, modes: int, changes: dict[str, Any]) -> None:
    """On 75/25 data the classification loss reaches the entropy, and both labels have a mode.

    The inputs are equal, so the lowest loss is 0.75 ln 4/3 + 0.25 ln 4 = 0.5623; the regression
    reaches zero.
    """
    predicted, terms = train_on_bimodal(modes, seed, **changes)
    assert terms["classification"] == pytest.approx(0.5623, abs=0.01)
    assert terms["regression"] < 0.001
    _, labels = bimodal()
    offsets = predicted.states[0, :, :, :2] - labels.states[[0, 3]][:, None, :, :2]
    nearest = torch.linalg.vector_norm(offsets, dim=-1).mean(dim=-1).argmin(dim=1)
    probabilities = predicted.logits[0].softmax(dim=0)
    np.testing.assert_allclose(probabilities[nearest], [0.75, 0.25], atol=0.02)


@pytest.mark.parametrize("assignment", ["angle", "distance"])
def test_modes_collapse_without_random_choice(assignment: str) -> None:
    """The nearest mode wins both labels, with certainty, where all inputs are equal."""
    _, terms = train_on_bimodal(3, 1, assignment=assignment)
    assert terms["classification"] < 0.01
    assert terms["regression"] > 1
