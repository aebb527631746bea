"""Evaluation of policies in the environment of trained ones."""

import numpy as np
import pytest

from asp_env import ReplayEnv
from policies.evaluation import evaluate_policy
from policies.held_actions import RandomActions, zero_actions
from policies.settings import EnvironmentSettings

DATA = "sample:roundabout"


def test_values_are_those_of_single_environments() -> None:
    """The first, the 36th and the last of 72 scenarios."""
    settings = EnvironmentSettings()
    driven = evaluate_policy(zero_actions, settings, DATA, max_scenarios=3)
    env = ReplayEnv(
        DATA,
        observations=("state",),
        action_type="route",
        action_repeat=settings.action_repeat,
        reward_weights=settings.reward_weights,
    )
    assert len(env.scenarios) == 72
    for number, scenario in enumerate((0, 36, 71)):
        env.reset(options={"scenario": scenario})
        total, comfort, over, info = 0.0, [], False, {}
        while not over:
            _, reward, terminated, truncated, info = env.step(np.zeros(2))
            total += reward
            comfort.append(info["reward_terms"]["comfort"])
            over = terminated or truncated
        assert driven.scenarios[number].name == info["scenario"]
        expected = {
            "success": float(info["is_success"]),
            "at-fault collision": float(info["ending"] == "COLLISION"),
            "off-road": float(info["ending"] == "OFF_ROAD"),
            "progress": min(info["progress"], 1.0),
            "comfort": np.mean(comfort),
            "reward": total,
        }
        for name, value in expected.items():
            assert driven.values[name][number] == pytest.approx(value, abs=1e-5)


def test_random_actions_are_reproducible() -> None:
    settings = EnvironmentSettings()
    first, again, other = (
        evaluate_policy(RandomActions(seed), settings, DATA, max_scenarios=8).values["reward"]
        for seed in (1, 1, 2)
    )
    np.testing.assert_array_equal(first, again)
    assert (first != other).any()
