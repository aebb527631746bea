"""A trained network as a predictor."""

import math
from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import final

import numpy as np
from jaxtyping import Bool, Float
from torch import Tensor

from asp_env.data.predictor import Forecast, make_forecast
from asp_env.data.scene import Scene
from asp_env.data.snippets import Future
from asp_env.data.split import TrainedOn
from asp_env.errors import AspEnvError, CheckpointError
from asp_env.views import RasterView, SceneView
from predictors.models.batch import Batch, make_batch, make_labels
from predictors.models.chaining import Chaining
from predictors.models.network import AbstractNetwork, Modes
from predictors.physical import predictable_targets

MAX_CHUNK_TARGETS = 256
"""Targets that are forecast at once. Chosen by hand: on CPUs larger chunks are no faster, and the
memory is bounded."""

MAX_CHUNK_PIXELS = 64 * 360 * 240
"""Pixels of rasters that are read at once: 64 rasters of full size, for which ResNet18 takes
about 1.2 GiB."""


@final
class TrainedPredictor:
    """Forecasts with a trained network."""

    def __init__(
        self,
        *,
        name: str,
        network: AbstractNetwork,
        view: SceneView,
        trained_on: TrainedOn,
        metadata: Mapping[str, str],
        temperature: float = 1.0,
        chaining: Chaining = "beam",
    ) -> None:
        """Sets the network to evaluation.

        Args:
            name: Name of the predictor in tables.
            network: The trained network.
            view: The view that it was trained on.
            trained_on: The recordings that it was trained on.
            metadata: Source of the training data, view, recipe and hash of the weights.
            temperature: Divisor of the logits, fitted on validation data.
            chaining: How segments are chained, for a network that chains any; with `oracle` the
                predictor is privileged.
        """
        self.name = name
        self.view = view
        self.dt_s = network.shape.dt_s
        self.history = network.shape.history
        self.horizon = network.shape.horizon
        self.privileged = chaining == "oracle"
        self.trained_on: TrainedOn | None = trained_on
        self.chaining: Chaining = chaining
        self.network = network.eval()
        self._metadata = MappingProxyType(dict(metadata))
        self._temperature = temperature
        self._chunk = MAX_CHUNK_TARGETS
        if isinstance(view, RasterView):
            pixels = math.prod(view.shape[1:])
            self._chunk = min(MAX_CHUNK_TARGETS, max(1, MAX_CHUNK_PIXELS // pixels))

    @property
    def feature_size(self) -> int:
        """Number of features of each target in its forecasts."""
        return self.network.feature_size

    @property
    def metadata(self) -> Mapping[str, str]:
        """Source of the training data, view, recipe, and a hash of the weights."""
        return self._metadata

    def predict(self, scene: Scene, future: Future | None = None) -> Forecast:
        """Forecasts the targets of predicted classes that are valid for the whole history.

        Args:
            scene: The scene.
            future: The recorded future, read by the chaining `oracle` only.

        Raises:
            AspEnvError: The scene has another time step or a shorter history, or the chaining
                `oracle` gets no future.
            CheckpointError: A forecast is not finite, because weights are damaged.
        """
        scene.check_dt(self.dt_s, self.name)
        valid = predictable_targets(scene, self.history)
        rows = np.flatnonzero(valid)
        label = self._label(scene, future, rows) if self.privileged else None
        chunks = [
            self._forecast(scene.with_targets(scene.targets[rows[part]]), label, part)
            for first in range(0, max(len(rows), 1), self._chunk)
            for part in [slice(first, first + self._chunk)]
        ]
        log_probs = _scatter([chunk.log_probs for chunk in chunks], valid)
        states = _scatter([chunk.states for chunk in chunks], valid)
        if not (np.isfinite(states).all() and np.isfinite(log_probs).all()):
            raise CheckpointError(
                f"{self.name}: a forecast is not finite, so its weights "
                f"({self._metadata.get('weights', 'of an unknown run')}) are damaged: train again"
            )
        log_probs[~valid] = -np.log(log_probs.shape[1])
        actions = features = None
        if chunks[0].actions_valid.all():
            actions = _scatter([chunk.actions for chunk in chunks], valid)
        encoded = [chunk.features for chunk in chunks if chunk.features is not None]
        if encoded:
            features = _scatter(encoded, valid)
        return make_forecast(
            scene,
            states=states,
            actions=actions,
            log_probs=log_probs,
            valid=valid,
            features=features,
        )

    def modes(self, batch: Batch) -> Modes:
        """Returns the calibrated modes in the targets' frames, log-probabilities for logits."""
        return self.network.calibrated(batch, temperature=self._temperature, chaining=self.chaining)

    def _label(
        self, scene: Scene, future: Future | None, rows: np.ndarray
    ) -> Float[Tensor, "n t 2"]:
        """Recorded positions of some targets in their own frames."""
        if future is None or future.states.shape[1] < self.horizon:
            raise AspEnvError(
                f"{self.name} chained by oracle needs the recorded future of {self.horizon} ticks"
            )
        chosen = Future(
            states=future.states[rows, : self.horizon], valid=future.valid[rows, : self.horizon]
        )
        return make_labels(scene.with_targets(scene.targets[rows]), chosen).states[..., :2]

    def _forecast(
        self, scene: Scene, label: Float[Tensor, "n t 2"] | None, part: slice
    ) -> Forecast:
        return self.network.forecast(
            scene,
            make_batch(scene, self.view, self.history),
            temperature=self._temperature,
            chaining=self.chaining,
            label=None if label is None else label[part],
        )


def _scatter(parts: Sequence[np.ndarray], valid: Bool[np.ndarray, " t"]) -> np.ndarray:
    """Rows of the valid targets at their indices among all targets; zeros elsewhere."""
    rows = np.concatenate(parts)
    out = np.zeros((len(valid), *rows.shape[1:]), dtype=np.float32)
    out[valid] = rows
    return out
