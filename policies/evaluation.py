"""Evaluation of policies in their environments, on scenarios that they were not trained on."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from asp_env.data.recording import ticks
from asp_env.data.scenarios.scenario import Scenario, ScenarioSet
from asp_env.data.scenarios.selection import choose_scenarios
from asp_env.data.snippets import HISTORY_S
from asp_env.data.source import open_readable
from asp_env.evaluation.statistics import Estimate, mean
from policies.environments import PolicyObservations, make_environments
from policies.observations import Observations
from policies.runs import TrainedPolicy
from policies.settings import EnvironmentSettings

MAX_ENVS = 64

METRICS = ("success", "at-fault collision", "off-road", "progress", "comfort", "reward")
"""`success`: the goal is reached, thus without an at-fault collision and on the road;
`comfort`: mean of the reward's term over the steps; the others as in the infos."""

Policy = Callable[[Observations, np.ndarray], np.ndarray]
"""Actions (B, 2) from reduced observations and the mask (B,) of episodes that begin."""


@dataclass(frozen=True, slots=True, kw_only=True)
class DrivenScenarios:
    """What became of N scenarios."""

    scenarios: ScenarioSet
    values: dict[str, Float[np.ndarray, " n"]]
    """Values by `METRICS`."""

    def estimates(self) -> dict[str, Estimate]:
        """Means with 95 % intervals over recordings."""
        groups = self.scenarios.recording
        return {name: mean(value, groups) for name, value in self.values.items()}


def evaluate_policy(
    policy: Policy,
    settings: EnvironmentSettings,
    data: str,
    *,
    scenarios: ScenarioSet | str = "",
    max_scenarios: int | None = None,
    privileged: bool = False,
    progress: Callable[[int, int], None] | None = None,
) -> DrivenScenarios:
    """Drives every scenario once.

    Args:
        policy: the policy.
        settings: the environment.
        data: a folder with recordings, or `scheme:argument`.
        scenarios: the scenarios, or a filter.
        max_scenarios: largest number of scenarios, chosen at even spacing.
        privileged: allows forecasts of a predictor that uses the recorded future.
        progress: called with the numbers of finished scenarios and of all.

    Raises:
        AspEnvError: a setting is invalid, or no scenario fits.
    """
    chosen = scenarios
    if isinstance(chosen, str):
        history = ticks(HISTORY_S, settings.dt_s)
        recordings = open_readable(data, dt_s=settings.dt_s)
        chosen = choose_scenarios(recordings, chosen, dt_s=settings.dt_s, history=history)
    if max_scenarios is not None:
        chosen = chosen.evenly_spaced(max_scenarios)
    every: Sequence[Scenario] = list(chosen)
    num_envs = min(MAX_ENVS, len(every))
    envs = make_environments(settings, data, num_envs, scenarios=chosen, privileged=privileged)
    values = {name: np.zeros(len(every)) for name in METRICS}
    for start in range(0, len(every), num_envs):
        for number, ended in _drive(envs, every[start : start + num_envs], policy, start):
            for name, value in ended.items():
                values[name][start + number] = value
        if progress is not None:
            progress(min(start + num_envs, len(every)), len(every))
    envs.close()
    return DrivenScenarios(scenarios=chosen, values=values)


def evaluate_trained(trained: TrainedPolicy, data: str, **options: Any) -> DrivenScenarios:
    """Drives every scenario once with a trained policy; see `evaluate_policy`."""
    return evaluate_policy(trained.act, trained.settings.environment, data, **options)


def _drive(
    envs: PolicyObservations, scenarios: Sequence[Scenario], policy: Policy, seed: int
) -> list[tuple[int, dict[str, float]]]:
    """Drives at most as many scenarios as environments; spare environments repeat them."""
    count, num_envs = len(scenarios), envs.num_envs
    names = [scenarios[b % count].name for b in range(num_envs)]
    envs.set_options([{"scenario": name} for name in names])
    envs.seed(seed)
    observations = envs.reset()
    starts, running = np.ones(num_envs, dtype=bool), np.arange(num_envs) < count
    reward, comfort, steps = np.zeros((3, num_envs))
    results = []
    while running.any():
        actions = policy(observations, starts)
        observations, step_reward, over, infos = envs.step(actions)
        assert isinstance(observations, dict)
        reward += step_reward * running
        comfort += running * np.array([info["reward_terms"]["comfort"] for info in infos])
        steps += running
        for b in np.flatnonzero(over & running).tolist():
            info = infos[b]
            ended = {
                "success": float(info["ending"] == "GOAL"),
                "at-fault collision": float(info["ending"] == "COLLISION"),
                "off-road": float(info["ending"] == "OFF_ROAD"),
                "progress": min(float(info["progress"]), 1.0),
                "comfort": comfort[b] / steps[b],
                "reward": reward[b],
            }
            results.append((b, ended))
        running &= ~over
        starts = over
    return results
