"""Laws of the features extractors."""

import math

import numpy as np
import torch
from gymnasium import spaces

from policies.networks import RasterFeatures, TrafficFeatures, route_coordinates
from policies.observations import NEIGHBOUR_FIELDS, STATE

NEIGHBOURS = 6


def space(**more: tuple[int, ...]) -> spaces.Dict:
    shapes = {
        "state": (len(STATE),),
        "route": (30, 2),
        "neighbours": (NEIGHBOURS, NEIGHBOUR_FIELDS),
    }
    return spaces.Dict(
        {k: spaces.Box(-np.inf, np.inf, s, dtype=np.float32) for k, s in {**shapes, **more}.items()}
    )


def observations(of: spaces.Dict, seed: int = 0) -> dict[str, torch.Tensor]:
    generator = torch.Generator().manual_seed(seed)
    seen = {
        name: torch.randn((3, *(box.shape or ())), generator=generator) for name, box in of.items()
    }
    seen["neighbours"][..., -1] = 1.0
    return seen


def test_absent_neighbours_and_lines_have_no_effect() -> None:
    of = space(lines=(4, 10, 9))
    network, seen = TrafficFeatures(of, width=8), observations(of)
    seen["neighbours"][:, 3:, -1] = 0.0
    seen["lines"][..., -1] = 1.0
    seen["lines"][:, 2:, :, -1] = 0.0
    changed = {name: value.clone() for name, value in seen.items()}
    changed["neighbours"][:, 3:, :-1] += 5.0
    changed["lines"][:, 2:, :, :-1] += 5.0
    torch.testing.assert_close(network(seen), network(changed), rtol=0, atol=1e-6)


def test_the_order_of_neighbours_has_no_effect() -> None:
    of = space()
    network, seen = TrafficFeatures(of, width=8), observations(of)
    turned = {**seen, "neighbours": seen["neighbours"].flip(1)}
    torch.testing.assert_close(network(seen), network(turned), rtol=0, atol=1e-5)


def test_without_neighbours_the_features_are_finite() -> None:
    of = space()
    network, seen = TrafficFeatures(of, width=8), observations(of)
    seen["neighbours"][..., -1] = 0.0
    assert network(seen).isfinite().all()


def test_forecasts_belong_to_the_neighbour_of_the_same_rank() -> None:
    of = space(forecast=(4 * 2 * 2,), forecast_probabilities=(4,), forecast_valid=(4,))
    network, seen = TrafficFeatures(of, width=8), observations(of)
    seen["neighbours"][:, 1, -1] = 0.0
    changed = {name: value.clone() for name, value in seen.items()}
    changed["forecast"].view(3, 4, 2, 2)[:, 1] += 5.0
    torch.testing.assert_close(network(seen), network(changed), rtol=0, atol=1e-6)
    changed["forecast"].view(3, 4, 2, 2)[:, 2] += 5.0
    assert not torch.allclose(network(seen), network(changed), atol=1e-4)


def test_route_coordinates_by_hand() -> None:
    ahead = torch.arange(1, 31) * 2.0
    route = torch.stack([ahead, torch.zeros(30)], dim=-1)[None]
    points = torch.tensor([[[[10.0, 3.0], [40.0, -50.0]]]])
    along, offset, far_along, far_offset = route_coordinates(points, route)[0, 0].tolist()
    assert math.isclose(along, 10.0 / 20.0, abs_tol=1e-6)
    assert math.isclose(offset, 3.0 / 5.0, abs_tol=1e-5)
    assert math.isclose(far_along, 40.0 / 20.0, abs_tol=1e-6)
    assert far_offset == 2.0, "cut off at 10 m"


def test_a_given_encoder_stays_fixed() -> None:
    of = spaces.Dict(
        {
            "state": spaces.Box(-1, 1, (len(STATE),), dtype=np.float32),
            "route": spaces.Box(-1, 1, (30, 2), dtype=np.float32),
            "raster": spaces.Box(0, 255, (2, 24, 16), dtype=np.uint8),
        }
    )
    encoder = torch.nn.Sequential(torch.nn.Flatten(), torch.nn.Linear(2 * 24 * 16, 5))
    network = RasterFeatures(of, width=8, encoder=encoder)
    seen = {
        "state": torch.zeros(1, len(STATE)),
        "route": torch.zeros(1, 30, 2),
        "raster": torch.rand(1, 2, 24, 16),
    }
    network(seen).sum().backward()
    assert all(weight.grad is None for weight in encoder.parameters())
    assert network.head[0].weight.grad is not None
