"""FFW-ASP: shapes, limits, options, and that it can learn at all."""

import dataclasses

import numpy as np
import pytest
import torch

from asp_env.data.snippets import index_snippets
from asp_env.dynamics import MAX_ACCELERATION_MPS2, MAX_STEERING_RAD
from asp_env.errors import AspEnvError
from asp_env.views import make_view
from predictors.batch import Batch, Labels
from predictors.ffw_asp import FFWASPConfig, FFWASPNetwork
from predictors.learned import Modes, NetworkShape
from predictors.samples import Batches
from tests.builders import make_recording
from tests.predictors.tiny import NETWORK

SHAPE = NetworkShape(raster=(12, 36, 24), history=15, horizon=15, dt_s=0.2, action_range=(4.0, 0.5))


def make_network(config: FFWASPConfig, shape: NetworkShape = SHAPE) -> FFWASPNetwork:
    """A network whose random weights do not touch the global state."""
    with torch.random.fork_rng():
        torch.manual_seed(0)
        return FFWASPNetwork(config, shape)


@pytest.fixture(scope="module")
def sample() -> tuple[Batch, Labels]:
    """Four snippets of turning, braking and straight vehicles."""
    recordings = [make_recording()]
    index = index_snippets(recordings, dt_s=0.2, horizon_s=3.0)
    chosen = index.select(np.array([8, 30, 41, 55]))
    view = make_view("chauffeurnet", height_px=36, width_px=24)
    return next(iter(Batches(recordings, chosen, view=view, batch_size=4)))


OPTIONS = {
    "paper's head": {"skip": False, "hidden": 0},
    "skip": {"skip": True, "hidden": 0},
    "hidden": {"skip": False, "hidden": 8},
    "euler": {"integrator": "euler"},
    "one mode": {"modes": 1},
    "literal classification": {"classification": "softmax"},
    "resnet": {"encoder": "resnet18"},
}


@pytest.mark.parametrize("option", OPTIONS, ids=list(OPTIONS))
def test_every_option_gives_modes_and_gradients(option: str, sample: tuple[Batch, Labels]) -> None:
    """Shapes (4, M, 15, ·), actions within limits, and finite gradients for all weights."""
    batch, labels = sample
    network = make_network(dataclasses.replace(NETWORK, **OPTIONS[option]))
    modes = network(batch)
    m = network.config.modes
    assert modes.actions.shape == (4, m, 15, 2)
    assert modes.states.shape == (4, m, 15, 4)
    assert modes.logits.shape == (4, m)
    assert float(modes.actions.detach()[..., 0].abs().max()) <= MAX_ACCELERATION_MPS2
    assert float(modes.actions.detach()[..., 1].abs().max()) <= MAX_STEERING_RAD
    terms = network.loss(modes, labels)
    assert torch.equal(terms["loss"], terms["regression"] + terms["classification"])
    terms["loss"].backward()
    for name, parameter in network.named_parameters():
        assert parameter.grad is not None, name
        assert torch.isfinite(parameter.grad).all(), name


def test_states_follow_from_actions_by_hand(sample: tuple[Batch, Labels]) -> None:
    """From rest at 2 m/s² under Heun: 0.04 m after 0.2 s, 0.16 m after 0.4 s, then at 0.8 m/s."""
    network = make_network(NETWORK)
    batch = sample[0]._replace(speed_mps=torch.zeros(4))
    actions = torch.tensor([2.0, 0.0]).expand(4, 3, 15, 2)
    states = network._drive(actions, batch)
    np.testing.assert_allclose(states[0, 0, :2, 0], [0.04, 0.16], atol=1e-6)
    np.testing.assert_allclose(states[0, 0, :2, 3], [0.4, 0.8], atol=1e-6)
    assert not states[..., 1].any()


def test_outputs_are_tanh_times_the_range(sample: tuple[Batch, Labels]) -> None:
    """With a bias of atanh(0.5) and no weights every action is half of the range (4, 0.5)."""
    network = make_network(dataclasses.replace(NETWORK, hidden=0))
    with torch.no_grad():
        linear = network.head[-1]
        linear.get_parameter("weight").zero_()
        linear.get_parameter("bias").fill_(float(np.arctanh(0.5)))
        modes: Modes = network.eval()(sample[0])
    np.testing.assert_allclose(modes.actions[..., 0], 2.0, atol=1e-5)
    np.testing.assert_allclose(modes.actions[..., 1], 0.25, atol=1e-6)


def test_overfits_four_snippets(sample: tuple[Batch, Labels]) -> None:
    """After 400 steps the most probable mode is within 0.6 m of four labels at every tick."""
    batch, labels = sample
    config = dataclasses.replace(NETWORK, features=32, gru_width=32, hidden=32)
    network = make_network(config)
    optimizer = torch.optim.Adam(network.parameters(), lr=5e-3)
    falling = torch.optim.lr_scheduler.LinearLR(
        optimizer, start_factor=1.0, end_factor=0.0, total_iters=400
    )
    for _ in range(400):
        optimizer.zero_grad()
        network.loss(network(batch), labels)["loss"].backward()
        optimizer.step()
        falling.step()
    with torch.no_grad():
        modes: Modes = network(batch)
    chosen = modes.states[torch.arange(4), modes.logits.argmax(dim=1)]
    error = torch.linalg.vector_norm(chosen[..., :2] - labels.states[..., :2], dim=-1)
    assert float(error.max()) < 0.6


@pytest.mark.parametrize("field", ["features", "gru_width", "gru_layers", "modes"])
def test_sizes_of_zero_are_refused(field: str) -> None:
    """No features, width, layers or modes is one line."""
    with pytest.raises(AspEnvError, match=f"{field} is 0, expected 1 or more"):
        dataclasses.replace(NETWORK, **{field: 0})
