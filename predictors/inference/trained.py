"""A trained network behind the predictor socket."""

import math
from collections.abc import Mapping
from types import MappingProxyType
from typing import NamedTuple, final

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from asp_env.data.predictor import Forecast, make_forecast
from asp_env.data.scene import Scene
from asp_env.data.snippets import Future
from asp_env.data.split import TrainedOn
from asp_env.errors import AspEnvError
from asp_env.geometry import from_frame, wrap_angle
from asp_env.views import RasterView, SceneView
from predictors.models.batch import Batch, Labels, make_batch, make_labels
from predictors.models.chaining import Chaining
from predictors.models.network import AbstractNetwork, Modes
from predictors.models.ssp_asp import SSPASPNetwork
from predictors.physical import seen_for

TARGETS_AT_ONCE = 256
"""More are drawn and forecast in turn: on CPUs it is no slower, and the memory is bounded."""

PIXELS_AT_ONCE = 64 * 360 * 240
"""Of pictures: 64 at full size, for which ResNet18 takes some 1.2 GiB."""


class _Said(NamedTuple):
    """A forecast of some targets, in the recording's frame."""

    states: np.ndarray
    actions: np.ndarray | None
    log_probs: np.ndarray


@final
class TrainedPredictor:
    """Forecasts with a network that is not trained any more."""

    def __init__(
        self,
        *,
        name: str,
        network: AbstractNetwork,
        view: SceneView,
        trained_on: TrainedOn,
        about: Mapping[str, str],
        temperature: float = 1.0,
        chaining: Chaining = "beam",
    ) -> None:
        """The network sees what `view` draws; `about` is what tables tell of its training.

        Args:
            name: what tables call it.
            network: trained.
            view: what it was trained on.
            trained_on: which recordings it has seen.
            about: what tables tell of it.
            temperature: what logits are divided by, fitted on validation.
            chaining: of segments, for a network that chains any; `oracle` is privileged.
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
        self._about = MappingProxyType(dict(about))
        self._temperature = temperature
        self._at_once = TARGETS_AT_ONCE
        if isinstance(view, RasterView):
            pixels = math.prod(view.shape[1:])
            self._at_once = min(TARGETS_AT_ONCE, max(1, PIXELS_AT_ONCE // pixels))

    @property
    def metadata(self) -> Mapping[str, str]:
        """Source of the training data, view, preset, and a hash of the weights."""
        return self._about

    def predict(self, scene: Scene, future: Future | None = None) -> Forecast:
        """Forecasts the targets of predicted classes seen for the whole history.

        Reads no future, unless its chaining is `oracle`.

        Raises:
            AspEnvError: the scene has another time step, or a shorter history; or chaining by
                oracle gets no future.
        """
        scene.check_dt(self.dt_s, self.name)
        valid = seen_for(scene, self.history)
        known = np.flatnonzero(valid)
        label = self._label(scene, future, known) if self.privileged else None
        with torch.inference_mode():
            parts = [
                self._predict(scene.with_targets(scene.targets[known[rows]]), label, rows)
                for first in range(0, max(len(known), 1), self._at_once)
                for rows in [slice(first, first + self._at_once)]
            ]
        log_probs = _scattered([part.log_probs for part in parts], valid)
        log_probs[~valid] = -np.log(log_probs.shape[1])
        with_actions = parts[0].actions is not None
        return make_forecast(
            scene,
            states=_scattered([part.states for part in parts], valid),
            actions=_scattered([p.actions for p in parts if p.actions is not None], valid)
            if with_actions
            else None,
            log_probs=log_probs,
            valid=valid,
        )

    def _label(self, scene: Scene, future: Future | None, known: np.ndarray) -> Labels:
        if future is None or future.states.shape[1] < self.horizon:
            raise AspEnvError(
                f"{self.name} chained by oracle needs the recorded future of {self.horizon} ticks"
            )
        some = Future(
            states=future.states[known, : self.horizon], valid=future.valid[known, : self.horizon]
        )
        return make_labels(scene.with_targets(scene.targets[known]), some)

    def modes(self, batch: Batch, truth: Float[Tensor, "n t 2"] | None = None) -> Modes:
        """What the network says of targets, in their own frames, as log-probabilities.

        Args:
            batch: of targets.
            truth: their positions to come, which chaining by oracle alone reads.
        """
        if isinstance(self.network, SSPASPNetwork):
            modes = self.network.chain(batch, self.chaining, truth)
        else:
            modes: Modes = self.network(batch)
        return modes._replace(logits=(modes.logits / self._temperature).log_softmax(dim=-1))

    def _predict(self, scene: Scene, label: Labels | None, rows: slice) -> _Said:
        batch = make_batch(scene, self.view, self.history)
        modes = self.modes(batch, None if label is None else label.states[rows, :, :2])
        now = scene.target_states.astype(np.float64)[:, None, None]
        local = modes.states.numpy()
        xy = from_frame(local[..., :2].astype(np.float64), now)
        heading = wrap_angle(local[..., 2:3] + now[..., 2:3])
        states = np.concatenate([xy, heading, local[..., 3:]], axis=-1).astype(np.float32)
        return _Said(
            states=states,
            actions=None if modes.actions is None else modes.actions.numpy(),
            log_probs=modes.logits.numpy(),
        )


def _scattered(parts: list[np.ndarray], valid: np.ndarray) -> np.ndarray:
    """Rows of the valid targets at their places among all, zeros elsewhere."""
    rows = np.concatenate(parts)
    out = np.zeros((len(valid), *rows.shape[1:]), dtype=np.float32)
    out[valid] = rows
    return out
