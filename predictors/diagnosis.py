"""Whether features are alive: spread, effective rank, and how well they are foreseen."""

from typing import final

import torch
from jaxtyping import Float
from torch import Tensor

from predictors.network import Features


@final
class Diagnosis:
    """Gathers features over a validation set."""

    def __init__(self) -> None:
        """Empty."""
        self._encoded: list[Tensor] = []
        self._predicted: list[Tensor] = []

    def add(self, features: Features | None) -> None:
        """Keeps a batch's features, if the network has any to show."""
        if features is not None:
            self._encoded.append(features.encoded.float().cpu())
            self._predicted.append(features.predicted.float().cpu())

    def join(self, other: "Diagnosis") -> None:
        """Keeps what another one kept, of batches that another process saw."""
        self._encoded += other._encoded
        self._predicted += other._predicted

    def finish(self) -> dict[str, float]:
        """The numbers by name, of all that was added; nothing where nothing was."""
        if not self._encoded:
            return {}
        encoded, predicted = torch.cat(self._encoded), torch.cat(self._predicted)
        self._encoded.clear()
        self._predicted.clear()
        return {
            "feature standard deviation": float(encoded.std(dim=0, correction=0).mean()),
            "feature effective rank": effective_rank(encoded),
            "feature R2": r_squared(predicted, encoded),
        }


def effective_rank(features: Float[Tensor, "n z"]) -> float:
    """The exponential of the entropy of centred features' singular values (Roy & Vetterli 2007).

    1 where all features follow one line, z where they fill all directions alike; 0 where nothing
    varies.
    """
    values = torch.linalg.svdvals(features - features.mean(dim=0))
    total = values.sum()
    if total <= 0:
        return 0.0
    share = values / total
    share = share[share > 0]
    return float(torch.exp(-(share * share.log()).sum()))


def r_squared(predicted: Float[Tensor, "n z"], actual: Float[Tensor, "n z"]) -> float:
    """1 less the squared errors' share of the variance, over all coordinates together.

    1 is a perfect prediction, 0 no better than the mean; 0 where nothing varies.
    """
    spread = ((actual - actual.mean(dim=0)) ** 2).sum()
    return float(1 - ((actual - predicted) ** 2).sum() / spread) if spread > 0 else 0.0
