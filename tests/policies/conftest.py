"""A trained policy that all tests share."""

from pathlib import Path

import pytest

pytest.importorskip("stable_baselines3")

from policies.settings import EnvironmentSettings, PolicySettings
from policies.training import train_policy

SMALL = {"n_steps": 16, "batch_size": 64, "n_epochs": 2}


def small_settings(**changes: object) -> PolicySettings:
    """A training of a few seconds at most."""
    environment = EnvironmentSettings(
        predictor="constant-velocity", forecast={"modes": 1}, neighbours=4
    )
    given = {"environment": environment, "steps": 128, "num_envs": 4, "width": 16}
    return PolicySettings(hyperparameters=SMALL, **{**given, **changes})  # pyright: ignore[reportArgumentType]


@pytest.fixture(scope="session")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The run folder of a small policy that observes constant velocity."""
    folder = tmp_path_factory.mktemp("policy") / "run"
    train_policy(small_settings(), folder)
    return folder
