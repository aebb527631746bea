"""Constructors of the environments that need packages of the extra `rl`, imported when called."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from asp_env.data.recording import DEFAULT_DT_S
from asp_env.data.scenarios.scenario import ScenarioFilter, ScenarioSet
from asp_env.envs.flat import Flatten
from asp_env.envs.forecasts import ForecastSpec, PredictorSpec
from asp_env.envs.options import suggest_options
from asp_env.envs.vector import ReplayVectorEnv
from asp_env.errors import MissingExtraError
from asp_env.sim.traffic.assignment import TrafficSpec

if TYPE_CHECKING:
    from asp_env.envs.parallel import ParallelReplayEnv
    from asp_env.envs.sb3 import ReplayVecEnv


@suggest_options
def parallel_env(
    data: str = "sample:intersection",
    *,
    classes: Sequence[str] | None = None,
    ids: Sequence[int] | None = None,
    max_agents: int | None = None,
    pad_absent: bool = False,
    flatten: Flatten = False,
    numeric_infos: bool = False,
    render_mode: str | None = None,
    observations: Sequence[str] = ("raster", "actions", "state"),
    view: str = "chauffeurnet",
    raster_px: int | Sequence[int] | None = None,
    traffic: TrafficSpec | None = None,
    dt_s: float = DEFAULT_DT_S,
    action_type: str = "direct",
    action_repeat: int = 1,
    reward_weights: Mapping[str, float] | None = None,
    scenarios: ScenarioSet | ScenarioFilter | str = "",
    predictor: PredictorSpec | None = None,
    forecast: ForecastSpec | None = None,
) -> "ParallelReplayEnv":
    """Makes a PettingZoo parallel environment that controls many vehicles of a recording.

    Args:
        data: a folder with recordings, or `scheme:argument`.
        classes: names of the classes of vehicles that are agents, such as `car`; by default all.
        ids: track ids of the vehicles that are agents; by default all.
        max_agents: the largest number of agents; those nearest to `vehicle_0` are taken.
        pad_absent: absent agents stay in `agents` for the whole episode, with zeros as observation
            and reward, and the mask `present`.
        flatten: `True`: the observation of an agent is one vector; `"parts"`: each entry is one.
        numeric_infos: infos are numbers only, with the same keys after `reset` and `step`.
        render_mode: `rgb_array` or None.
        observations: see `ReplayEnv`, as for the following arguments.
        view: the view that draws the `raster`.
        raster_px: height and width of the `raster` in pixels, or one number for both.
        traffic: the driver of the uncontrolled agents, or a table of drivers.
        dt_s: length of a tick in seconds.
        action_type: what actions mean: `direct`, `jerk` or `route`.
        action_repeat: number of ticks for which each action is held.
        reward_weights: weights of reward terms that differ from the defaults.
        scenarios: the scenarios to draw from, or a filter.
        predictor: the predictor whose forecasts the observation shows, or several.
        forecast: `ForecastOptions` or a mapping of its fields, such as `every_ticks` and
            `latency_ticks`, in ticks.

    Raises:
        AspEnvError: an argument is invalid, or no scenario fits.
        MissingExtraError: PettingZoo is not installed.
    """
    try:
        from asp_env.envs.parallel import ParallelReplayEnv
    except ModuleNotFoundError as error:
        raise MissingExtraError(str(error.name), "rl", "asp_env.parallel_env") from error
    return ParallelReplayEnv(
        data,
        classes=classes,
        ids=ids,
        max_agents=max_agents,
        pad_absent=pad_absent,
        flatten=flatten,
        numeric_infos=numeric_infos,
        render_mode=render_mode,
        observations=observations,
        view=view,
        raster_px=raster_px,
        traffic=traffic,
        dt_s=dt_s,
        action_type=action_type,
        action_repeat=action_repeat,
        reward_weights=reward_weights,
        scenarios=scenarios,
        predictor=predictor,
        forecast=forecast,
    )


@suggest_options
def sb3_vec_env(
    num_envs: int,
    data: str = "sample:intersection",
    *,
    max_episode_steps: int | None = None,
    flatten: Flatten = False,
    render_mode: str | None = None,
    observations: Sequence[str] = ("raster", "actions", "state"),
    view: str = "chauffeurnet",
    raster_px: int | Sequence[int] | None = None,
    traffic: TrafficSpec | None = None,
    dt_s: float = DEFAULT_DT_S,
    action_type: str = "direct",
    action_repeat: int = 1,
    reward_weights: Mapping[str, float] | None = None,
    scenarios: ScenarioSet | ScenarioFilter | str = "",
    predictor: PredictorSpec | None = None,
    forecast: ForecastSpec | None = None,
) -> "ReplayVecEnv":
    """Makes a vector environment for stable-baselines3, batched like `ReplayVectorEnv`.

    Args:
        num_envs: number of environments.
        data: a folder with recordings, or `scheme:argument`.
        max_episode_steps: number of steps after which episodes are truncated.
        flatten: `True`: the observation is one vector; `"parts"`: each entry is a vector.
        render_mode: `rgb_array` or None.
        observations: see `ReplayEnv`, as for the following arguments.
        view: the view that draws the `raster`.
        raster_px: height and width of the `raster` in pixels, or one number for both.
        traffic: the driver of the uncontrolled agents, or a table of drivers.
        dt_s: length of a tick in seconds.
        action_type: what actions mean: `direct`, `jerk` or `route`.
        action_repeat: number of ticks for which each action is held.
        reward_weights: weights of reward terms that differ from the defaults.
        scenarios: the scenarios to draw from, or a filter.
        predictor: the predictor whose forecasts the observation shows, or several.
        forecast: `ForecastOptions` or a mapping of its fields, such as `every_ticks` and
            `latency_ticks`, in ticks.

    Raises:
        AspEnvError: an argument is invalid, or the data hold no scenario.
        MissingExtraError: stable-baselines3 is not installed.
    """
    try:
        from asp_env.envs.sb3 import ReplayVecEnv
    except ModuleNotFoundError as error:
        raise MissingExtraError(str(error.name), "rl", "asp_env.sb3_vec_env") from error
    envs = ReplayVectorEnv(
        num_envs,
        data,
        autoreset_mode="SameStep",
        max_episode_steps=max_episode_steps,
        flatten=flatten,
        render_mode=render_mode,
        observations=observations,
        view=view,
        raster_px=raster_px,
        traffic=traffic,
        dt_s=dt_s,
        action_type=action_type,
        action_repeat=action_repeat,
        reward_weights=reward_weights,
        scenarios=scenarios,
        predictor=predictor,
        forecast=forecast,
    )
    return ReplayVecEnv(envs)
