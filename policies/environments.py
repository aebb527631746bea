"""Vector environments for training and evaluating policies with stable-baselines3."""

from typing import Any

import numpy as np
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper
from stable_baselines3.common.vec_env.base_vec_env import VecEnvStepReturn

from asp_env.data.scenarios.scenario import ScenarioSet
from asp_env.envs.constructors import sb3_vec_env
from policies.observations import Observations, components, reduce_observations, reduced_space
from policies.settings import EnvironmentSettings


class PolicyObservations(VecEnvWrapper):
    """Reduces the observations of a vector environment to those of a policy."""

    def __init__(self, envs: VecEnv, settings: EnvironmentSettings) -> None:
        """Wraps a vector environment.

        Args:
            envs: environments of asp_env with the components that the policy needs.
            settings: what the policy observes.
        """
        super().__init__(envs, reduced_space(envs.observation_space, settings))
        self._settings = settings

    def reset(self) -> Observations:
        """Starts all episodes."""
        observations: Any = self.venv.reset()
        return reduce_observations(observations, self._settings)

    def step_wait(self) -> VecEnvStepReturn:
        """Steps all episodes; the last observations of finished ones are reduced as well."""
        observations, rewards, over, infos = self.venv.step_wait()
        assert isinstance(observations, dict)
        rows = np.flatnonzero(over).tolist()
        if rows:
            last = [infos[b]["terminal_observation"] for b in rows]
            stacked = {name: np.stack([each[name] for each in last]) for name in last[0]}
            reduced = reduce_observations(stacked, self._settings)
            for i, b in enumerate(rows):
                infos[b]["terminal_observation"] = {k: value[i] for k, value in reduced.items()}
        return reduce_observations(observations, self._settings), rewards, over, infos


def make_environments(
    settings: EnvironmentSettings,
    data: str,
    num_envs: int,
    *,
    scenarios: ScenarioSet | str,
    privileged: bool = False,
) -> PolicyObservations:
    """Makes the vector environment of a policy.

    Args:
        settings: what the policy observes and does.
        data: a folder with recordings, or `scheme:argument`.
        num_envs: number of environments.
        scenarios: the scenarios to draw from, or a filter.
        privileged: allows forecasts of a predictor that uses the recorded future.

    Raises:
        AspEnvError: a setting is invalid, or no scenario fits.
    """
    forecast = None
    if settings.predictor is not None:
        forecast = {**settings.forecast, **({"privileged": True} if privileged else {})}
    raster: dict[str, Any] = {}
    if settings.view is not None:
        raster = {"view": settings.view, "raster_px": settings.raster_px}
    envs = sb3_vec_env(
        num_envs,
        data,
        observations=components(settings),
        traffic=settings.traffic,
        dt_s=settings.dt_s,
        action_type=settings.action_type,
        action_repeat=settings.action_repeat,
        reward_weights=dict(settings.reward_weights),
        scenarios=scenarios,
        predictor=settings.predictor,
        forecast=forecast,
        **raster,
    )
    return PolicyObservations(envs, settings)
