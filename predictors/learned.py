"""A trained network behind the predictor socket."""

import dataclasses
from abc import ABC, abstractmethod
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, NamedTuple, Protocol, final, runtime_checkable

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn

from asp_env.data.forecast import Forecast, make_forecast
from asp_env.data.geometry import from_frame
from asp_env.data.parts import TrainedOn
from asp_env.data.scene import Scene
from asp_env.data.snippets import Future
from asp_env.dynamics import wrap_angle
from asp_env.views import PictureView
from predictors.batch import Batch, Labels, make_batch
from predictors.physical import seen_for

CHUNK = 256
"""Targets that are drawn and forecast at once, which bounds the memory that is used."""


class Modes(NamedTuple):
    """What a network says of N targets, in their own frames."""

    actions: Float[Tensor, "n m t 2"]
    states: Float[Tensor, "n m t 4"]
    logits: Float[Tensor, "n m"]


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class NetworkShape:
    """What a network is made for, besides its own configuration."""

    raster: tuple[int, int, int]
    """Channels, height, width."""
    history: int
    """Past ticks."""
    horizon: int
    """Ticks ahead."""
    dt_s: float
    action_range: tuple[float, float]
    """What outputs in [-1, 1] are multiplied by: m/s², rad. The normaliser."""


class AbstractNetwork(nn.Module, ABC):
    """A network that can be trained and put behind the socket; made of (config, shape)."""

    @abstractmethod
    def forward(self, batch: Batch) -> Modes:
        """The modes of every target."""

    @abstractmethod
    def loss(self, modes: Modes, labels: Labels) -> dict[str, Tensor]:
        """The terms of the loss by name, `loss` their weighted sum."""


@runtime_checkable
class LearnedPlug(Protocol):
    """What the registry holds under a learned predictor's name, for training and loading."""

    @property
    def name(self) -> str:
        """By which it is registered."""
        ...

    @property
    def config(self) -> type[Any]:
        """A frozen dataclass of what JSON can hold."""
        ...

    @property
    def network(self) -> type[AbstractNetwork]:
        """Made of (config, shape)."""
        ...


@final
class Learned:
    """Forecasts with a network that is not trained any more."""

    privileged = False

    def __init__(
        self,
        *,
        name: str,
        network: AbstractNetwork,
        view: PictureView,
        shape: NetworkShape,
        trained_on: TrainedOn,
        about: Mapping[str, str],
    ) -> None:
        """The network sees what `view` draws; `about` is what tables tell of its training."""
        self.name = name
        self.view = view
        self.dt_s = shape.dt_s
        self.history = shape.history
        self.horizon = shape.horizon
        self.trained_on: TrainedOn | None = trained_on
        self._about = MappingProxyType(dict(about))
        self._network = network.eval()

    @property
    def about(self) -> Mapping[str, str]:
        """Source of the training data, view, preset, and a hash of the weights."""
        return self._about

    def predict(self, scene: Scene, future: Future | None = None) -> Forecast:
        """Forecasts the targets of predicted classes seen for the whole history; reads no future.

        Raises:
            AspEnvError: the scene has another time step, or a shorter history.
        """
        del future
        scene.check_dt(self.dt_s, self.name)
        valid = seen_for(scene, self.history)
        known = np.flatnonzero(valid)
        with torch.inference_mode():
            parts = [
                self._predict(scene.with_targets(scene.targets[known[first : first + CHUNK]]))
                for first in range(0, max(len(known), 1), CHUNK)
            ]
        actions, states, log_probs = (np.concatenate([part[i] for part in parts]) for i in range(3))
        modes = log_probs.shape[1]
        all_states = np.zeros((len(valid), *states.shape[1:]), dtype=np.float32)
        all_actions = np.zeros((len(valid), *actions.shape[1:]), dtype=np.float32)
        all_log_probs = np.full((len(valid), modes), -np.log(modes), dtype=np.float32)
        all_states[known], all_actions[known], all_log_probs[known] = states, actions, log_probs
        return make_forecast(
            scene, states=all_states, actions=all_actions, log_probs=all_log_probs, valid=valid
        )

    def _predict(self, scene: Scene) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        modes: Modes = self._network(make_batch(scene, self.view, self.history))
        now = scene.target_states.astype(np.float64)[:, None, None]
        local = modes.states.numpy()
        xy = from_frame(local[..., :2].astype(np.float64), now)
        heading = wrap_angle(local[..., 2:3] + now[..., 2:3])
        states = np.concatenate([xy, heading, local[..., 3:]], axis=-1).astype(np.float32)
        return modes.actions.numpy(), states, modes.logits.log_softmax(dim=-1).numpy()
