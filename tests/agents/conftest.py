"""A trained agent that all tests share."""

from pathlib import Path

import pytest

pytest.importorskip("stable_baselines3")

from agents.settings import AgentSettings, EnvironmentSettings
from agents.training import train_agent

SMALL = {"n_steps": 16, "batch_size": 64, "n_epochs": 2}


def small_settings(**changes: object) -> AgentSettings:
    """A training of a few seconds at most."""
    environment = EnvironmentSettings(
        predictor="constant-velocity", forecast={"modes": 1}, neighbours=4
    )
    given = {"environment": environment, "steps": 128, "num_envs": 4, "width": 16}
    return AgentSettings(hyperparameters=SMALL, **{**given, **changes})  # pyright: ignore[reportArgumentType]


@pytest.fixture(scope="session")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The run folder of a small agent that observes constant velocity."""
    folder = tmp_path_factory.mktemp("agent") / "run"
    train_agent(small_settings(), folder)
    return folder
