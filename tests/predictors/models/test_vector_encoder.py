"""The vector encoder: what its features depend on, and what they do not."""

import math

import numpy as np
import pytest
import torch
from torch import Tensor

from asp_env.errors import AspEnvError
from asp_env.views.vectors import VectorShape, VectorView
from predictors.models.batch import VectorTensors
from predictors.models.encoders import VectorEncoder
from tests.views.scenes import busy_scene

SHAPE = VectorView(agents=6, lines=9).shape


def make_encoder(shape: VectorShape = SHAPE, seed: int = 0) -> VectorEncoder:
    """A small encoder with random weights."""
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        return VectorEncoder(shape, 7, width=16, heads=2)


def make_vectors(count: int = 5, seed: int = 0, shape: VectorShape = SHAPE) -> VectorTensors:
    """Random vectors; some ticks, agents and lines of each target are not valid."""
    rng = np.random.default_rng(seed)
    agents_valid = rng.random((count, shape.agents, shape.ticks)) < 0.8
    agents_valid[:, :, -1] = True
    agents_valid[:, -2:] = False
    lines_valid = rng.random((count, shape.lines, shape.points)) < 0.9
    lines_valid[:, 4] = False
    agents = rng.normal(size=(*agents_valid.shape, shape.agent_fields)) * 10
    lines = rng.normal(size=(*lines_valid.shape, shape.line_fields)) * 10
    return VectorTensors(
        torch.from_numpy(np.where(agents_valid[..., None], agents, 0).astype(np.float32)),
        torch.from_numpy(agents_valid),
        torch.from_numpy(np.where(lines_valid[..., None], lines, 0).astype(np.float32)),
        torch.from_numpy(lines_valid),
    )


def features(vectors: VectorTensors) -> Tensor:
    """Features by the encoder with seed 0."""
    with torch.inference_mode():
        return make_encoder()(vectors)


def gradients(encoder: VectorEncoder) -> list[Tensor]:
    """Gradients of all parameters that have one."""
    every = [parameter.grad for parameter in encoder.parameters()]
    return [gradient for gradient in every if gradient is not None]


def assert_close(one: Tensor, other: Tensor) -> None:
    torch.testing.assert_close(one, other, rtol=0, atol=1e-5)


def padded(vectors: VectorTensors, *, agents: int, lines: int) -> VectorTensors:
    """Appends agents and lines that are not valid."""
    return VectorTensors(
        torch.nn.functional.pad(vectors.agents, (0, 0, 0, 0, 0, agents)),
        torch.nn.functional.pad(vectors.agents_valid, (0, 0, 0, agents)),
        torch.nn.functional.pad(vectors.lines, (0, 0, 0, 0, 0, lines)),
        torch.nn.functional.pad(vectors.lines_valid, (0, 0, 0, lines)),
    )


def test_shape() -> None:
    """Five targets have five rows of seven features, all of them different."""
    values = features(make_vectors())
    assert values.shape == (5, 7)
    assert len(torch.unique(values, dim=0)) == 5


def test_reads_what_the_view_draws() -> None:
    """The vectors of two scenes have different, finite features."""
    view = VectorView()
    encoder = make_encoder(view.shape)
    with torch.inference_mode():
        one, other = (
            encoder(VectorTensors(*map(torch.from_numpy, view.render(busy_scene(seed)))))
            for seed in (0, 1)
        )
    assert one.shape == (5, 7)
    assert torch.isfinite(one).all()
    assert ((one - other).abs().amax(dim=1) > 1e-3).all()


@pytest.mark.parametrize("garbage", [math.nan, math.inf, 1e30, 3.0])
def test_invalid_entries_have_no_influence(garbage: float) -> None:
    """Features are equal bit for bit with any values in invalid entries."""
    vectors = make_vectors()
    dirty = vectors._replace(
        agents=vectors.agents.masked_fill(~vectors.agents_valid[..., None], garbage),
        lines=vectors.lines.masked_fill(~vectors.lines_valid[..., None], garbage),
    )
    assert torch.equal(features(dirty), features(vectors))


def test_order_has_no_influence() -> None:
    """Neighbours and lines in another order have the same features."""
    vectors = make_vectors()
    agents = torch.tensor([0, 3, 5, 1, 4, 2])
    lines = torch.from_numpy(np.random.default_rng(0).permutation(SHAPE.lines))
    shuffled = VectorTensors(
        vectors.agents[:, agents],
        vectors.agents_valid[:, agents],
        vectors.lines[:, lines],
        vectors.lines_valid[:, lines],
    )
    assert_close(features(shuffled), features(vectors))


def test_target_and_neighbour_are_not_exchangeable() -> None:
    vectors = make_vectors()
    swapped = torch.tensor([1, 0, 2, 3, 4, 5])
    other = vectors._replace(
        agents=vectors.agents[:, swapped], agents_valid=vectors.agents_valid[:, swapped]
    )
    assert ((features(other) - features(vectors)).abs().amax(dim=1) > 1e-3).all()


def test_padding_has_no_influence() -> None:
    vectors = make_vectors()
    assert_close(features(padded(vectors, agents=5, lines=20)), features(vectors))


def test_the_batch_has_no_influence() -> None:
    """Each target alone has the same features as in a batch."""
    vectors = make_vectors()
    together = features(vectors)
    for row in range(5):
        alone = VectorTensors(*(tensor[row : row + 1] for tensor in vectors))
        assert_close(features(alone), together[row : row + 1])


def test_every_valid_part_is_read() -> None:
    """Every tick of every agent and every point of every line changes only its own target."""
    vectors = make_vectors(2)
    whole = features(vectors)
    moved = vectors._replace(agents=vectors.agents.clone(), lines=vectors.lines.clone())
    for valid, values in (
        (vectors.agents_valid[0], moved.agents[0]),
        (vectors.lines_valid[0], moved.lines[0]),
    ):
        for place in valid.nonzero():
            row = values[tuple(place)]
            original = row.clone()
            row[0] += 3
            changed = features(moved)
            assert not torch.equal(changed[0], whole[0]), place
            assert torch.equal(changed[1], whole[1])
            row.copy_(original)


def test_without_neighbours_and_lines() -> None:
    """Features and gradients are finite, even if the target is not valid."""
    vectors = VectorTensors(*(torch.zeros_like(tensor) for tensor in make_vectors()))
    vectors.agents_valid[:3, 0] = True
    encoder = make_encoder()
    values = encoder(vectors)
    values.sum().backward()
    assert torch.isfinite(values).all()
    assert all(torch.isfinite(gradient).all() for gradient in gradients(encoder))


def test_every_parameter_has_a_gradient() -> None:
    encoder = make_encoder()
    encoder(make_vectors()).square().sum().backward()
    assert len(gradients(encoder)) == len(list(encoder.parameters()))
    assert all(gradient.any() for gradient in gradients(encoder))


def test_bfloat16() -> None:
    """Under autocast features differ from float32 by less than 2 %; gradients are finite."""
    encoder, vectors = make_encoder(), make_vectors()
    exact = encoder(vectors)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        rough = encoder(vectors)
    assert (rough.float() - exact).abs().max() < 0.02 * exact.abs().max()
    rough.float().sum().backward()
    assert all(torch.isfinite(gradient).all() for gradient in gradients(encoder))


def test_heads_must_divide_the_width() -> None:
    with pytest.raises(AspEnvError, match="width 16 with 3 heads"):
        VectorEncoder(SHAPE, 7, width=16, heads=3)
