"""Heads: the recurrent parts equal torch's GRU, and the order of a connected head's outputs."""

import pytest
import torch
from torch import Tensor

from predictors.models.heads import ConnectedHead, RecurrentReader, UnrolledDecoder


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


def decode(
    decoder: UnrolledDecoder, context: Tensor, actions: Tensor, static: Tensor, ticks: int
) -> tuple[Tensor, Tensor]:
    """What an unrolled decoder of two modes with a hidden layer is to compute, by torch's GRU."""
    h = actions.shape[1]
    marks = torch.cat([torch.zeros(len(context), h, 1), torch.ones(len(context), ticks, 1)], dim=1)
    known = torch.cat([actions, torch.zeros(len(context), ticks, 2)], dim=1)
    repeated = context[:, None].expand(-1, h + ticks, -1)
    states = decoder.gru(torch.cat([repeated, known, marks], dim=-1))[0]
    assert decoder.from_static is not None
    assert decoder.out is not None
    pairs = torch.zeros(len(context), 2, ticks, 2)
    for tick in range(ticks):
        hidden = decoder.from_state(states[:, h + tick]) + decoder.from_static(static)
        pairs[:, :, tick] = decoder.out(hidden.relu()).view(-1, 2, 2)
    return pairs, decoder.logits(torch.cat([states[:, h - 1], static], dim=-1))


@pytest.mark.parametrize("layers", [1, 2])
def test_unrolled_decoder_is_a_gru_over_past_and_future(layers: int) -> None:
    """Pairs of each tick from the state after it, logits from the state now, and all gradients."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        decoder = UnrolledDecoder(5, 7, layers, modes=2, static=3, hidden=6)
        context, static = torch.randn(4, 5, requires_grad=True), torch.randn(4, 3)
        actions = torch.randn(4, 9, 2)
    pairs, logits = decoder(context, actions, 6, static)
    expected = decode(decoder, context, actions, static, 6)
    assert pairs.shape == (4, 2, 6, 2)
    torch.testing.assert_close(pairs, expected[0], atol=1e-6, rtol=1e-5)
    torch.testing.assert_close(logits, expected[1], atol=1e-6, rtol=1e-5)
    inputs = [context, *decoder.parameters()]
    own = torch.autograd.grad(pairs.square().sum() + logits.square().sum(), inputs)
    other = torch.autograd.grad(expected[0].square().sum() + expected[1].square().sum(), inputs)
    for one, two in zip(own, other, strict=True):
        torch.testing.assert_close(one, two, atol=1e-5, rtol=1e-4)


def test_unrolled_decoder_goes_on_for_any_number_of_ticks() -> None:
    """The first five of eight ticks are those of five; the logits do not depend on the number."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        decoder = UnrolledDecoder(5, 7, 2, modes=3)
        context, actions = torch.randn(4, 5), torch.randn(4, 9, 2)
    (short, few), (long, many) = (decoder(context, actions, ticks) for ticks in (5, 8))
    torch.testing.assert_close(long[:, :, :5], short)
    assert torch.equal(few, many)
    assert float((long[:, :, 5:] - long[:, :, 4:5]).abs().max().detach()) > 1e-4
