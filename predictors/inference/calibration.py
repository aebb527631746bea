"""Calibration of the modes' probabilities by temperatures (Guo et al. 2017)."""

from collections.abc import Callable, Iterable

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from lightning.fabric.utilities import move_data_to_device

from predictors.models.batch import Batch, Labels
from predictors.models.losses import best_mode, stands
from predictors.models.network import FAST_LOGIT, AbstractNetwork, Modes

LIMITS = (0.05, 20.0)
"""Lowest and highest temperature. Chosen by hand."""

STEPS = 60
"""Steps of the search; each reduces the interval to 0.62 of it, so the last is 2e-12 wide."""

ACCELERATION_SCALES = (1.0, 0.95, 0.9, 0.85, 0.8)
"""Factors on forecast accelerations that are tried. Chosen by hand: highway-env's vehicles keep
their speed more than recorded ones, so that smaller factors would be fitted to them alone."""

NEWTON_STEPS = 20
"""Steps of the logistic fit, which converges in fewer."""

_GOLDEN = (np.sqrt(5.0) - 1) / 2


def calibrate(network: AbstractNetwork, batches: Iterable[tuple[Batch, Labels]]) -> float:
    """Fits the temperatures of a network on validation data.

    The factor of the accelerations is fitted first, if the network has one, then the merging
    temperature, if it merges chains, and both are stored in the network; where all chains of all
    segments would be too many it is fitted on the first segments. The temperature of its forecasts
    and the probability of standing are fitted next. A GPU is used if there is one: at full size a
    CPU would take longer than the training. Afterwards the network is on the CPU, in evaluation
    mode.

    Args:
        network: The trained network.
        batches: Inputs and labels, iterated once for each temperature.

    Returns:
        The divisor of the logits of its forecasts.
    """
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    network.eval().to(device)
    _fit_acceleration_scale(network, batches, device)
    if network.merging_temperature is not None:
        merging = _temperature(network.all_chains, batches, device)
        network.merging_temperature.fill_(merging)
    temperature = _temperature(network, batches, device)
    _calibrate_standing(network, batches, device)
    network.cpu()
    return temperature


def forecast_temperature(
    network: AbstractNetwork, batches: Iterable[tuple[Batch, Labels]]
) -> float:
    """Fits the temperature of a network's forecasts alone, which changes no position and no order.

    The merging temperature remains, because the merged modes depend on it.

    Args:
        network: The network; as after `calibrate`.
        batches: Inputs and labels.

    Returns:
        The divisor of the logits of its forecasts.
    """
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    temperature = _temperature(network.eval().to(device), batches, device)
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
            truth = labels.states[:, : modes.states.shape[2], :2]
            nearest = best_mode(modes.states[..., :2], truth, "distance")
            learned = torch.ones_like(nearest, dtype=torch.bool)
            if modes.standing is not None:
                learned = ~stands(labels.states)
            logits.append(modes.logits[learned].cpu().numpy())
            best.append(nearest[learned].cpu().numpy())
    return fit_temperature(np.concatenate(logits), np.concatenate(best))


def _fit_acceleration_scale(
    network: AbstractNetwork, batches: Iterable[tuple[Batch, Labels]], device: torch.device
) -> None:
    """Fits the factor on the FDE of the most probable mode of targets that do not stand."""
    if network.acceleration_scale is None:
        return
    errors_m = []
    for scale in ACCELERATION_SCALES:
        network.acceleration_scale.fill_(scale)
        total, count = 0.0, 0
        with torch.inference_mode():
            for sample in batches:
                batch, labels = move_data_to_device(sample, device)
                modes = network(batch)
                rows = torch.arange(len(modes.logits), device=device)
                ends = modes.states[rows, modes.logits.argmax(dim=1), -1, :2]
                error_m = torch.linalg.vector_norm(ends - labels.states[:, -1, :2], dim=-1)
                away = ~stands(labels.states)
                total += float(error_m[away].double().sum())
                count += int(away.sum())
        errors_m.append(total / max(count, 1))
    best = ACCELERATION_SCALES[int(np.argmin(errors_m))]
    network.acceleration_scale.fill_(best)


def _calibrate_standing(
    network: AbstractNetwork, batches: Iterable[tuple[Batch, Labels]], device: torch.device
) -> None:
    """Fits the slope and the shift of the logit of standing on slow targets, if there is one."""
    if network.standing_head is None:
        return
    logits, stand = [], []
    with torch.inference_mode():
        for sample in batches:
            batch, labels = move_data_to_device(sample, device)
            logit = network(batch).standing
            assert logit is not None
            slow = logit > FAST_LOGIT
            logits.append(logit[slow].cpu().numpy())
            stand.append(stands(labels.states)[slow].cpu().numpy())
    fitted = fit_logistic(np.concatenate(logits), np.concatenate(stand))
    network.get_buffer("standing_calibration").copy_(torch.tensor(fitted))


def fit_logistic(
    logits: Float[np.ndarray, " n"], outcomes: Bool[np.ndarray, " n"]
) -> tuple[float, float]:
    """Fits a slope and a shift of logits to outcomes (Platt 1999), by Newton's method.

    A weak Gaussian prior about slope 1 and shift 0 with unit variances bounds both.

    Args:
        logits: Logits of probabilities.
        outcomes: Whether each event happened.

    Returns:
        Slope and shift; 1 and 0 without samples.
    """
    design = np.stack([logits.astype(np.float64), np.ones(len(logits))], axis=-1)
    prior = np.array([1.0, 0.0])
    fitted = prior.copy()
    for _ in range(NEWTON_STEPS):
        probability = 1 / (1 + np.exp(-np.clip(design @ fitted, -30, 30)))
        gradient = design.T @ (probability - outcomes) + fitted - prior
        weighted = design * (probability * (1 - probability))[:, None]
        fitted = fitted - np.linalg.solve(design.T @ weighted + np.eye(2), gradient)
    return float(fitted[0]), float(fitted[1])
