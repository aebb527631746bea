"""Every network with each of its options: shapes, limits, gradients and inputs."""

import dataclasses
import math
from typing import Any

import numpy as np
import pytest
import torch

from asp_env.data.classes import AgentClass
from asp_env.data.snippets import gather_scene, index_snippets
from asp_env.dynamics import MAX_ACCELERATION_MPS2, MAX_STEERING_RAD
from asp_env.errors import AspEnvError
from asp_env.views import make_view
from predictors.models.batch import Batch, Labels, make_batch
from predictors.models.network import AbstractNetwork, Modes, TrainingProgress, rollout_from_now
from tests.builders import Drive, make_recording
from tests.predictors.tiny import draw_samples, make_network, tiny_network, tiny_shape

TRAINABLE = ("mtp", "dkm", "ffw-asp", "ssp-asp")

OPTIONS: dict[str, tuple[str, dict[str, Any]]] = {
    "mtp": ("mtp", {}),
    "dkm": ("dkm", {}),
    "dkm of one mode": ("dkm", {"modes": 1}),
    "dkm with ResNet18": ("dkm", {"encoder": "resnet18"}),
    "dkm with literal classification": ("dkm", {"classification": "softmax"}),
    "dkm with annealing": ("dkm", {"annealed": True}),
    "dkm by distance": ("dkm", {"assignment": "distance"}),
    "dkm by angle or at random": ("dkm", {"assignment": "angle-random"}),
    "ffw-asp": ("ffw-asp", {}),
    "ffw-asp with skip": ("ffw-asp", {"skip": True}),
    "ffw-asp with a hidden layer": ("ffw-asp", {"hidden": 8}),
    "ffw-asp with two layers": ("ffw-asp", {"gru_layers": 2}),
    "ffw-asp under Euler": ("ffw-asp", {"integrator": "euler"}),
    "ffw-asp with DKM's head": ("ffw-asp", {"head": "connected", "hidden": 8}),
    "ffw-asp with DKM's head and skip": ("ffw-asp", {"head": "connected", "skip": True}),
    "ffw-asp unrolled": ("ffw-asp", {"decoder": "unrolled"}),
    "ffw-asp unrolled with skip": ("ffw-asp", {"decoder": "unrolled", "skip": True, "hidden": 8}),
    "ssp-asp": ("ssp-asp", {}),
    "ssp-asp unrolled": ("ssp-asp", {"decoder": "unrolled"}),
    "ssp-asp unrolled with skip": ("ssp-asp", {"decoder": "unrolled", "skip": True, "hidden": 8}),
    "ssp-asp with skip": ("ssp-asp", {"skip": True, "hidden": 8}),
    "ssp-asp with two layers": ("ssp-asp", {"gru_layers": 2}),
    "ssp-asp normalised": ("ssp-asp", {"normalise": True, "stop_gradient": True}),
    "ssp-asp with a second encoder": ("ssp-asp", {"ema": 0.9}),
    "ssp-asp without encoded branch": ("ssp-asp", {"encoded_branch": False}),
    "ssp-asp scheduled": ("ssp-asp", {"scheduled": True}),
    "ssp-asp annealed": ("ssp-asp", {"annealed": True}),
    "ssp-asp under Euler": ("ssp-asp", {"integrator": "euler"}),
    **{f"{each} standing": (each, {"standing": True}) for each in TRAINABLE},
}


@pytest.fixture(scope="module")
def sample() -> tuple[Batch, Labels]:
    """Four snippets of vehicles that turn, brake and drive straight."""
    return draw_samples([8, 30, 41, 55], later_ticks=(15,))


def tiny(predictor: str, **changes: Any) -> AbstractNetwork:
    """A tiny network for rasters."""
    return make_network(predictor, tiny_network(predictor, **changes), tiny_shape())


