"""Features of forecasts: what the networks encode. `test_export` has those of exported files."""

from typing import Any

import numpy as np
import pytest
import torch

from asp_env.data.predictor import feature_size, load_predictor
from asp_env.data.scene import Scene
from asp_env.data.snippets import gather_scene, index_snippets
from predictors.delayed import _scene_before
from predictors.inference.trained import TrainedPredictor
from predictors.models.batch import make_batch
from predictors.models.network import TrainingProgress
from predictors.models.ssp_asp import SSPASPNetwork
from predictors.training.recipes import RECIPES
from tests.builders import make_recording
from tests.predictors.tiny import SIZES, draw_samples, save_random

SIZE = SIZES["features"]
CASES = [
    *((name, 15, "cpu") for name in RECIPES),
    ("ssp-asp", 30, "cpu"),
    ("ssp-asp", 30, "ours"),
]


def scene() -> Scene:
    """Twelve situations of the synthetic crossing."""
    recording = [make_recording()]
    index = index_snippets(recording, dt_s=0.2, horizon_s=3.0)
    return gather_scene(recording, index.select(np.linspace(0, len(index) - 1, 12).astype(int)))


@pytest.fixture(scope="module", params=CASES, ids=["-".join(map(str, case)) for case in CASES])
def run(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> str:
    """A predictor with random weights by name."""
    name, horizon, preset = request.param
    folder = tmp_path_factory.mktemp("features") / "run"
    return f"{name}:{save_random(folder, name, 'vectors', horizon=horizon, preset=preset)}"


def load(run: str) -> TrainedPredictor:
    predictor = load_predictor(run, horizon=15, dt_s=0.2)
    assert isinstance(predictor, TrainedPredictor)
    return predictor


def test_features_are_those_that_the_network_encodes(run: str) -> None:
    """SSP-ASP gives z and, behind it, the ẑ that ψ predicts from it; the others give z."""
    predictor = load(run)
    forecast = predictor.predict(scene())
    network = predictor.network
    with torch.inference_mode():
        batch = make_batch(scene(), predictor.view, predictor.history)
        if isinstance(network, SSPASPNetwork):
            _, labels = draw_samples(
                range(len(batch.motion)),
                view="vectors",
                horizon_s=predictor.horizon * predictor.dt_s,
                later_ticks=network.later_ticks,
            )
            _, features = network.validate(network(batch), batch, labels, TrainingProgress())
            assert features is not None
            expected = torch.cat([network.encode(batch), features.predicted], dim=1)
        else:
            encoder: Any = network.get_submodule("encoder")
            norm: Any = network.get_submodule("norm")
            expected = norm(encoder(batch.observation))
    assert forecast.features is not None
    assert forecast.features.dtype == np.float32
    assert forecast.features.shape == (12, feature_size(predictor)) == tuple(expected.shape)
    assert feature_size(predictor) == SIZE * (1 + isinstance(network, SSPASPNetwork))
    np.testing.assert_allclose(forecast.features, expected.numpy(), atol=1e-6)


def test_targets_without_a_forecast_have_zeros(run: str) -> None:
    missing = scene()
    missing.valid[0, 0] = False
    forecast = load(run).predict(missing)
    assert forecast.features is not None
    assert not forecast.features[~forecast.valid].any()
    assert forecast.features[forecast.valid].any(axis=1).all()


def test_wrappers_pass_the_features_on(run: str) -> None:
    """The most probable mode has those of all modes; a delayed predictor those of then."""
    forecast = load(run).predict(scene())
    best = load_predictor(f"most-probable:{run}", horizon=15, dt_s=0.2)
    assert feature_size(best) == feature_size(load(run))
    np.testing.assert_array_equal(best.predict(scene()).features, forecast.features)
    recording = [make_recording()]
    index = index_snippets(recording, dt_s=0.2, horizon_s=3.0, history_s=3.4)
    longer = gather_scene(recording, index)
    late = load_predictor(f"delayed:2:{run}", horizon=13, dt_s=0.2)
    assert feature_size(late) == feature_size(load(run))
    then = load(run).predict(_scene_before(longer, 2))
    np.testing.assert_array_equal(late.predict(longer).features, then.features)


def test_physical_predictors_have_no_features() -> None:
    predictor = load_predictor("constant-velocity", horizon=15, dt_s=0.2)
    assert feature_size(predictor) == 0
    assert predictor.predict(scene()).features is None
