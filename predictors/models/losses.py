"""Which of several modes is trained on a label, and what it costs."""

from collections.abc import Mapping
from types import MappingProxyType
from typing import Literal

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn import functional

from asp_env.metrics.forecast import errors
from asp_env.metrics.forecast.errors import ModeRule, ends_in_true_direction

Assignment = Literal["angle", "distance", "angle-random"]
Classification = Literal["cross-entropy", "softmax"]

RULES: Mapping[Assignment, ModeRule] = MappingProxyType(
    {"angle": "paper", "angle-random": "paper", "distance": "ade"}
)
"""What each assignment is called where forecasts are judged."""

HUBER_M = 1.0

ANNEAL_FROM_M = 8.0
ANNEAL_UNTIL = 0.5
MIN_TEMPERATURE_M = 0.05


def best_mode(
    positions: Float[Tensor, "n m t 2"],
    label: Float[Tensor, "n t 2"],
    assignment: Assignment = "angle",
) -> Int[Tensor, " n"]:
    """The mode that each label is assigned to. Positions are seen from the agent, now at (0, 0).

    `distance` takes the mode with the lowest mean L2 distance. `angle` (Cui et al. 2019, and the
    paper) takes it among the modes whose last point lies within 5° of the label's last point, seen
    from the agent; where there is none it takes the lowest distance of all. A label that ends
    within 2 m has no direction: distance alone. `angle-random` is `angle` but in losses, where it
    takes `chance_mode` if there is none.
    """
    return errors.best_mode(positions, label, RULES[assignment])


def chance_mode(
    positions: Float[Tensor, "n m t 2"], label: Float[Tensor, "n t 2"]
) -> Int[Tensor, " n"]:
    """As `best_mode` by angle, but where no mode is within 5° any one, as in the published code.

    Without that, a mode that wins all labels at first may keep them: others never learn. Chance is
    read off the last bits of the distances, so that equal weights and labels draw alike.
    """
    distance = torch.linalg.vector_norm(positions - label[:, None], dim=-1).mean(dim=-1)
    bits = distance.float().contiguous().view(torch.int32).long()
    drawn = (bits * 2_654_435_761 >> 8 & 0xFFFF).argmax(dim=1)
    decided = ends_in_true_direction(positions, label).any(dim=1)
    return torch.where(decided, best_mode(positions, label, "angle"), drawn)


def mode_terms(
    positions: Float[Tensor, "n m t 2"],
    logits: Float[Tensor, "n m"],
    label: Float[Tensor, "n t 2"],
    *,
    assignment: Assignment,
    classification: Classification,
    share: float | None,
) -> dict[str, Tensor]:
    """The losses `regression` and `classification` of modes against labels.

    Args:
        positions: of the modes, seen from the agent, now at (0, 0).
        logits: of the modes.
        label: what happened.
        assignment: which mode is the best one.
        classification: what its improbability costs.
        share: of the training that is over, for annealing; None trains the best mode alone.
    """
    if assignment == "angle-random":
        best = chance_mode(positions.detach(), label)
    else:
        best = best_mode(positions.detach(), label, assignment)
    if share is None:
        regression = regression_loss(positions, label, best)
    else:
        regression = annealed_loss(positions, label, best, share)
    return {
        "regression": regression,
        "classification": classification_loss(logits, best, classification),
    }


def annealed_loss(
    positions: Float[Tensor, "n m t 2"],
    label: Float[Tensor, "n t 2"],
    best: Int[Tensor, " n"],
    share: float,
) -> Float[Tensor, ""]:
    """Huber loss of all modes, weighted by the softmin of their mean distances over a temperature.

    The temperature falls along a line from 8 m to zero at half of the training; from there on the
    best mode alone learns (annealed winner-takes-all, Perera et al. 2024).
    """
    temperature_m = ANNEAL_FROM_M * (1 - share / ANNEAL_UNTIL)
    if temperature_m <= MIN_TEMPERATURE_M:
        return regression_loss(positions, label, best)
    delta = positions - label[:, None]
    distance = torch.linalg.vector_norm(delta.detach(), dim=-1).mean(dim=-1)
    weights = (-distance / temperature_m).softmax(dim=1)
    huber = functional.huber_loss(delta, torch.zeros_like(delta), delta=HUBER_M, reduction="none")
    return (weights * huber.mean(dim=(2, 3))).sum(dim=1).mean()


def regression_loss(
    positions: Float[Tensor, "n m t 2"], label: Float[Tensor, "n t 2"], best: Int[Tensor, " n"]
) -> Float[Tensor, ""]:
    """Huber loss with h = 1 of the best modes' positions, mean over targets, ticks, coordinates."""
    chosen = positions[torch.arange(len(best), device=best.device), best]
    return functional.huber_loss(chosen, label, delta=HUBER_M)


def classification_loss(
    logits: Float[Tensor, "n m"],
    best: Int[Tensor, " n"],
    kind: Classification = "cross-entropy",
) -> Float[Tensor, ""]:
    """How improbable the best modes are, mean over targets.

    `softmax` is the paper's formula read literally, the negative probability; its gradient vanishes
    where that probability is near zero, so the cross-entropy is the default.
    """
    if kind == "softmax":
        probability = logits.softmax(dim=1).gather(1, best[:, None])
        return -probability.mean()
    return functional.cross_entropy(logits, best)


def into_frame(
    positions: Float[Tensor, "*batch t 2"], origin: Float[Tensor, "*#batch 4"]
) -> Float[Tensor, "*batch t 2"]:
    """Positions as seen from states [x, y, heading, speed]: x ahead, y left."""
    delta = positions - origin[..., None, :2]
    cos, sin = origin[..., None, 2].cos(), origin[..., None, 2].sin()
    ahead = cos * delta[..., 0] + sin * delta[..., 1]
    return torch.stack([ahead, cos * delta[..., 1] - sin * delta[..., 0]], dim=-1)
