"""A guard: where a scene lies outside what a network learned, constant velocity takes over.

The score of a target is the Mahalanobis distance of its features z to those of the run's validation
data, over the 99 % quantile of the latter (`predictors.inference.feature_distance`). Up to a score
of 1 the forecast is the network's, bit for bit. From there the share of constant velocity rises
smoothly, and reaches 1 at a score of `FULL_AT`.

In action space constant velocity is the zero action, so a mode is blended by scaling its actions by
1 - share and rolling them out from the present state: every mode stays drivable and within the
limits of actions, the number of modes and their probabilities do not change, and a plan does not
jump where a target passes the threshold. (A further mode of constant velocity that gains
probability would leave the other modes in front of a planner that avoids all of them.) Networks
that predict positions have no actions; their states are blended linearly, headings through the
smaller angle.
"""

import dataclasses
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from asp_env import registry
from asp_env.data.predictor import (
    FeaturePredictor,
    Forecast,
    GuardablePlug,
    Predictor,
    constant_velocity,
)
from asp_env.data.scene import Scene
from asp_env.data.snippets import Future
from asp_env.dynamics import rollout
from asp_env.dynamics.bicycle import Integrator
from asp_env.errors import AspEnvError
from asp_env.geometry import wrap_angle
from predictors.inference.feature_distance import FeatureDistance
from predictors.wrapping import Wrapping

FULL_AT = 1.5
"""Score from which a forecast is constant velocity alone. Chosen by hand: a smaller one makes
forecasts jump between consecutive ticks, a larger one leaves forecasts unguarded that are far from
all validation data."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Guarded(Wrapping):
    """The forecast of a trained predictor, blended to constant velocity far from its training."""

    inner: FeaturePredictor
    """The trained predictor."""
    distance: FeatureDistance
    """Scores its features."""
    integrator: Integrator
    """Integrator of its bicycle model."""

    @property
    def name(self) -> str:
        """`guarded:` and the name of the trained predictor."""
        return f"guarded:{self.inner.name}"

    @property
    def horizon(self) -> int:
        """Ticks that the trained predictor forecasts."""
        return self.inner.horizon

    @classmethod
    def from_name(cls, argument: str, *, horizon: int, dt_s: float) -> Predictor:
        """Loads the trained predictor and the statistics of its features.

        Args:
            argument: NAME:RUN, the trained predictor.
            horizon: number of ticks to forecast; a trained predictor has a horizon of its own.
            dt_s: seconds per tick.

        Raises:
            AspEnvError: The argument names no trained predictor, or its run has no statistics.
        """
        kind, _, run = argument.partition(":")
        plug = registry.find("predictors", kind) if kind else None
        if not isinstance(plug, GuardablePlug):
            given = f"guarded:{argument}" if argument else "guarded"
            raise AspEnvError(
                f"predictor {given}: expected guarded:NAME:RUN with a trained predictor, such as "
                "guarded:ssp-asp:pretrained; others wrap it, as in "
                "delayed:2:guarded:ssp-asp:pretrained"
            )
        return plug.load_guarded(run, horizon=horizon, dt_s=dt_s)

    def predict(self, scene: Scene, future: Future | None = None) -> Forecast:
        """Forecasts the targets; `fallback` of the forecast is the share of constant velocity.

        Args:
            scene: the present scene.
            future: the recorded future of the targets, if privileged.

        Raises:
            AspEnvError: The trained predictor refuses the scene.
        """
        forecast = self.inner.predict(scene, future)
        share = np.zeros(len(forecast.valid), dtype=np.float32)
        rows = np.flatnonzero(forecast.valid)
        if len(rows):
            assert forecast.features is not None
            encoded = forecast.features[rows, : len(self.distance.mean)]  # ẑ may follow z
            score = self.distance.score(encoded)
            share[rows] = fallback_share(score)
        guarded = blended(forecast, scene, share, self.integrator)
        stated = np.where(forecast.valid, share, np.float32(np.nan))
        return dataclasses.replace(guarded, fallback=stated)


def fallback_share(score: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    """Share of constant velocity: 0 up to a score of 1, 1 from `FULL_AT`, a cubic between them."""
    x = np.clip((score - 1) / (FULL_AT - 1), 0, 1)
    return (x * x * (3 - 2 * x)).astype(np.float32)


def blended(
    forecast: Forecast, scene: Scene, share: Float[np.ndarray, " t"], integrator: Integrator
) -> Forecast:
    """Blends the modes of each target to constant velocity; rows with share 0 keep their bits.

    Args:
        forecast: the forecast.
        scene: its scene.
        share: share of constant velocity of each target, within [0, 1].
        integrator: integrator that the states follow from the actions by.
    """
    rows = np.flatnonzero(share > 0)
    states, actions = forecast.states.copy(), forecast.actions.copy()
    if len(rows):
        targets = scene.with_targets(scene.targets[rows])
        straight = constant_velocity(targets, steps=states.shape[2])[:, None]
        weight = share[rows, None, None, None]
        if forecast.actions_valid[rows].all():
            actions[rows] = (1 - weight) * actions[rows]
            states[rows] = _rolled_out(targets, actions[rows], integrator)
        else:
            towards = straight - states[rows]
            towards[..., 2] = wrap_angle(towards[..., 2])
            states[rows] = states[rows] + weight * towards
            states[rows, ..., 2] = wrap_angle(states[rows, ..., 2])
        full = rows[share[rows] >= 1]
        states[full] = straight[share[rows] >= 1]
    return dataclasses.replace(forecast, states=states, actions=actions)


def _rolled_out(
    scene: Scene, actions: Float[np.ndarray, "t m steps 2"], integrator: Integrator
) -> Float[np.ndarray, "t m steps 4"]:
    """States that actions lead to; only vehicles that reverse now may reverse later."""
    at = (scene.targets[:, 0], scene.targets[:, 1])
    now = np.repeat(scene.target_states[:, None], actions.shape[1], axis=1)
    lengths_m = scene.sizes[at][:, :1]
    forward, backward = (
        rollout(now, actions, lengths_m, scene.dt_s, integrator=integrator, reverse=reverse)
        for reverse in (False, True)
    )
    return np.where(now[:, :, None, 3:] < 0, backward, forward).astype(np.float32)
