"""Calibration of the modes' probabilities by temperatures (Guo et al. 2017)."""

from collections.abc import Callable, Iterable

import numpy as np
import torch
from jaxtyping import Float, Int
from lightning.fabric.utilities import move_data_to_device

from predictors.models.batch import Batch, Labels
from predictors.models.losses import best_mode
from predictors.models.network import AbstractNetwork, Modes

LIMITS = (0.05, 20.0)
"""Lowest and highest temperature. Chosen by hand."""

STEPS = 60
"""Steps of the search; each reduces the interval to 0.62 of it, so the last is 2e-12 wide."""

_GOLDEN = (np.sqrt(5.0) - 1) / 2


def calibrate(network: AbstractNetwork, batches: Iterable[tuple[Batch, Labels]]) -> float:
    """Fits the temperatures of a network on validation data.

    The merging temperature is fitted first, if the network merges chains, and stored in it; where
    all chains of all segments would be too many it is fitted on the first segments. The temperature
    of its forecasts is fitted next. A GPU is used if there is one: at full size a CPU would take
    longer than the training. Afterwards the network is on the CPU, in evaluation mode.

    Args:
        network: The trained network.
        batches: Inputs and labels, iterated once for each temperature.

    Returns:
        The divisor of the logits of its forecasts.
    """
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    network.eval().to(device)
    if network.merging_temperature is not None:
        merging = _temperature(network.all_chains, batches, device)
        network.merging_temperature.fill_(merging)
    temperature = _temperature(network, batches, device)
    network.cpu()
    return temperature


def fit_temperature(logits: Float[np.ndarray, "n m"], best: Int[np.ndarray, " n"]) -> float:
    """Finds the divisor of logits that minimises the cross-entropy of the best modes.

    Golden-section search on the logarithm of the temperature; the mean cross-entropy is convex in
    its inverse.

    Args:
        logits: Logits of the modes.
        best: Index of the mode that is nearest to each label.

    Returns:
        A temperature within `LIMITS`; 1 if there is no sample or only one mode.
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
    """Mean negative logarithm of the best modes' probabilities at a temperature."""
    scaled = logits.astype(np.float64) / temperature
    scaled -= scaled.max(axis=1, keepdims=True)
    total = np.log(np.exp(scaled).sum(axis=1))
    return float((total - scaled[np.arange(len(best)), best]).mean())


def _temperature(
    forecast: Callable[[Batch], Modes],
    batches: Iterable[tuple[Batch, Labels]],
    device: torch.device,
) -> float:
    logits, best = [], []
    with torch.inference_mode():
        for sample in batches:
            batch, labels = move_data_to_device(sample, device)
            modes = forecast(batch)
            logits.append(modes.logits.cpu().numpy())
            truth = labels.states[:, : modes.states.shape[2], :2]
            nearest = best_mode(modes.states[..., :2], truth, "distance")
            best.append(nearest.cpu().numpy())
    return fit_temperature(np.concatenate(logits), np.concatenate(best))
