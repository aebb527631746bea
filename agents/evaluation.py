"""Evaluation of agents in their environments, on scenarios that they were not trained on."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from agents.environments import AgentObservations, make_environments
from agents.observations import Observations
from agents.runs import Agent
from agents.settings import EnvironmentSettings
from asp_env.data.scenarios.scenario import Scenario, ScenarioSet
from asp_env.evaluation.statistics import Estimate, mean

NUM_ENVS = 64

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
    envs = make_environments(settings, data, NUM_ENVS, scenarios=scenarios, privileged=privileged)
    chosen: ScenarioSet = envs.get_attr("scenarios", 0)[0]
    if max_scenarios is not None:
        chosen = chosen.evenly_spaced(max_scenarios)
    every: Sequence[Scenario] = list(chosen)
    values = {name: np.zeros(len(every)) for name in METRICS}
    for start in range(0, len(every), NUM_ENVS):
        for number, ended in _drive(envs, every[start : start + NUM_ENVS], policy, start):
            for name, value in ended.items():
                values[name][start + number] = value
        if progress is not None:
            progress(min(start + NUM_ENVS, len(every)), len(every))
    envs.close()
    return DrivenScenarios(scenarios=chosen, values=values)


def evaluate_agent(agent: Agent, data: str, **options: Any) -> DrivenScenarios:
    """Drives every scenario once with a trained agent; see `evaluate_policy`."""
    return evaluate_policy(agent.act, agent.settings.environment, data, **options)


def _drive(
    envs: AgentObservations, scenarios: Sequence[Scenario], policy: Policy, seed: int
) -> list[tuple[int, dict[str, float]]]:
    """Drives at most `NUM_ENVS` scenarios side by side; spare environments repeat them."""
    count = len(scenarios)
    names = [scenarios[b % count].name for b in range(NUM_ENVS)]
    envs.set_options([{"scenario": name} for name in names])
    envs.seed(seed)
    observations = envs.reset()
    starts, running = np.ones(NUM_ENVS, dtype=bool), np.arange(NUM_ENVS) < count
    reward, comfort, steps = np.zeros((3, NUM_ENVS))
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
