"""Heads: the recurrent reader equals torch's GRU, and the order of a connected head's outputs."""

import pytest
import torch

from predictors.models.heads import ConnectedHead, RecurrentReader


@pytest.mark.parametrize("layers", [1, 2, 3])
def test_reader_is_a_gru_over_context_and_actions(layers: int) -> None:
    """The last state of torch's GRU on both inputs, to 1e-6, and its gradients."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        reader = RecurrentReader(5, 7, layers)
        context = torch.randn(3, 5, requires_grad=True)
        actions = torch.randn(3, 15, 2)
    whole = torch.cat([context[:, None].expand(-1, 15, -1), actions], dim=-1)
    expected = reader.gru(whole)[0][:, -1]
    state = reader(context, actions)
    torch.testing.assert_close(state, expected, atol=1e-6, rtol=1e-5)
    inputs = [context, *reader.parameters()]
    pairs = zip(
        torch.autograd.grad(state.square().sum(), inputs),
        torch.autograd.grad(expected.square().sum(), inputs),
        strict=True,
    )
    for one, other in pairs:
        torch.testing.assert_close(one, other, atol=1e-5, rtol=1e-4)


def test_order_of_the_outputs_of_a_connected_head() -> None:
    """Of 2 modes and 3 ticks: 2 logits first, then pairs mode by mode and tick by tick."""
    head = ConnectedHead(1, 0, modes=2, ticks=3)
    assert len(head.layers) == 1
    with torch.no_grad():
        head.layers[0].get_parameter("weight").zero_()
        head.layers[0].get_parameter("bias").copy_(torch.arange(14.0))
        pairs, logits = head(torch.zeros(1, 1))
    assert logits.tolist() == [[0, 1]]
    assert pairs.flatten().tolist() == list(range(2, 14))
    assert pairs[0, 1, 0].tolist() == [8, 9]