@pytest.mark.parametrize("option", OPTIONS, ids=list(OPTIONS))
def test_every_option_has_modes_and_gradients(option: str, sample: tuple[Batch, Labels]) -> None:
    """Shapes (4, M, 15, ·), actions within limits, and finite gradients of all parameters."""
    batch, labels = sample
    predictor, changes = OPTIONS[option]
    network = tiny(predictor, **changes)
    modes = network(batch)
    m = network.config.modes
    assert modes.states.shape == (4, m, 15, 4)
    assert modes.logits.shape == (4, m)
    if modes.actions is not None:
        assert modes.actions.shape == (4, m, 15, 2)
        assert float(modes.actions.detach()[..., 0].abs().max()) <= MAX_ACCELERATION_MPS2
        assert float(modes.actions.detach()[..., 1].abs().max()) <= MAX_STEERING_RAD
    terms = network.training_loss(batch, labels, TrainingProgress(share=0.3))
    torch.testing.assert_close(terms["loss"], sum(terms[name] for name in terms if name != "loss"))
    terms["loss"].backward()
    for name, parameter in network.named_parameters():
        if parameter.requires_grad:
            assert parameter.grad is not None, name
            assert torch.isfinite(parameter.grad).all(), name


def test_classification_and_annealing_options(sample: tuple[Batch, Labels]) -> None:
    """The term `softmax` is in [-1, 0], the cross-entropy above 0; annealing ends at half-way."""
    literal = tiny("dkm", classification="softmax").training_loss(*sample, TrainingProgress())
    assert -1 <= float(literal["classification"].detach()) <= 0
    default = tiny("dkm").training_loss(*sample, TrainingProgress(share=0.1))
    assert float(default["classification"].detach()) > 0
    early, late = (
        tiny("dkm", annealed=True).training_loss(*sample, TrainingProgress(share=share))[
            "regression"
        ]
        for share in (0.1, 0.5)
    )
    assert float(early.detach()) > float(default["regression"].detach())
    assert torch.equal(late, default["regression"])


@pytest.mark.parametrize("predictor", ["dkm", "ffw-asp"])
def test_outputs_are_tanh_times_the_action_range(
    predictor: str, sample: tuple[Batch, Labels]
) -> None:
    """With a bias of atanh(0.5) and weights of 0 every action is half of the range (4, 0.5)."""
    network = tiny(predictor)
    linear = [each for each in network.modules() if isinstance(each, torch.nn.Linear)][-1]
    with torch.no_grad():
        linear.weight.zero_()
        linear.bias.fill_(math.atanh(0.5))
        modes: Modes = network.eval()(sample[0])
    assert modes.actions is not None
    np.testing.assert_allclose(modes.actions[..., 0], 2.0, atol=1e-5)
    np.testing.assert_allclose(modes.actions[..., 1], 0.25, atol=1e-6)


def test_states_follow_from_actions_by_hand(sample: tuple[Batch, Labels]) -> None:
    """From rest at 2 m/s² under Heun: 0.04 m after 0.2 s, 0.16 m after 0.4 s, then at 0.8 m/s.

    Under Euler 0 m and 0.08 m.
    """
    batch = sample[0]._replace(motion=torch.zeros(4, 3))
    actions = torch.tensor([2.0, 0.0]).expand(4, 3, 15, 2)
    for integrator, expected in (("heun", [0.04, 0.16]), ("euler", [0.0, 0.08])):
        named: Any = integrator
        states = rollout_from_now(actions, batch, 0.2, named)
        np.testing.assert_allclose(states[0, 0, :2, 0], expected, atol=1e-6)
        np.testing.assert_allclose(states[0, 0, :2, 3], [0.4, 0.8], atol=1e-6)
        assert not states[..., 1].any()


