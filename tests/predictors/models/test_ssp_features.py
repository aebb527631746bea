"""SSP-ASP's features: who learns from which loss, and what keeps the target still."""

from typing import Any

import pytest
import torch
from torch import Tensor

from predictors.models.batch import Batch, Labels
from predictors.models.network import TrainingProgress
from predictors.models.ssp_asp import SSPASPNetwork
from tests.predictors.tiny import draw_samples, make_network, tiny_network, tiny_shape

END = TrainingProgress(share=1.0)


def ssp(view: str = "vectors", **changes: Any) -> SSPASPNetwork:
    """A tiny network for 3 s."""
    network = make_network("ssp-asp", tiny_network("ssp-asp", view, **changes), tiny_shape(view))
    assert isinstance(network, SSPASPNetwork)
    return network


@pytest.fixture(scope="module")
def sample() -> tuple[Batch, Labels]:
    """Four snippets with the scene at 3 s."""
    return draw_samples([8, 30, 41, 55], view="vectors", later_ticks=(15,))


def moved_by(network: SSPASPNetwork, term: Tensor) -> set[str]:
    """Parts of the network that a loss has a gradient for."""
    network.zero_grad(set_to_none=True)
    term.backward(retain_graph=True)
    return {
        name.split(".")[0]
        for name, parameter in network.named_parameters()
        if parameter.grad is not None and parameter.grad.any()
    }


FEATURES = {"encoder", "norm", "forward_reader", "forward_head"}
ACTIONS = {"reader", "head"}


def test_pretraining_moves_no_action_predictor(sample: tuple[Batch, Labels]) -> None:
    """Encoder, feature predictor and reconstructor learn alone; afterwards all parts do."""
    network = ssp()
    loss = network.training_loss(*sample, TrainingProgress(share=0.0, pretraining=True))["loss"]
    assert moved_by(network, loss) == FEATURES | {"reconstructor"}
    loss = network.training_loss(*sample, END)["loss"]
    assert moved_by(network, loss) == FEATURES | {"reconstructor"} | ACTIONS


def test_every_term_moves_what_it_is_of(sample: tuple[Batch, Labels]) -> None:
    """Reconstruction and mismatch their own parts, the others all that leads to actions."""
    network = ssp()
    terms = network.training_loss(*sample, END)
    assert moved_by(network, terms["actions"]) == {"encoder", "reconstructor"}
    assert moved_by(network, terms["features"]) == FEATURES
    for name in ("regression", "classification"):
        assert moved_by(network, terms[name]) == FEATURES | ACTIONS


def gradients_of_features(
    network: SSPASPNetwork, sample: tuple[Batch, Labels], monkeypatch: pytest.MonkeyPatch
) -> list[bool]:
    """Whether the mismatch of features pulls at those encoded now, and at those encoded later."""
    encoded: list[Tensor] = []
    encode = network.encode

    def kept(batch: Batch) -> Tensor:
        encoded.append(encode(batch))
        return encoded[-1]

    monkeypatch.setattr(network, "encode", kept)
    terms = network.training_loss(*sample, END)
    found = torch.autograd.grad(terms["features"], encoded, allow_unused=True)
    return [each is not None and bool(each.any()) for each in found]


