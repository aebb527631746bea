"""The steps of the logged drivers in the environment of a policy, for behaviour cloning."""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from asp_env.data.scenarios.scenario import ScenarioSet
from policies.environments import make_environments
from policies.observations import Observations
from policies.settings import PolicySettings


class LoggedSteps(NamedTuple):
    """N steps of the logged drivers."""

    observations: Observations
    """(N, …) arrays by entry."""
    actions: Float[np.ndarray, "n 2"]
    """The action at the start of each step, in [-1, 1]."""
    recording: Int[np.ndarray, " n"]


def logged_steps(settings: PolicySettings, *, privileged: bool = False) -> LoggedSteps:
    """Drives all scenarios of the training with the actions of the logged drivers.

    Args:
        settings: the settings of the policy.
        privileged: allows forecasts of a predictor that uses the recorded future.

    Raises:
        AspEnvError: a setting is invalid, or the world has no logged drivers.
    """
    envs = make_environments(
        settings.environment,
        settings.data,
        settings.num_envs,
        scenarios=settings.environment.scenarios,
        privileged=privileged,
    )
    scenarios: ScenarioSet = envs.get_attr("scenarios", 0)[0]
    replay: Any = envs.get_attr("unwrapped", 0)[0]
    observed: list[Observations] = []
    actions, recordings = [], []
    for start in range(0, len(scenarios), settings.num_envs):
        rows = np.arange(start, min(start + settings.num_envs, len(scenarios)))
        names = [scenarios[int(row)].name for row in rows]
        envs.set_options([{"scenario": names[b % len(names)]} for b in range(settings.num_envs)])
        envs.seed(start)
        seen: Any = envs.reset()
        running = np.arange(settings.num_envs) < len(rows)
        while running.any():
            taken = replay.logged_actions()
            observed.append({name: value[running].copy() for name, value in seen.items()})
            actions.append(taken[running])
            recordings.append(scenarios.recording[rows[np.flatnonzero(running)]])
            seen, _, over, _ = envs.step(taken)
            running &= ~over
    envs.close()
    return LoggedSteps(
        observations={
            name: np.concatenate([each[name] for each in observed]) for name in observed[0]
        },
        actions=np.concatenate(actions),
        recording=np.concatenate(recordings),
    )
