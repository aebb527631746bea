"""SSP-ASP's features: which parts each term of the loss trains, and the targets of ψ."""

from typing import Any

import pytest
import torch
from torch import Tensor

from predictors.models.batch import Batch, Labels
from predictors.models.network import Modes, TrainingProgress, Validation
from predictors.models.ssp_asp import SSPASPNetwork
from tests.predictors.tiny import draw_samples, make_network, tiny_network, tiny_shape

END = TrainingProgress(share=1.0)


def ssp(view: str = "vectors", **changes: Any) -> SSPASPNetwork:
    """A tiny SSP-ASP for 3 s."""
    network = make_network("ssp-asp", tiny_network("ssp-asp", view, **changes), tiny_shape(view))
    assert isinstance(network, SSPASPNetwork)
    return network


def validate(
    network: SSPASPNetwork, batch: Batch, labels: Labels, *, pretraining: bool = False
) -> Validation:
    """The validation of a forecast."""
    with torch.no_grad():
        modes: Modes = network(batch)
        return network.validate(modes, batch, labels, TrainingProgress(pretraining=pretraining))


@pytest.fixture(scope="module")
def sample() -> tuple[Batch, Labels]:
    """Four snippets with the inputs at 3 s."""
    return draw_samples([8, 30, 41, 55], view="vectors", later_ticks=(15,))


def trained_by(network: SSPASPNetwork, term: Tensor) -> set[str]:
    """Parts of the network that have a gradient of a term."""
    network.zero_grad(set_to_none=True)
    term.backward(retain_graph=True)
    return {
        name.split(".")[0]
        for name, parameter in network.named_parameters()
        if parameter.grad is not None and parameter.grad.any()
    }


FEATURES = {"encoder", "norm", "forward_reader", "forward_head"}
ACTIONS = {"reader", "head"}


def test_pretraining_does_not_train_the_action_predictor(sample: tuple[Batch, Labels]) -> None:
    """It trains φ, ψ and ξ; afterwards all parts are trained."""
    network = ssp()
    loss = network.training_loss(*sample, TrainingProgress(share=0.0, pretraining=True))["loss"]
    assert trained_by(network, loss) == FEATURES | {"reconstructor"}
    loss = network.training_loss(*sample, END)["loss"]
    assert trained_by(network, loss) == FEATURES | {"reconstructor"} | ACTIONS


def test_parts_trained_by_each_term(sample: tuple[Batch, Labels]) -> None:
    """The reconstruction trains φ and ξ, the mismatch φ and ψ, the others φ, ψ and γ."""
    network = ssp()
    terms = network.training_loss(*sample, END)
    assert trained_by(network, terms["actions"]) == {"encoder", "reconstructor"}
    assert trained_by(network, terms["features"]) == FEATURES
    for name in ("regression", "classification"):
        assert trained_by(network, terms[name]) == FEATURES | ACTIONS


def gradients_of_features(
    network: SSPASPNetwork, sample: tuple[Batch, Labels], monkeypatch: pytest.MonkeyPatch
) -> list[bool]:
    """Whether the feature mismatch has a gradient for the features now, and for the later ones."""
    encoded: list[Tensor] = []
    encode = network.encode

    def record(batch: Batch) -> Tensor:
        encoded.append(encode(batch))
        return encoded[-1]

    monkeypatch.setattr(network, "encode", record)
    terms = network.training_loss(*sample, END)
    gradients = torch.autograd.grad(terms["features"], encoded, allow_unused=True)
    return [each is not None and bool(each.any()) for each in gradients]


