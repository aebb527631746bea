"""What a predictor says of its targets.

MERGED: The socket for predictors, and how one is named: `name` or `name:RUN_DIR`.
"""

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float, Int

from asp_env import registry
from asp_env.data.scene import Scene
from asp_env.data.snippets import Future
from asp_env.data.split import TrainedOn
from asp_env.dynamics import rollout


@dataclass(frozen=True, slots=True, kw_only=True)
class Forecast:
    """M modes of T ticks for each of N targets; step 0 is one tick ahead of the scene."""

    states: Float[np.ndarray, "t m steps 4"]
    """[x m, y m, heading rad, speed m/s] in the recording's frame."""
    actions: Float[np.ndarray, "t m steps 2"]
    actions_valid: Bool[np.ndarray, " t"]
    """False for a predictor that forecasts no actions."""
    log_probs: Float[np.ndarray, "t m"]
    """Natural logarithms of the modes' probabilities, which sum to one."""
    ids: Int[np.ndarray, " t"]
    targets: Int[np.ndarray, "t 2"]
    """(situation, slot) in the scene."""
    tick: Int[np.ndarray, " t"]
    """The scene's tick, so that a late forecast can be matched."""
    valid: Bool[np.ndarray, " t"]
    """False for agents that this predictor does not forecast; their rows are zeros."""
    dt_s: float

    @property
    def probabilities(self) -> Float[np.ndarray, "t m"]:
        """The modes' probabilities."""
        return np.exp(self.log_probs)

    @property
    def most_probable(self) -> Int[np.ndarray, " t"]:
        """The index of each target's most probable mode; the first one of equals."""
        return self.log_probs.argmax(axis=-1)


def make_forecast(
    scene: Scene,
    *,
    states: Float[np.ndarray, "t m steps 4"],
    actions: Float[np.ndarray, "t m steps 2"] | None,
    log_probs: Float[np.ndarray, "t m"],
    valid: Bool[np.ndarray, " t"],
) -> Forecast:
    """A forecast of the scene's targets, zeroed where not valid."""
    at = (scene.targets[:, 0], scene.targets[:, 1])
    keep = valid[:, None, None, None]
    has_actions = actions is not None
    if actions is None:
        actions = np.zeros((*states.shape[:-1], 2), dtype=states.dtype)
    return Forecast(
        states=np.where(keep, states, 0).astype(np.float32),
        actions=np.where(keep, actions, 0).astype(np.float32),
        actions_valid=valid & has_actions,
        log_probs=log_probs.astype(np.float32),
        ids=scene.ids[at],
        targets=scene.targets,
        tick=scene.tick[scene.targets[:, 0]],
        valid=valid,
        dt_s=scene.dt_s,
    )


def constant_velocity(scene: Scene, *, steps: int) -> Float[np.ndarray, "t steps 4"]:
    """Each target goes on straight at its present speed: zero actions through the bicycle."""
    at = (scene.targets[:, 0], scene.targets[:, 1])
    now = scene.states[at][:, -1]
    actions = np.zeros((len(now), steps, 2), dtype=now.dtype)
    lengths = np.maximum(scene.sizes[at][:, 0], 0.1)
    return rollout(now, actions, lengths, scene.dt_s, reverse=True)


def fill_missing(forecast: Forecast, scene: Scene) -> Forecast:
    """The forecast with constant velocity, in every mode alike, for targets that it leaves out.

    For planners and drivers, which need a word on everybody who is there now.
    """
    at = (scene.targets[:, 0], scene.targets[:, 1])
    fill = ~forecast.valid & scene.valid[at][:, -1]
    if not fill.any():
        return forecast
    straight = constant_velocity(scene, steps=forecast.states.shape[2])[:, None]
    states = np.where(fill[:, None, None, None], straight, forecast.states)
    alike = np.float32(-np.log(forecast.log_probs.shape[1]))
    return dataclasses.replace(
        forecast,
        states=states.astype(np.float32),
        log_probs=np.where(fill[:, None], alike, forecast.log_probs),
        valid=forecast.valid | fill,
    )


@runtime_checkable
class Predictor(Protocol):
    """Anything that forecasts the targets of a scene."""

    @property
    def name(self) -> str:
        """What tables call it."""
        ...

    @property
    def privileged(self) -> bool:
        """Whether it is handed the recorded future; tables name such a predictor as an oracle."""
        ...

    @property
    def dt_s(self) -> float:
        """The time step of the scenes that it takes and of its forecasts."""
        ...

    @property
    def history(self) -> int:
        """Past ticks that it needs to see of a target."""
        ...

    @property
    def horizon(self) -> int:
        """Ticks that it forecasts."""
        ...

    @property
    def trained_on(self) -> TrainedOn | None:
        """What it learned from; None for one that learns nothing."""
        ...

    @property
    def metadata(self) -> Mapping[str, str]:
        """For tables and manifests: `trained_on`, `view`, `preset`, `weights`, as they apply."""
        ...

    def predict(self, scene: Scene, future: Future | None = None) -> Forecast:
        """Forecasts the scene's targets; only privileged predictors get a future."""
        ...


@runtime_checkable
class PredictorPlug(Protocol):
    """What the registry holds under a predictor's name."""

    def from_name(self, argument: str, *, horizon: int, dt_s: float) -> Predictor:
        """The predictor for what stands behind the colon of its name, possibly nothing.

        Raises:
            AspEnvError: the argument is missing, superfluous, or cannot be loaded.
        """
        ...


def load_predictor(name: str, *, horizon: int, dt_s: float) -> Predictor:
    """The predictor of a name such as `constant-velocity` or `ffw-asp:runs/1`.

    Args:
        name: the registered name, and behind a colon its folder if it is a trained one.
        horizon: ticks to forecast, for predictors that can forecast any number; a trained one
            keeps its own.
        dt_s: the time step of the scenes to come.

    Raises:
        AspEnvError: the name is unknown, or the predictor cannot be made for it.
    """
    kind, _, argument = name.partition(":")
    plug: PredictorPlug = registry.find("predictors", kind)
    return plug.from_name(argument, horizon=horizon, dt_s=dt_s)
