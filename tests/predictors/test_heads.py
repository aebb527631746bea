"""The recurrent reader is a GRU, read without repeating what every tick shares."""

import pytest
import torch

from predictors.heads import RecurrentReader


@pytest.mark.parametrize("layers", [1, 2, 3])
def test_reader_is_the_gru_of_its_parameters(layers: int) -> None:
    """Its answer and its gradients are those of torch's own GRU over [context, action]."""
    rng = torch.Generator().manual_seed(0)
    context = torch.randn(5, 7, generator=rng)
    actions = torch.randn(5, 15, 2, generator=rng)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        reader = RecurrentReader(7, 6, layers)
    parameters = dict(reader.named_parameters())
    found: list[tuple[torch.Tensor, ...]] = []
    repeated = context[:, None].expand(-1, 15, -1)
    for answer in (
        reader(context, actions),
        reader.gru(torch.cat([repeated, actions], dim=-1))[0][:, -1],
    ):
        gradients = torch.autograd.grad(answer.square().sum(), list(parameters.values()))
        found.append((answer.detach(), *gradients))
    for name, ours, theirs in zip(["answer", *parameters], *found, strict=True):
        torch.testing.assert_close(ours, theirs, atol=1e-6, rtol=1e-5, msg=name)
