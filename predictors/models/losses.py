"""Losses of several modes against one label: best mode, regression, classification.

Janjoš et al. (2021) define them in equations 9 (Huber loss) and 10 (regression of the best mode and
classification).

Dimensions: n targets, m modes, t ticks. Positions are in the target's frame now, in metres.
"""

from collections.abc import Mapping
from types import MappingProxyType
from typing import Literal

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn import functional

from asp_env.geometry import to_frame
from asp_env.metrics.forecast import errors
from asp_env.metrics.forecast.errors import ModeRule, ends_in_true_direction

Assignment = Literal["angle", "distance", "angle-random"]
"""How the best mode of a label is chosen: see `best_mode` and `best_or_random_mode`."""

DEFAULT_ASSIGNMENT: Assignment = "angle"
"""The assignment of every recipe that sets none (`cpu` and `paper` of all predictors).

It is that of the paper's text.
"""

Classification = Literal["cross-entropy", "softmax"]
"""The classification term: see `classification_loss`."""

RULES: Mapping[Assignment, ModeRule] = MappingProxyType(
    {"angle": "paper", "angle-random": "paper", "distance": "ade"}
)
"""The rule of `asp_env.metrics.forecast` that each assignment corresponds to."""

HUBER_M = 1.0
"""Cut-off h of the Huber loss (equation 9 of Janjoš et al. 2021)."""

STANDS_M = 1.0
"""A target that stays within this distance stands. Chosen by hand: above the errors of trackers at
standstill and the way of a vehicle that creeps, below the motion of a vehicle that starts."""

ANNEAL_FROM_M = 8.0
"""Temperature at the start of annealing. Chosen by hand: far modes still get a gradient."""

ANNEAL_UNTIL = 0.5
"""Share of the training after which only the best mode learns. Chosen by hand."""

MIN_TEMPERATURE_M = 0.05
"""Below this temperature the softmin is replaced by the best mode. Chosen by hand: it keeps the
division by the temperature finite."""


def best_mode(
    positions: Float[Tensor, "n m t 2"],
    label: Float[Tensor, "n t 2"],
    assignment: Assignment = "angle",
) -> Int[Tensor, " n"]:
    """Chooses the mode that each label is assigned to.

    `distance` takes the mode with the lowest mean L2 distance. `angle` (Cui et al. 2019, Janjoš et
    al. 2021) takes it among the modes whose last point lies within 5° of the label's last point,
    seen from the target; where there is none it takes the lowest distance of all modes. A label
    that ends within 2 m has no direction, so its assignment is by distance. `angle-random` is
    `angle` here; only in `mode_terms` it stands for `best_or_random_mode`.

    Args:
        positions: Positions of the modes.
        label: Recorded positions.
        assignment: The rule.

    Returns:
        The index of a mode for each target.
    """
    return errors.best_mode(positions, label, RULES[assignment])


def best_or_random_mode(
    positions: Float[Tensor, "n m t 2"], label: Float[Tensor, "n t 2"]
) -> Int[Tensor, " n"]:
    """Chooses as `best_mode` by angle, but a random mode where none lies within 5°.

    This is the rule of the published code of MTP (Cui et al. 2019). Where all inputs are equal, a
    mode that wins all labels at first may keep winning them without it. The random choice is
    derived from the last bits of the distances (multiplicative hashing, Knuth), so that equal
    weights and labels give equal choices.

    Args:
        positions: Positions of the modes.
        label: Recorded positions.

    Returns:
        The index of a mode for each target.
    """
    distance = torch.linalg.vector_norm(positions - label[:, None], dim=-1).mean(dim=-1)
    bits = distance.float().contiguous().view(torch.int32).long()
    random = (bits * 2_654_435_761 >> 8 & 0xFFFF).argmax(dim=1)
    decided = ends_in_true_direction(positions, label).any(dim=1)
    return torch.where(decided, best_mode(positions, label, "angle"), random)


def mode_terms(
    positions: Float[Tensor, "n m t 2"],
    logits: Float[Tensor, "n m"],
    label: Float[Tensor, "n t 2"],
    *,
    assignment: Assignment,
    classification: Classification,
    share: float | None,
    learned: Bool[Tensor, " n"] | None = None,
) -> dict[str, Tensor]:
    """The terms `regression` and `classification` of the loss.

    Args:
        positions: Positions of the modes.
        logits: Logits of the modes.
        label: Recorded positions.
        assignment: How the best mode is chosen.
        classification: The classification term.
        share: Share of the training that is over, for annealing; None trains the best mode alone.
        learned: Targets that the modes learn from; None for all.

    Returns:
        Scalars, means over these targets; zero if there are none.
    """
    if learned is not None:
        if not learned.any():
            zero = 0.0 * (positions.sum() + logits.sum())
            return {"regression": zero, "classification": zero}
        positions, logits, label = positions[learned], logits[learned], label[learned]
    if assignment == "angle-random":
        best = best_or_random_mode(positions.detach(), label)
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

    The temperature falls linearly from 8 m to zero at half of the training; from there on only the
    best mode learns (annealed winner-takes-all, Perera et al. 2024).

    Args:
        positions: Positions of the modes.
        label: Recorded positions.
        best: Index of the best mode of each target.
        share: Share of the training that is over.
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
    """Huber loss (equation 9) of the best modes' positions.

    Args:
        positions: Positions of the modes.
        label: Recorded positions.
        best: Index of the best mode of each target.

    Returns:
        The mean over targets, ticks and coordinates.
    """
    chosen = positions[torch.arange(len(best), device=best.device), best]
    return functional.huber_loss(chosen, label, delta=HUBER_M)


def classification_loss(
    logits: Float[Tensor, "n m"],
    best: Int[Tensor, " n"],
    kind: Classification = "cross-entropy",
) -> Float[Tensor, ""]:
    """The cost of improbable best modes.

    `softmax` is the last term of equation 10 read literally, the negative probability. Its gradient
    vanishes where the probability is near zero, so the cross-entropy is the default.

    Args:
        logits: Logits of the modes.
        best: Index of the best mode of each target.
        kind: The term.

    Returns:
        The mean over targets.
    """
    if kind == "softmax":
        probability = logits.softmax(dim=1).gather(1, best[:, None])
        return -probability.mean()
    return functional.cross_entropy(logits, best)


def stands(label: Float[Tensor, "n t _"]) -> Bool[Tensor, " n"]:
    """Whether a target stands: it is never more than 1 m from where it is now.

    Args:
        label: Recorded positions, or states that begin with them, in the targets' frames.
    """
    return (torch.linalg.vector_norm(label[..., :2], dim=-1) <= STANDS_M).all(dim=1)


def standing_loss(logit: Float[Tensor, " n"], label: Float[Tensor, "n t _"]) -> Float[Tensor, ""]:
    """Cross-entropy of the probability of standing.

    Args:
        logit: Logit of that probability.
        label: As in `stands`.
    """
    return functional.binary_cross_entropy_with_logits(logit, stands(label).to(logit.dtype))


def into_frame(
    positions: Float[Tensor, "*batch t 2"], origin: Float[Tensor, "*#batch 4"]
) -> Float[Tensor, "*batch t 2"]:
    """Transforms positions into the frames of states: x ahead, y left.

    Args:
        positions: Positions in the frame that the states are given in.
        origin: States [x, y, heading, speed].
    """
    return to_frame(positions, origin[..., None, :])
