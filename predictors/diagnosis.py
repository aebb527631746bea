"""Whether features are alive: spread, effective rank, and how well they are foreseen."""

from typing import final

import torch
from jaxtyping import Float
from torch import Tensor

from predictors.network import Features

STILL = 1e-12
"""Below this share of their mean square, a variance of float32 features is rounding."""


@final
class Diagnosis:
    """Gathers features over a validation set, as sums: it takes no more room for more of them."""

    def __init__(self) -> None:
        """Empty."""
        self._count = 0
        self._total = torch.zeros(())
        self._products = torch.zeros(())
        self._missed = torch.zeros(())

    def add(self, features: Features | None) -> None:
        """Takes in a batch's features, if the network has any to show."""
        if features is not None:
            encoded, predicted = (each.detach().cpu().double() for each in features)
            self._count += len(encoded)
            self._total = self._total + encoded.sum(dim=0)
            self._products = self._products + encoded.T @ encoded
            self._missed = self._missed + ((encoded - predicted) ** 2).sum()

    def join(self, other: "Diagnosis") -> None:
        """Takes in what another one did, of batches that another process saw."""
        self._count += other._count
        self._total = self._total + other._total
        self._products = self._products + other._products
        self._missed = self._missed + other._missed

    def finish(self) -> dict[str, float]:
        """The numbers by name, of all that was added; nothing where nothing was.

        - Standard deviation: of each coordinate, mean over them.
        - Effective rank: see `effective_rank`, of the centred features' singular values.
        - R²: 1 less the squared errors' share of the variance, over all coordinates together. 1 is
          a perfect prediction, 0 no better than the mean; 0 where nothing varies.
        """
        if not self._count:
            return {}
        mean = self._total / self._count
        scatter = self._products - self._count * torch.outer(mean, mean)
        spread, missed = float(scatter.trace()), float(self._missed)
        if spread <= STILL * float(self._products.trace()):
            scatter, spread = torch.zeros_like(scatter), 0.0
        values = torch.linalg.eigvalsh(scatter).clamp(min=0).sqrt()
        deviation = (scatter.diagonal().clamp(min=0) / self._count).sqrt().mean()
        self._count = 0
        self._total = self._products = self._missed = torch.zeros(())
        return {
            "feature standard deviation": float(deviation),
            "feature effective rank": effective_rank(values),
            "feature R2": 1 - missed / spread if spread > 0 else 0.0,
        }


def effective_rank(values: Float[Tensor, " z"]) -> float:
    """The exponential of the entropy of singular values (Roy & Vetterli 2007).

    1 where all but one are 0, their number where all are alike; 0 where all are 0.
    """
    total = values.sum()
    if total <= 0:
        return 0.0
    share = values / total
    share = share[share > 0]
    return float(torch.exp(-(share * share.log()).sum()))
