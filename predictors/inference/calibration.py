"""Calibrating the probabilities of modes by temperatures (Guo et al. 2017)."""

from collections.abc import Callable

import numpy as np
import torch
from jaxtyping import Float, Int
from lightning.fabric.utilities import move_data_to_device

from predictors.models.batch import Batch
from predictors.models.losses import best_mode
from predictors.models.network import AbstractNetwork, Modes
from predictors.models.ssp_asp import SSPASPNetwork
from predictors.training.data import Batches

LIMITS = (0.05, 20.0)
STEPS = 60
_GOLDEN = (np.sqrt(5.0) - 1) / 2


def calibrate(network: AbstractNetwork, batches: Batches) -> float:
    """Calibrates a network on validation data; leaves it evaluating, on the CPU.

    Worked out on a GPU where there is one: at full size a CPU would take longer than the training.

    Returns:
        What the logits of its forecasts are to be divided by. What those of chains are divided by
        before they are merged, where any are, the network keeps.
    """
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    network.eval().to(device)
    if isinstance(network, SSPASPNetwork) and network.merging_temperature is not None:
        found = _temperature(lambda batch: network.chain(batch, "full"), batches, device)
        network.merging_temperature.fill_(found)
    temperature = _temperature(network, batches, device)
    network.cpu()
    return temperature


def _temperature(
    forecast: Callable[[Batch], Modes], batches: Batches, device: torch.device
) -> float:
    logits, best = [], []
    with torch.inference_mode():
        for each in batches:
            batch, labels = move_data_to_device(each, device)
            modes = forecast(batch)
            logits.append(modes.logits.cpu().numpy())
            nearest = best_mode(modes.states[..., :2], labels.states[..., :2], "distance")
            best.append(nearest.cpu().numpy())
    return fit_temperature(np.concatenate(logits), np.concatenate(best))


def fit_temperature(logits: Float[np.ndarray, "n m"], best: Int[np.ndarray, " n"]) -> float:
    """What logits are to be divided by so that the best modes are the least improbable.

    Golden-section search on the logarithm: in 1/temperature the mean cross-entropy is convex.

    Args:
        logits: of the modes.
        best: the mode that each label is nearest to.
    """
    if len(logits) == 0 or logits.shape[1] == 1:
        return 1.0
    low, high = np.log(LIMITS[0]), np.log(LIMITS[1])
    for _ in range(STEPS):
        left, right = high - _GOLDEN * (high - low), low + _GOLDEN * (high - low)
        if cross_entropy(logits, best, np.exp(left)) < cross_entropy(logits, best, np.exp(right)):
            high = right
        else:
            low = left
    return float(np.exp((low + high) / 2))


def cross_entropy(
    logits: Float[np.ndarray, "n m"], best: Int[np.ndarray, " n"], temperature: float
) -> float:
    """Mean of minus the logarithm of the best modes' probabilities."""
    scaled = logits.astype(np.float64) / temperature
    scaled -= scaled.max(axis=1, keepdims=True)
    total = np.log(np.exp(scaled).sum(axis=1))
    return float((total - scaled[np.arange(len(best)), best]).mean())
