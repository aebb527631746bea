"""A predictor's encoder in a policy that observes rasters."""

from pathlib import Path

import numpy as np
import pytest
import torch

from asp_env.data.predictor import load_predictor
from asp_env.errors import AspEnvError
from policies.encoders import trained_encoder
from policies.runs import load_policy
from policies.settings import EnvironmentSettings
from policies.training import train_policy
from tests.policies.conftest import small_settings
from tests.predictors.tiny import save_random


@pytest.fixture(scope="module")
def predictor(tmp_path_factory: pytest.TempPathFactory) -> str:
    """A predictor with random weights that reads rasters."""
    folder = tmp_path_factory.mktemp("predictor") / "run"
    save_random(folder, "dkm", "chauffeurnet", horizon=15, seed=0, preset="cpu")
    return f"dkm:{folder}"


def observed(predictor: str) -> EnvironmentSettings:
    """An environment with the rasters of the predictor."""
    view = load_predictor(predictor, horizon=15, dt_s=0.2).view  # pyright: ignore[reportAttributeAccessIssue]
    return EnvironmentSettings(view=view.name, raster_px=view.shape[1:])


def test_features_are_those_of_the_predictor(predictor: str) -> None:
    """The predictor reads bytes, or bits; the policy reads numbers from 0 to 1."""
    encoder = trained_encoder(predictor, observed(predictor))
    network = load_predictor(predictor, horizon=15, dt_s=0.2).network  # pyright: ignore[reportAttributeAccessIssue]
    shape = (2, *network.shape.observation)
    rasters = np.random.default_rng(0).integers(0, 2, shape, dtype=np.uint8) * 255
    packed = np.packbits(rasters > 0, axis=-1) if network.shape.packed else rasters
    with torch.no_grad():
        own = network.encoder(torch.as_tensor(packed))
        reused = encoder(torch.as_tensor(rasters).float() / 255)
    torch.testing.assert_close(reused, own)


def test_a_policy_is_trained_and_loaded(predictor: str, tmp_path: Path) -> None:
    settings = small_settings(environment=observed(predictor), encoder=predictor, steps=64, width=8)
    train_policy(settings, tmp_path / "run")
    load_policy(tmp_path / "run")


def test_other_rasters_and_predictors_are_refused(predictor: str) -> None:
    with pytest.raises(AspEnvError, match="raster-px"):
        trained_encoder(predictor, EnvironmentSettings(view="chauffeurnet", raster_px=(8, 8)))
    with pytest.raises(AspEnvError, match="no encoder of rasters"):
        trained_encoder("constant-velocity", EnvironmentSettings(view="chauffeurnet"))
