"""Latency: the forecast that a predictor made some ticks ago."""

import dataclasses
from dataclasses import dataclass

import numpy as np

from asp_env.data.predictor import (
    Forecast,
    continued,
    load_predictor,
    make_forecast,
)
from asp_env.data.scene import Scene
from asp_env.data.snippets import Future
from asp_env.errors import AspEnvError
from predictors.wrapping import Wrapping


@dataclass(frozen=True, slots=True, kw_only=True)
class Delayed(Wrapping):
    """The forecast that another predictor made D ticks ago, less its first D ticks.

    A target that was absent then has no forecast. Modes, probabilities, training data and features,
    which are those of then, are those of the other predictor, which forecasts D ticks more. If its
    horizon is fixed, its modes continue straight at their last speed. If it is privileged, it is
    given the future as of D ticks ago, so that `delayed:TICKS:oracle` forecasts the same states as
    `oracle`.
    """

    ticks: int
    """D."""
    horizon: int
    """Number of ticks of a forecast, counted from now."""

    @property
    def name(self) -> str:
        """`delayed:TICKS:` and the name of the other predictor."""
        return f"delayed:{self.ticks}:{self.inner.name}"

    @property
    def history(self) -> int:
        """Past ticks that the other predictor needed, D ticks ago."""
        return self.inner.history + self.ticks

    @classmethod
    def from_name(cls, argument: str, *, horizon: int, dt_s: float) -> "Delayed":
        """Loads the other predictor.

        Args:
            argument: TICKS:NAME[:RUN], the delay in ticks and the other predictor.
            horizon: number of ticks to forecast.
            dt_s: seconds per tick.

        Raises:
            AspEnvError: The argument is not of this form, or the other predictor cannot be loaded.
        """
        delay, _, name = argument.partition(":")
        if not (delay.isascii() and delay.isdigit() and int(delay) > 0 and name):
            given = f"delayed:{argument}" if argument else "delayed"
            raise AspEnvError(
                f"predictor {given}: expected delayed:TICKS:NAME[:RUN] with at least 1 tick and "
                "the name of a predictor, such as delayed:2:constant-velocity"
            )
        inner = load_predictor(name, horizon=horizon + int(delay), dt_s=dt_s)
        return cls(inner=inner, ticks=int(delay), horizon=min(horizon, inner.horizon))

    def predict(self, scene: Scene, future: Future | None = None) -> Forecast:
        """Forecasts the targets that the other predictor forecast D ticks ago.

        Args:
            scene: the present scene.
            future: the recorded future of the targets from now on, if privileged.

        Raises:
            AspEnvError: The scene has too short a history, or the other predictor refuses it.
        """
        if scene.history < self.history:
            raise AspEnvError(
                f"{self.name} needs {self.history} past ticks, the scene has {scene.history}: "
                "make the scene with a longer history"
            )
        at = (scene.targets[:, 0], scene.targets[:, 1])
        since_then = scene.valid[at][:, -self.ticks - 1 :]
        if self.privileged and future is not None:
            past = scene.states[at][:, -self.ticks :]
            future = Future(
                states=np.concatenate([past, future.states], axis=1),
                valid=np.concatenate([since_then[:, 1:], future.valid], axis=1),
            )
        then = self.inner.predict(_scene_before(scene, self.ticks), future)
        first, end = self.ticks, self.ticks + self.horizon
        states = continued(then.states, end, scene.dt_s)
        actions = np.zeros((*states.shape[:-1], 2), dtype=np.float32)
        known = min(end, then.actions.shape[2])
        actions[:, :, :known] = then.actions[:, :, :known]
        forecast = make_forecast(
            scene,
            states=states[:, :, first:end],
            actions=actions[:, :, first:end] if then.actions_valid.any() else None,
            log_probs=then.log_probs,
            valid=then.valid & since_then.all(axis=1),
            features=then.features,
        )
        return dataclasses.replace(forecast, fallback=then.fallback)


def _scene_before(scene: Scene, ticks: int) -> Scene:
    """The scene as it was some ticks ago, with the same targets and a history that much shorter."""
    valid = scene.valid[..., :-ticks]
    seen = np.asarray(valid.any(axis=-1))
    return dataclasses.replace(
        scene,
        states=scene.states[:, :, :-ticks],
        actions=scene.actions[:, :, :-ticks],
        valid=valid,
        sizes=np.where(seen[..., None], scene.sizes, 0).astype(scene.sizes.dtype),
        classes=np.where(seen, scene.classes, 0).astype(scene.classes.dtype),
        ids=np.where(seen, scene.ids, -1),
        tick=scene.tick - ticks,
        signals=None if scene.signals is None else scene.signals.before(ticks),
    )
