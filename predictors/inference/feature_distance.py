"""How far a scene lies outside what a network learned: the Mahalanobis distance of its features.

The distance of features z to those of validation data, with their mean μ and covariance Σ, is
`sqrt((z - μ)ᵀ Σ⁻¹ (z - μ))` (Lee et al., "A Simple Unified Framework for Detecting
Out-of-Distribution Samples and Adversarial Attacks", NeurIPS 2018, with a single class). Directions
in which features hardly vary would dominate it, so the covariance is shrunk towards a multiple of
the identity with the same trace: `(1 - λ) Σ + λ tr(Σ) / Z I` (Ledoit and Wolf, "A well-conditioned
estimator for large-dimensional covariance matrices", 2004), with λ = `SHRINKAGE`.

The threshold is the 99 % quantile of the distances of validation features that the mean and the
covariance were not fitted on: each half of the recordings is measured by the statistics of the
other half. The stored mean and covariance are those of all of them.

A run stores the arrays in `features.safetensors`. The matrix W with Wᵀ W = Σ⁻¹ is triangular and
has 11 significant bits, so that it takes a quarter of its bytes in a compressed package.
"""

import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from asp_env.errors import CheckpointError
from asp_env.files import atomic_file

FEATURES = "features.safetensors"
"""File of the statistics within the folder of a run."""

SHRINKAGE = 0.01
"""λ. Chosen by hand: the features of the pretrained networks have 99 % of their variance in 20 of
256 directions; a smaller share measures rounding in the others, a larger one hides them."""

QUANTILE = 0.99
"""Share of the validation features whose distance is below the threshold."""

STORED_BITS = 11
"""Significant bits of the whitening matrix in a file: those of half precision, whose range is too
small for it."""

MIN_VARIANCE = 1e-12
"""Lowest mean variance of a feature, for features that do not vary."""

MIN_TARGETS = 20
"""Lowest number of targets that statistics are fitted on. Chosen by hand: with fewer, the 99 %
quantile is the largest distance of a handful of vehicles."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FeatureDistance:
    """Distance of features to those of validation data, in units of the threshold."""

    mean: Float[np.ndarray, " z"]
    """μ."""
    whitening: Float[np.ndarray, "z z"]
    """W with Wᵀ W = Σ⁻¹, of the shrunk covariance; upper triangular."""
    threshold: float
    """99 % quantile of the Mahalanobis distances of validation features, positive."""

    def score(self, features: Float[np.ndarray, "n z"]) -> Float[np.ndarray, " n"]:
        """Mahalanobis distances over the threshold: above 1 lie 1 % of the validation features.

        A row does not depend on the others, bit for bit.

        Args:
            features: features z of N targets.
        """
        centred = features.astype(np.float64) - self.mean
        projected = np.einsum("nz,kz->nk", centred, self.whitening)
        return np.sqrt(np.einsum("nk,nk->n", projected, projected)) / self.threshold

    def save(self, folder: Path) -> None:
        """Writes the arrays into the folder of a run, atomically."""
        from safetensors.numpy import save

        threshold = np.array([self.threshold])
        arrays = {
            # safetensors writes the memory of an array, whatever its order.
            name: np.ascontiguousarray(array, dtype=np.float32)
            for name, array in (
                ("mean", self.mean),
                ("whitening", round_significant(self.whitening, bits=STORED_BITS)),
                ("threshold", threshold),
            )
        }
        arrays["checksum"] = _checksum(arrays)
        path = folder / FEATURES
        with atomic_file(path) as partial:
            partial.write_bytes(save(arrays))

    @classmethod
    def load(cls, folder: Path, *, name: str, features: int) -> "FeatureDistance":
        """Reads the arrays of a run.

        Args:
            folder: the folder of the run.
            name: NAME:RUN, for messages.
            features: number of features of the network.

        Raises:
            CheckpointError: the file is missing, damaged, or of another network.
        """
        from safetensors import SafetensorError
        from safetensors.numpy import load_file

        path = folder / FEATURES
        remedy = f"python -m predictors.inference.fit_features {name} VALIDATION_DATA"
        if not path.exists():
            raise CheckpointError(
                f"{name} has no statistics of its features ({path} is missing), which the fallback "
                f"to constant velocity needs: add them by {remedy}"
            )
        try:
            arrays = load_file(path)
            if "checksum" in arrays and arrays["checksum"] != _checksum(arrays):  # not in old files
                raise ValueError("its checksum differs")
            found = cls(
                mean=arrays["mean"].astype(np.float64),
                whitening=arrays["whitening"].astype(np.float64),
                threshold=float(arrays["threshold"][0]),
            )
            fits = found.mean.shape == (features,) and found.whitening.shape == (features, features)
            finite = np.isfinite(found.mean).all() and np.isfinite(found.whitening).all()
            if not (fits and finite and np.isfinite(found.threshold) and found.threshold > 0):
                raise ValueError("its arrays do not fit the network")
        except (OSError, KeyError, IndexError, TypeError, ValueError, SafetensorError) as error:
            raise CheckpointError(
                f"{path} is damaged or of another network: replace it by {remedy}"
            ) from error
        return found


def fit_feature_distance(
    features: Float[np.ndarray, "n z"], recording: Int[np.ndarray, " n"]
) -> FeatureDistance | None:
    """Fits mean, covariance and threshold on the features of validation data.

    Args:
        features: features z of N targets, in the order of time within each recording.
        recording: recording of each target. The recordings are divided into halves by their order;
            a single one is divided at the middle of its targets.

    Returns:
        The statistics; None for fewer than `MIN_TARGETS` targets.
    """
    if len(features) < MIN_TARGETS:
        return None
    z = features.astype(np.float64)
    names, number = np.unique(recording, return_inverse=True)
    in_first = number % 2 == 0 if len(names) > 1 else np.arange(len(z)) < len(z) // 2
    distances = np.zeros(len(z))
    for measured in (in_first, ~in_first):
        half = FeatureDistance(**_moments(z[~measured]), threshold=1.0)
        distances[measured] = half.score(z[measured])
    threshold = max(float(np.quantile(distances, QUANTILE)), 1e-6)
    return FeatureDistance(**_moments(z), threshold=threshold)


def _checksum(arrays: Mapping[str, np.ndarray]) -> np.ndarray:
    """The CRC-32 of the statistics, as a file holds them."""
    content = b"".join(arrays[name].tobytes() for name in ("mean", "whitening", "threshold"))
    return np.array([zlib.crc32(content)], dtype=np.uint32)


def _moments(z: Float[np.ndarray, "n z"]) -> dict[str, np.ndarray]:
    """Mean and whitening matrix of the shrunk covariance."""
    mean = z.mean(axis=0)
    covariance = (z - mean).T @ (z - mean) / len(z)
    variance = max(float(np.trace(covariance)) / len(covariance), MIN_VARIANCE)
    shrunk = (1 - SHRINKAGE) * covariance + SHRINKAGE * variance * np.eye(len(covariance))
    values, vectors = np.linalg.eigh(shrunk)
    # A rotation of W changes no distance; this one makes half of it zero.
    return {"mean": mean, "whitening": np.linalg.qr((vectors / np.sqrt(values)).T).R}


def round_significant(
    values: Float[np.ndarray, "*shape"], *, bits: int
) -> Float[np.ndarray, "*shape"]:
    """Rounds to a number of significant bits; the zeros after them take no space if compressed."""
    fractions, exponents = np.frexp(values)
    return np.ldexp(np.round(np.ldexp(fractions, bits)), exponents - bits)
