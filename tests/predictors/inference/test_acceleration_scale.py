"""The factor on forecast accelerations: where it acts, and that the best one is found."""

import numpy as np
import pytest
import torch

from predictors.inference.calibration import ACCELERATION_SCALES, calibrate
from predictors.models.network import AbstractNetwork
from tests.predictors.tiny import draw_samples, make_network, tiny_network, tiny_shape

ACTION_SPACE = ("dkm", "ffw-asp", "ssp-asp")


def shrunk(predictor: str) -> AbstractNetwork:
    return make_network(predictor, tiny_network(predictor, shrunk=True), tiny_shape()).eval()


@pytest.mark.parametrize("predictor", ACTION_SPACE)
def test_the_factor_acts_on_accelerations_alone(predictor: str) -> None:
    batch, _ = draw_samples([8, 30, 41, 55])
    network = shrunk(predictor)
    assert network.acceleration_scale is not None
    with torch.no_grad():
        whole = network(batch).actions
        network.acceleration_scale.fill_(0.5)
        half = network(batch).actions
    assert whole is not None
    assert half is not None
    np.testing.assert_allclose(half[..., 0], 0.5 * whole[..., 0], atol=1e-6)
    np.testing.assert_allclose(half[..., 1], whole[..., 1], atol=1e-6)


@pytest.mark.parametrize("true_scale", ACCELERATION_SCALES)
def test_calibration_finds_the_factor_of_the_labels(true_scale: float) -> None:
    """Labels that are the forecasts at a known factor."""
    batch, labels = draw_samples([8, 30, 41, 55])
    network = shrunk("dkm")
    assert network.acceleration_scale is not None
    with torch.no_grad():
        network.acceleration_scale.fill_(true_scale)
        modes = network(batch)
    states = modes.states[torch.arange(4), modes.logits.argmax(dim=1)]
    calibrate(network, [(batch, labels._replace(states=states))])
    assert float(network.acceleration_scale) == pytest.approx(true_scale)