@pytest.mark.parametrize(
    ("changes", "expected"),
    [({}, True), ({"stop_gradient": True}, False), ({"ema": 0.9}, False)],
    ids=["literal", "stop_gradient", "ema"],
)
def test_gradient_of_the_target_of_the_feature_predictor(
    changes: dict[str, Any],
    expected: bool,
    sample: tuple[Batch, Labels],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The literal loss has a gradient for the target; `stop_gradient` and `ema` have none."""
    gradients = gradients_of_features(ssp(**changes), sample, monkeypatch)
    assert gradients == [True, expected]


def test_second_encoder_averages_weights(sample: tuple[Batch, Labels]) -> None:
    """At a decay of 0.9 a weight of 1 that follows 2 becomes 1.1, then 1.19; it has no gradient."""
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


def test_second_encoder_copies_running_statistics() -> None:
    """Buffers of batch normalisation are copied, not averaged."""
    network = ssp("chauffeurnet", ema=0.9)
    batch, labels = draw_samples([8, 30, 41, 55], later_ticks=(15,))
    network.training_loss(batch, labels, END)
    network.after_step()
    assert network.target_encoder is not None
    pairs = zip(network.target_encoder.buffers(), network.encoder.buffers(), strict=True)
    assert all(torch.equal(own, leader) for own, leader in pairs)
    assert any(bool(each.any()) for each in network.encoder.buffers())


def test_second_encoder_makes_the_targets(sample: tuple[Batch, Labels]) -> None:
    """Other weights of the second encoder change only the mismatch of features."""
    network = ssp(ema=0.9)
    before = network.training_loss(*sample, END)
    assert network.target_encoder is not None
    for own in network.target_encoder.parameters():
        own.mul_(3)
    after = network.training_loss(*sample, END)
    same = {name for name in before if torch.equal(before[name], after[name])}
    assert same == {"actions", "regression", "classification"}


def test_after_step_without_a_second_encoder_changes_nothing() -> None:
    network = ssp()
    before = {name: value.clone() for name, value in network.state_dict().items()}
    network.after_step()
    assert network.target_encoder is None
    assert all(torch.equal(value, before[name]) for name, value in network.state_dict().items())


def test_branch_on_encoded_features_is_optional(sample: tuple[Batch, Labels]) -> None:
    """Only with it do the inputs at 3 s influence the losses of the forecasts."""
    batch, labels = sample
    other = labels._replace(later=(batch,))
    for branch in (False, True):
        network = ssp(encoded_branch=branch, stop_gradient=True)
        one, two = (network.training_loss(batch, each, END) for each in (labels, other))
        for name in ("regression", "classification"):
            assert torch.equal(one[name], two[name]) != branch
        assert not torch.equal(one["features"], two["features"])


def test_both_branches_have_equal_weight(sample: tuple[Batch, Labels]) -> None:
    """If both branches have the same features, the loss of both equals that of one."""
    batch, labels = sample
    losses = []
    for branch in (False, True):
        network = ssp(encoded_branch=branch)
        with torch.no_grad():  # ψ and φ return their bias for all inputs
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
    """Encoded and predicted features."""
    features = validate(ssp(normalise=True), *sample).features
    assert features is not None
    for z in features:
        torch.testing.assert_close(z.mean(dim=1), torch.zeros(4), atol=1e-5, rtol=0)
        torch.testing.assert_close(z.var(dim=1, correction=0), torch.ones(4), atol=1e-2, rtol=0)


def test_features_are_those_at_the_end_of_the_segment(
    sample: tuple[Batch, Labels],
) -> None:
    """Encoded features are those of the inputs at 3 s; predicted ones do not depend on them."""
    batch, labels = sample
    network = ssp()
    features, other = (
        validate(network, batch, each).features
        for each in (labels, labels._replace(later=(batch,)))
    )
    assert features is not None
    assert other is not None
    assert torch.equal(features.encoded, network.encode(labels.later[0]))
    assert not torch.equal(features.encoded, other.encoded)
    assert torch.equal(features.predicted, other.predicted)


def test_validation_loss_has_the_terms_and_weights_of_the_training(
    sample: tuple[Batch, Labels],
) -> None:
    """w1 and w2 of the training, w3 and w4 of the forecast; in pre-training w1 and w2 alone."""
    weights: Any = {
        "action_weight": 2.0,
        "feature_weight": 3.0,
        "regression_weight": 5.0,
        "classification_weight": 7.0,
    }
    network = ssp(**weights, assignment="distance")
    with torch.no_grad():
        trained = network.training_loss(*sample, END)
        of_modes = network.loss(network(sample[0]), sample[1], END)
    features = {name: trained[name] for name in ("actions", "features")}
    modes = {name: of_modes[name] for name in ("regression", "classification")}
    for pretraining, expected in ((True, features), (False, features | modes)):
        terms = validate(network, *sample, pretraining=pretraining).terms
        assert set(terms) == {"loss", *expected}
        for name, value in expected.items():
            torch.testing.assert_close(terms[name], value)
        by_hand = sum(
            weight * float(value)
            for weight, value in zip(weights.values(), expected.values(), strict=False)
        )
        assert float(terms["loss"]) == pytest.approx(by_hand, rel=1e-5)
