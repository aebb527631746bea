"""Pretrained weights: the name `pretrained`, the files that ship, and their accuracy."""

import json
import subprocess
import sys
from pathlib import Path

import gymnasium
import numpy as np
import pytest
from safetensors.numpy import load_file

import asp_env
from asp_env.data.predictor import load_predictor
from asp_env.data.source import open_data
from asp_env.errors import AspEnvError, CheckpointError
from asp_env.evaluation.open_loop.evaluate import Evaluate, evaluate
from asp_env.evaluation.selection import ticks_to_evaluate
from predictors.inference.checkpoint import weights_hash
from predictors.inference.pretrained import PRETRAINED, pretrained_folder, pretrained_names
from tests.predictors.tiny import save_random

MOST_BYTES = 2_000_000

every = pytest.mark.parametrize("name", pretrained_names())


def test_predictors_that_are_shipped() -> None:
    assert pretrained_names() == ("ffw-asp", "ssp-asp")


@every
def test_files_that_ship(name: str) -> None:
    """The files of a run; the weights have less than 2 MB, and the card has their hash."""
    folder = pretrained_folder(name)
    assert {path.name for path in folder.iterdir()} == {
        "README.md",
        "config.json",
        "features.safetensors",
        "weights.safetensors",
    }
    assert (folder / "weights.safetensors").stat().st_size < MOST_BYTES
    card = (folder / "README.md").read_text()
    assert weights_hash(folder) in card
    assert "python -m predictors.experiments.pretrained" in card


@every
def test_config_names_the_recordings_of_the_training(name: str) -> None:
    """By 64 hexadecimal digits each, so that they are left out of an evaluation."""
    trained_on = load_predictor(f"{name}:{PRETRAINED}", horizon=15, dt_s=0.2).trained_on
    assert trained_on is not None
    assert {len(content) for content in trained_on.parts} == {64}
    assert set(trained_on.parts.values()) == {"train", "validation"}


@every
def test_recordings_of_the_training_are_left_out(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With `--part auto`, no tick of a recording is left whose hash is in the configuration."""
    predictor = load_predictor(f"{name}:{PRETRAINED}", horizon=15, dt_s=0.2)
    assert predictor.trained_on is not None
    recordings = open_data("sample:intersection")
    allowed, _ = ticks_to_evaluate(recordings, [predictor], "auto", dt_s=0.2)
    assert allowed[0].all()
    content = next(iter(predictor.trained_on.parts))
    monkeypatch.setattr(type(recordings), "hashes", lambda _: (content,))
    allowed, _ = ticks_to_evaluate(recordings, [predictor], "auto", dt_s=0.2)
    assert not allowed[0].any()


@every
@pytest.mark.parametrize("site", ["intersection", "roundabout"])
def test_errors_are_below_those_of_constant_velocity(name: str, site: str, tmp_path: Path) -> None:
    """On the shipped sample, which no predictor was trained on: by a quarter for moving targets."""
    result = evaluate(
        Evaluate(
            data=f"sample:{site}",
            out=tmp_path,
            predictors=("constant-velocity", f"{name}:{PRETRAINED}"),
            planner="none",
        )
    )
    ratios = {
        row.selection: row.value
        for row in result.rows
        if row.metric == "FDE / constant velocity" and row.subset == "moving"
    }
    assert ratios["most-probable"] < 0.75
    assert ratios["best-of-3"] < 0.5


def test_a_folder_of_that_name_does_not_hide_the_shipped_weights(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """`pretrained` is the shipped run everywhere; `./pretrained` is a folder's."""
    save_random(tmp_path / PRETRAINED)
    monkeypatch.chdir(tmp_path)
    weights = {
        argument: load_predictor(f"ffw-asp:{argument}", horizon=15, dt_s=0.2).metadata["weights"]
        for argument in (PRETRAINED, f"./{PRETRAINED}")
    }
    assert weights == {
        PRETRAINED: weights_hash(pretrained_folder("ffw-asp")),
        f"./{PRETRAINED}": weights_hash(tmp_path / PRETRAINED),
    }


def test_predictor_without_pretrained_weights_is_refused() -> None:
    """The message lists those that have some."""
    with pytest.raises(CheckpointError, match="ships ffw-asp:pretrained, ssp-asp:pretrained"):
        load_predictor("mtp:pretrained", horizon=15, dt_s=0.2)


def test_missing_run_names_the_pretrained_weights() -> None:
    with pytest.raises(CheckpointError, match=r"or ffw-asp:pretrained$"):
        load_predictor("ffw-asp", horizon=15, dt_s=0.2)


def test_chaining_of_pretrained_weights() -> None:
    """They forecast one segment, which leaves nothing to chain; unknown chainings are refused."""
    with pytest.raises(AspEnvError, match="nothing to chain"):
        load_predictor("ssp-asp:pretrained@beam", horizon=15, dt_s=0.2)
    with pytest.raises(AspEnvError, match="unknown chaining 'bean'"):
        load_predictor("ssp-asp:pretrained@bean", horizon=15, dt_s=0.2)


def test_training_packages_are_not_needed() -> None:
    """A forecast needs torch and safetensors, but neither Lightning nor TensorBoard."""
    code = """
import sys
sys.modules["lightning"] = sys.modules["tensorboard"] = None
import asp_env.data.predictor, asp_env.data.snippets, asp_env.data.source, json
recordings = asp_env.data.source.open_data("sample:roundabout")
index = asp_env.data.snippets.index_snippets(recordings, dt_s=0.2, horizon_s=3.0)
scene = asp_env.data.snippets.gather_scene(recordings, index.select(slice(0, 4)))
predictor = asp_env.data.predictor.load_predictor("ssp-asp:pretrained", horizon=15, dt_s=0.2)
print(json.dumps(predictor.predict(scene).states.shape))
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert json.loads(done.stdout) == [4, 4, 15, 4]  # the last mode stands


def test_forecasts_as_observation() -> None:
    """A learned predictor's forecasts in an environment, without any training."""
    env = asp_env.PredictionFeatures(
        gymnasium.make("asp_env/Replay-v0", observations=("state",)), "ffw-asp:pretrained", modes=4
    )
    observation, _ = env.reset(seed=0)
    assert observation["forecast_valid"].sum() > 0
    probabilities = observation["forecast_probabilities"].reshape(8, 4)
    present = observation["forecast_valid"] == 1
    np.testing.assert_allclose(probabilities[present].sum(axis=1), 1, atol=1e-5)
    assert (probabilities[present].max(axis=1) < 1).any()


def test_weights_are_rounded_to_half_precision() -> None:
    """Every stored weight is float16; the network computes in float32."""
    for name in pretrained_names():
        stored = load_file(pretrained_folder(name) / "weights.safetensors")
        assert {tensor.dtype for tensor in stored.values()} == {np.dtype(np.float16)}
