"""How fast PPO collects rollouts: `python -m tests.benchmarks.rollout_rate`.

64 environments show vectors and forecasts at constant velocity. For one and for three ticks per
action the table has the ticks per second of CPU time of the environments alone, those of the
collection of rollouts (environments, policy and buffer, without the updates of the network), and
the share of the training that the collection takes.
"""

import time
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from rich.console import Console
from rich.table import Table
from stable_baselines3.common.vec_env import VecMonitor, VecNormalize

from policies.environments import make_environments
from policies.settings import EnvironmentSettings, PolicySettings
from policies.training import make_algorithm

DATA = "sample:roundabout"
STEPS = 16_384


class _Clock:
    """CPU time of a function over all calls."""

    def __init__(self, function: Callable[..., Any]) -> None:
        self._function, self.seconds = function, 0.0

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        """Calls the function."""
        begin = time.process_time()
        result = self._function(*args, **kwargs)
        self.seconds += time.process_time() - begin
        return result


def measure(action_repeat: int) -> tuple[float, float, float]:
    """Ticks per second of the environments and of the collection, and its share of the training.

    Args:
        action_repeat: ticks per action.
    """
    settings = PolicySettings(
        data=DATA,
        environment=EnvironmentSettings(
            predictor="constant-velocity", forecast={"modes": 1}, action_repeat=action_repeat
        ),
        steps=STEPS,
    )
    envs = make_environments(settings.environment, DATA, settings.num_envs, scenarios="")
    normalized = VecNormalize(VecMonitor(envs), norm_obs=False)
    model: Any = make_algorithm(settings, normalized)
    model.learn(2 * settings.num_envs * model.n_steps)
    envs.step_wait = alone = _Clock(envs.step_wait)
    model.collect_rollouts = collect = _Clock(model.collect_rollouts)
    model.train = update = _Clock(model.train)
    before = model.num_timesteps
    model.learn(STEPS, reset_num_timesteps=False)
    ticks = (model.num_timesteps - before) * action_repeat
    share = collect.seconds / (collect.seconds + update.seconds)
    return ticks / alone.seconds, ticks / collect.seconds, share


def main() -> None:
    """Prints the table."""
    torch.set_num_threads(1)
    table = Table("ticks per action", "environments, ticks/s", "collection, ticks/s", "share")
    for action_repeat in (1, 3):
        rates = np.array([measure(action_repeat) for _ in range(3)])
        alone, collected, share = np.median(rates, axis=0)
        table.add_row(str(action_repeat), f"{alone:,.0f}", f"{collected:,.0f}", f"{share:.0%}")
    Console().print(table)


if __name__ == "__main__":
    main()