@pytest.mark.parametrize(
    ("changes", "pulls"),
    [({}, True), ({"stop_gradient": True}, False), ({"ema": 0.9}, False)],
    ids=["literal", "stop_gradient", "ema"],
)
def test_no_gradient_through_a_fixed_target(
    changes: dict[str, Any],
    pulls: bool,
    sample: tuple[Batch, Labels],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The literal loss pulls at both ends; a stopped or following target stays where it is."""
    found = gradients_of_features(ssp(**changes), sample, monkeypatch)
    assert found == [True, pulls]


def test_second_encoder_follows_by_hand(sample: tuple[Batch, Labels]) -> None:
    """With 0.9 a weight of 1 whose leader is at 2 becomes 1.1, then 1.19; no gradient moves it."""
    network = ssp(ema=0.9)
    follower = network.target_encoder
    assert follower is not None
    for own, leader in zip(follower.parameters(), network.encoder.parameters(), strict=True):
        assert torch.equal(own, leader)
        own.fill_(1)
        leader.data.fill_(2)
    for expected in (1.1, 1.19):
        network.after_step()
        for own in follower.parameters():
            torch.testing.assert_close(own, torch.full_like(own, expected))
    network.training_loss(*sample, END)["loss"].backward()
    assert all(each.grad is None for each in follower.parameters())


def test_second_encoder_takes_the_statistics_of_the_first() -> None:
    """Running means of batch normalisation are copied, not averaged."""
    network = ssp("chauffeurnet", ema=0.9)
    batch, labels = draw_samples([8, 30, 41, 55], later_ticks=(15,))
    network.training_loss(batch, labels, END)
    network.after_step()
    assert network.target_encoder is not None
    pairs = zip(network.target_encoder.buffers(), network.encoder.buffers(), strict=True)
    assert all(torch.equal(own, leader) for own, leader in pairs)
    assert any(bool(each.any()) for each in network.encoder.buffers())


def test_target_is_what_the_second_encoder_says(sample: tuple[Batch, Labels]) -> None:
    """Other weights there change the mismatch of features and nothing else."""
    network = ssp(ema=0.9)
    before = network.training_loss(*sample, END)
    assert network.target_encoder is not None
    for own in network.target_encoder.parameters():
        own.mul_(3)
    after = network.training_loss(*sample, END)
    same = {name for name in before if torch.equal(before[name], after[name])}
    assert same == {"actions", "regression", "classification"}


def test_without_a_second_encoder_a_step_changes_nothing() -> None:
    """Without `ema` there is none to follow."""
    network = ssp()
    before = {name: value.clone() for name, value in network.state_dict().items()}
    network.after_step()
    assert network.target_encoder is None
    assert all(torch.equal(value, before[name]) for name, value in network.state_dict().items())


def test_branch_on_encoded_features_can_be_left_out(sample: tuple[Batch, Labels]) -> None:
    """Without it what is seen at 3 s moves no forecast's loss; with it, it does."""
    batch, labels = sample
    other = labels._replace(later=(batch,))
    for branch in (False, True):
        network = ssp(encoded_branch=branch, stop_gradient=True)
        one, two = (network.training_loss(batch, each, END) for each in (labels, other))
        for name in ("regression", "classification"):
            assert torch.equal(one[name], two[name]) != branch
        assert not torch.equal(one["features"], two["features"])


def test_both_branches_count_alike(sample: tuple[Batch, Labels]) -> None:
    """Where both see the same features, the loss of both is that of one."""
    batch, labels = sample
    losses = []
    for branch in (False, True):
        network = ssp(encoded_branch=branch)
        with torch.no_grad():  # ψ says the bias, and φ of whatever is seen as well
            for linear in (network.forward_head, _last_linear(network.encoder)):
                linear.get_parameter("weight").zero_()
                linear.get_parameter("bias").copy_(torch.linspace(-1, 1, 8))
        losses.append(network.training_loss(batch, labels, END))
    for name, value in losses[0].items():
        torch.testing.assert_close(value, losses[1][name])
    assert not losses[0]["features"].any()


def _last_linear(module: torch.nn.Module) -> torch.nn.Module:
    return [each for each in module.modules() if isinstance(each, torch.nn.Linear)][-1]


def test_normalised_features_have_mean_0_and_variance_1(sample: tuple[Batch, Labels]) -> None:
    """Encoded and predicted ones alike."""
    features = ssp(normalise=True).features(*sample)
    assert features is not None
    for z in features:
        torch.testing.assert_close(z.mean(dim=1), torch.zeros(4), atol=1e-5, rtol=0)
        torch.testing.assert_close(z.var(dim=1, correction=0), torch.ones(4), atol=1e-2, rtol=0)


def test_diagnosed_features_are_those_of_the_end_of_the_segment(
    sample: tuple[Batch, Labels],
) -> None:
    """Encoded is what φ says of the scene at 3 s; predicted knows nothing of it."""
    batch, labels = sample
    network = ssp()
    features, false = (
        network.features(batch, each) for each in (labels, labels._replace(later=(batch,)))
    )
    assert features is not None
    assert false is not None
    assert torch.equal(features.encoded, network.encode(labels.later[0]))
    assert not torch.equal(features.encoded, false.encoded)
    assert torch.equal(features.predicted, false.predicted)
