"""Observation wrappers: forecasts as part of the observation, and flat tables."""

import dataclasses
from collections.abc import Sequence
from typing import Any, Literal

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.utils import RecordConstructorArgs
from gymnasium.vector import AutoresetMode, VectorEnv, VectorObservationWrapper
from gymnasium.vector.utils import batch_space

from asp_env.envs.episodes import ReplayEpisodes
from asp_env.envs.flat import flat_space
from asp_env.envs.forecasts import (
    FORECAST_TIMES_S,
    ForecastObserver,
    ForecastOptions,
    NamedPredictor,
    extended_space,
)
from asp_env.envs.shared_in_spec import shared_predictors
from asp_env.errors import AspEnvError


class FlatParts(
    gymnasium.ObservationWrapper[dict[str, Any], Any, dict[str, Any]], RecordConstructorArgs
):
    """Flattens the tables of a Dict observation to vectors; images and vectors stay unchanged.

    stable-baselines3's `check_env` warns of tables such as the action history, (15, 2), which
    becomes (30,), tick by tick. Agents, lines, their masks and the route are flattened as well.
    The option `flatten="parts"` of the environments does the same without a wrapper.
    """

    def __init__(self, env: gymnasium.Env[dict[str, Any], Any]) -> None:
        """Wraps an environment.

        Args:
            env: an environment whose observation space is a Dict of boxes.

        Raises:
            AspEnvError: the observation space is no Dict.
        """
        RecordConstructorArgs.__init__(self)
        super().__init__(env)
        self.observation_space = flat_space(env.observation_space, "parts")

    def observation(self, observation: dict[str, Any]) -> dict[str, Any]:
        """Returns the observation in the shapes of this wrapper's space."""
        space = self.observation_space
        assert isinstance(space, spaces.Dict)
        return {name: value.reshape(space[name].shape) for name, value in observation.items()}


class PredictionFeatures(
    gymnasium.ObservationWrapper[dict[str, Any], Any, dict[str, Any]], RecordConstructorArgs
):
    """Adds a predictor's forecasts of the nearest agents to the observation.

    `gymnasium.make(…, predictor=…, forecast=…)` does the same without a wrapper, and its snapshots
    include the forecasts. Wrappers with different prefixes show several predictors. The entries
    are those of `asp_env.envs.forecasts.ForecastObserver`:

    | entry | space | content |
    |---|---|---|
    | `forecast` | `Box(±100, (agents · modes · times · 2,))` | positions in m, x ahead and y to \
the left in the present frame of the ego |
    | `forecast_probabilities` | `Box(0, 1, (agents · modes,))` | probabilities of the modes, in \
descending order |
    | `forecast_valid` | `Box(0, 1, (agents,))` | 1 where there is an agent |
    | `forecast_features` | `Box(±100, (agents · features,))` | with `features`: what the \
predictor's network encodes of each agent, `Forecast.features` |
    | `forecast_age` | `Box(0, max, (agents,))` | with a period above 1 tick or a latency: seconds \
since the scene of the forecast |
    """

    def __init__(
        self,
        env: gymnasium.Env[dict[str, Any], Any],
        predictor: NamedPredictor,
        *,
        agents: int = 8,
        modes: int = 3,
        at_s: Sequence[float] = FORECAST_TIMES_S,
        privileged: bool = False,
        features: bool | Literal["latent"] = False,
        every_ticks: int = 1,
        latency_ticks: int = 0,
        prefix: str = "",
    ) -> None:
        """Wraps an environment.

        Args:
            env: an environment of this package, possibly in wrappers, with a Dict observation.
            predictor: a predictor or its name, such as `constant-velocity`, `ffw-asp:pretrained` or
                `ssp-asp:RUN_DIR`.
            agents: number of nearest agents.
            modes: number of most probable modes.
            at_s: times ahead of the positions in seconds, whole ticks.
            privileged: allows a predictor that uses the recorded future.
            features: adds the features of the predictor's network, which must be a trained one;
                `latent` shows them without positions and probabilities.
            every_ticks: period of the forecasts in ticks; in between the last one is moved along.
            latency_ticks: ticks from the scene of a forecast until it is shown.
            prefix: text before the names of the entries.

        Raises:
            AspEnvError: the environment, the predictor or an argument is invalid.
            TypeError: `env` is no environment.
        """
        options = ForecastOptions(
            agents=agents,
            modes=modes,
            at_s=at_s,
            privileged=privileged,
            features=features,
            every_ticks=every_ticks,
            latency_ticks=latency_ticks,
            prefix=prefix,
        )
        fields = {each.name: getattr(options, each.name) for each in dataclasses.fields(options)}
        RecordConstructorArgs.__init__(self, predictor=shared_predictors(predictor), **fields)
        super().__init__(env)
        self._forecasts = ForecastObserver(predictor, options, _episodes_of(env.unwrapped).dt_s)
        self.observation_space = extended_space(env.observation_space, self._forecasts.spaces)

    def observation(self, observation: dict[str, Any]) -> dict[str, Any]:
        """Returns the observation with the present forecasts."""
        forecasts = self._forecasts.observe(_episodes_of(self.env.unwrapped), np.zeros(1, np.int64))
        return observation | {name: value[0] for name, value in forecasts.items()}


