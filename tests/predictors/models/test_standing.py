"""The mode in which a target stands: its motion, its probability, and what the others learn."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from asp_env.dynamics import MAX_ACCELERATION_MPS2
from predictors.models.batch import Batch, Labels
from predictors.models.losses import STANDS_M, mode_terms, standing_loss, stands
from predictors.models.network import TrainingProgress, log_sigmoid, stopping_actions
from tests.predictors.tiny import draw_samples, make_network, tiny_network, tiny_shape

TRAINABLE = ("mtp", "dkm", "ffw-asp", "ssp-asp")


@pytest.fixture(scope="module")
def sample() -> tuple[Batch, Labels]:
    """Four snippets of which the last two stand now."""
    batch, labels = draw_samples([8, 30, 41, 55], later_ticks=(15,))
    motion = torch.tensor([[9.0, 0.0, 0.0], [4.0, 0.0, 0.0], [0.1, 0.0, 0.0], [-0.1, 0.0, 0.0]])
    states = labels.states.clone()
    states[2:] = 0.0
    return batch._replace(motion=motion), labels._replace(states=states)


@given(speed_mps=st.floats(0.0, 20.0))
def test_a_stop_takes_the_distance_of_constant_deceleration(speed_mps: float) -> None:
    """Speeds fall by 5 m/s² to zero and stay there; the last tick takes what remains."""
    batch, _ = draw_samples([8])
    batch = batch._replace(motion=torch.tensor([[speed_mps, 0.0, 0.0]]))
    actions = stopping_actions(batch, 30, 0.2)
    assert float(actions[..., 0].min()) >= -MAX_ACCELERATION_MPS2 - 1e-4
    assert not actions[..., 1].any()
    speeds = speed_mps + (actions[0, :, 0] * 0.2).cumsum(0)
    expected = np.maximum(speed_mps - 1.0 * np.arange(1, 31), 0)
    np.testing.assert_allclose(speeds, expected, atol=1e-4)


@pytest.mark.parametrize("predictor", TRAINABLE)
def test_standing_is_a_further_mode(predictor: str, sample: tuple[Batch, Labels]) -> None:
    """Probabilities sum to one; slow targets stay in place, and fast ones do not stand."""
    batch, _ = sample
    network = make_network(predictor, tiny_network(predictor, standing=True), tiny_shape()).eval()
    with torch.no_grad():
        modes = network.calibrated(batch)
        features = network(batch).features
    assert modes.states.shape == (4, 4, 15, 4)
    assert features is not None
    assert modes.features is not None
    assert torch.equal(modes.features, features)
    assert modes.standing is None
    np.testing.assert_allclose(modes.logits.exp().sum(dim=1), 1.0, atol=1e-5)
    assert float(modes.states[2:, -1, :, :2].abs().max()) <= 0.1 * 0.2
    assert not modes.states[2:, -1, 0:, 3].any()
    np.testing.assert_allclose(modes.logits[:2, -1].exp(), 1 / (1 + math.exp(12)), rtol=1e-3)
    assert (modes.logits[2:, -1].exp() > 0.05).all()


def test_stands_by_hand() -> None:
    """One metre away at any tick is the limit, in any direction."""
    label = torch.zeros(3, 15, 4)
    label[1, 4, 1] = -STANDS_M
    label[2, 4, :2] = torch.tensor([0.8, 0.8])
    assert stands(label).tolist() == [True, True, False]
    logit = torch.tensor([0.0, 0.0, math.log(3)])
    expected = (2 * math.log(2) + math.log(4)) / 3
    assert float(standing_loss(logit, label)) == pytest.approx(expected)


@pytest.mark.parametrize("predictor", TRAINABLE)
def test_other_modes_learn_from_no_label_that_stands(
    predictor: str, sample: tuple[Batch, Labels]
) -> None:
    """With standing labels alone, no gradient reaches the last layer of the modes."""
    batch, labels = sample
    still = labels._replace(states=torch.zeros_like(labels.states))
    network = make_network(predictor, tiny_network(predictor, standing=True), tiny_shape())
    network.training_loss(batch, still, TrainingProgress())["loss"].backward()
    head = [each for name, each in network.named_modules() if name.startswith("head.layers.")][-1]
    assert isinstance(head, torch.nn.Linear)
    assert head.weight.grad is None or not head.weight.grad.any()


def test_terms_of_the_learned_targets_by_hand() -> None:
    """The second target alone: a Huber loss of 0.5 · 0.1² in x and none in y, mean 0.0025."""
    positions = torch.zeros(2, 1, 3, 2)
    label = torch.zeros(2, 3, 2)
    label[1, :, 0] = 0.1
    terms = mode_terms(
        positions,
        torch.zeros(2, 1),
        label,
        assignment="distance",
        classification="cross-entropy",
        share=None,
        learned=torch.tensor([False, True]),
    )
    assert float(terms["regression"]) == pytest.approx(0.0025)
    assert float(terms["classification"]) == 0.0


def test_terms_without_a_target_to_learn_from_are_zero() -> None:
    """Both terms are 0 and so are their gradients."""
    positions = torch.ones(2, 3, 4, 2, requires_grad=True)
    logits = torch.zeros(2, 3, requires_grad=True)
    terms = mode_terms(
        positions,
        logits,
        torch.zeros(2, 4, 2),
        assignment="distance",
        classification="cross-entropy",
        share=None,
        learned=torch.zeros(2, dtype=torch.bool),
    )
    assert {name: float(term.detach()) for name, term in terms.items()} == {
        "regression": 0.0,
        "classification": 0.0,
    }
    for term in terms.values():
        gradients = torch.autograd.grad(term, (positions, logits), retain_graph=True)
        assert not any(gradient.any() for gradient in gradients)


@given(x=st.floats(-40, 40))
def test_log_sigmoid(x: float) -> None:
    expected = float(torch.nn.functional.logsigmoid(torch.tensor(x, dtype=torch.float64)))
    assert float(log_sigmoid(torch.tensor(x))) == pytest.approx(expected, rel=1e-5, abs=1e-7)
