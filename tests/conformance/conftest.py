"""Fixtures for the suite of predictors."""

from pathlib import Path

import pytest

from asp_env.data.predictor import Predictor, load_predictor
from tests.conformance.predictor_cases import Case


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of runs with random weights."""
    return tmp_path_factory.mktemp("runs")


@pytest.fixture
def predictor(request: pytest.FixtureRequest, folder: Path) -> Predictor:
    """The predictor of a case."""
    case: Case = request.param
    return load_predictor(case.save(folder), horizon=case.horizon, dt_s=0.2)