class VectorPredictionFeatures(VectorObservationWrapper):
    """`PredictionFeatures` for a vector environment, with one predictor call for all episodes.

    `gymnasium.make_vec(…, predictor=…, forecast=…)` does the same in any autoreset mode.
    """

    def __init__(
        self,
        env: VectorEnv,
        predictor: NamedPredictor,
        *,
        agents: int = 8,
        modes: int = 3,
        at_s: Sequence[float] = FORECAST_TIMES_S,
        privileged: bool = False,
        features: bool | Literal["latent"] = False,
        every_ticks: int = 1,
        latency_ticks: int = 0,
        prefix: str = "",
    ) -> None:
        """Wraps a `ReplayVectorEnv`, possibly in wrappers.

        Args:
            env: the vector environment, in the autoreset mode `NextStep` or `Disabled`.
            predictor: see `PredictionFeatures`, as for the following arguments.
            agents: number of nearest agents.
            modes: number of most probable modes.
            at_s: times ahead of the positions in seconds, whole ticks.
            privileged: allows a predictor that uses the recorded future.
            features: adds the features of the predictor's network, or shows them alone (`latent`).
            every_ticks: period of the forecasts in ticks.
            latency_ticks: ticks from the scene of a forecast until it is shown.
            prefix: text before the names of the entries.

        Raises:
            AspEnvError: the environment, the predictor or an argument is invalid.
            TypeError: `env` is no environment.
        """
        metadata = env.metadata if isinstance(env, VectorEnv) else {}
        if metadata.get("autoreset_mode") is AutoresetMode.SAME_STEP:
            raise AspEnvError(
                "VectorPredictionFeatures: autoreset_mode 'SameStep' needs the forecasts of ended "
                "episodes; make the environment itself with predictor=…, or with 'NextStep'"
            )
        super().__init__(env)
        options = ForecastOptions(
            agents=agents,
            modes=modes,
            at_s=at_s,
            privileged=privileged,
            features=features,
            every_ticks=every_ticks,
            latency_ticks=latency_ticks,
            prefix=prefix,
        )
        self._forecasts = ForecastObserver(predictor, options, _episodes_of(env.unwrapped).dt_s)
        self.single_observation_space = extended_space(
            env.single_observation_space, self._forecasts.spaces
        )
        self.observation_space = batch_space(self.single_observation_space, env.num_envs)

    def observations(self, observations: dict[str, Any]) -> dict[str, Any]:
        """Returns the observations with the present forecasts."""
        rows = np.arange(self.num_envs)
        return observations | self._forecasts.observe(_episodes_of(self.env.unwrapped), rows)


def _episodes_of(env: Any) -> ReplayEpisodes:
    episodes = getattr(env, "episodes", None)
    if not isinstance(episodes, ReplayEpisodes):
        raise AspEnvError(
            f"{type(env).__name__} has no scenes to forecast: expected an environment of asp_env"
        )
    return episodes