def test_a_reversing_target_is_forecast_to_reverse(sample: tuple[Batch, Labels]) -> None:
    """From -2 m/s without acceleration: -0.4 m every tick. Braking by 1 m/s² ends after 10 ticks.

    A target at 1 m/s that brakes by 2 m/s² stands after 3 ticks and never reverses.
    """
    motion = torch.tensor([[-2.0], [-2.0], [1.0], [1.0]]) * torch.tensor([1.0, 0.0, 0.0])
    batch = sample[0]._replace(motion=motion)
    actions = torch.zeros(4, 3, 15, 2)
    actions[1, :, :10, 0], actions[2, ..., 0] = 1.0, -2.0
    for integrator in ("heun", "euler"):
        named: Any = integrator
        states = rollout_from_now(actions, batch, 0.2, named)
        np.testing.assert_allclose(states[0, 0, :, 0], -0.4 * np.arange(1, 16), atol=1e-5)
        np.testing.assert_allclose(states[1, 0, 9:, 3], 0.0, atol=1e-5)
        assert not states[2, :, 2:, 3].any()
        assert (states[2, :, :, 0].diff() >= 0).all()


def test_motion_is_speed_acceleration_and_yaw_rate() -> None:
    """A car that brakes at 1 m/s² and turns left: speed now, -1 m/s², and v·sin β / l_r rad/s."""
    turning = Drive(kind=AgentClass.CAR, start=(0.0, 0.0, 3.0, 12.0), phases=((60.0, -1.0, 0.1),))
    recording = make_recording(drives=(turning,), duration_s=8.0)
    index = index_snippets([recording], dt_s=0.2, horizon_s=3.0)
    scene = gather_scene([recording], index.select(np.array([0])))
    batch = make_batch(scene, make_view("vectors"), 15)
    now_s = float(scene.tick[0]) * 0.2
    speed, length = 12.0 - now_s, float(batch.length_m[0])
    mean_speed = speed + 0.1
    yaw_rate = mean_speed * math.sin(math.atan(0.5 * math.tan(0.1))) / (0.3 * length)
    np.testing.assert_allclose(batch.motion[0], [speed, -1.0, yaw_rate], atol=2e-3)
    np.testing.assert_allclose(batch.actions[0], [[-1.0, 0.1]] * 15, atol=2e-3)


INPUTS = {
    "mtp": {"motion", "observation"},
    "dkm": {"motion", "observation"},
    "ffw-asp": {"actions", "observation"},
    "ssp-asp": {"actions", "observation"},
}


@pytest.mark.parametrize("predictor", INPUTS)
def test_networks_read_the_inputs_of_the_papers(
    predictor: str, sample: tuple[Batch, Labels]
) -> None:
    """DKM and MTP read the present motion, the others past actions, as their logits show."""
    batch = sample[0]
    network = tiny(predictor).eval()
    assert not isinstance(batch.observation, tuple)
    changed = {
        "observation": batch._replace(observation=batch.observation.flip(0)),
        "actions": batch._replace(actions=batch.actions.flip(0) + 0.5),
        "motion": batch._replace(motion=batch.motion.flip(0)),
    }
    with torch.no_grad():
        before: Modes = network(batch)
        read = {
            name
            for name, other in changed.items()
            if not torch.equal(before.logits, network(other).logits)
        }
    assert read == INPUTS[predictor]


def test_skip_connects_the_speed_to_the_output(sample: tuple[Batch, Labels]) -> None:
    """Another speed changes the logits only with `skip`."""
    batch = sample[0]
    faster = batch._replace(motion=batch.motion + torch.tensor([3.0, 0.0, 0.0]))
    for predictor in ("ffw-asp", "ssp-asp"):
        for skip in (False, True):
            network = tiny(predictor, skip=skip).eval()
            with torch.no_grad():
                one, two = network(batch), network(faster)
            assert torch.equal(one.logits, two.logits) != skip


@pytest.mark.parametrize("predictor", ["mtp", "dkm", "ffw-asp"])
@pytest.mark.parametrize("field", ["features", "modes", "hidden", "gru_width", "gru_layers"])
def test_impossible_sizes_are_refused(predictor: str, field: str) -> None:
    """Negative numbers of features, modes, layers or units are refused in one line."""
    config = tiny_network(predictor)
    if not hasattr(config, field):
        return
    changes: Any = {field: -1}
    with pytest.raises(AspEnvError, match=f"{field} is -1, expected") as caught:
        dataclasses.replace(config, **changes)
    assert "\n" not in str(caught.value)
