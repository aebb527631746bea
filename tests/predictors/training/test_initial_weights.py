"""Runs that start from other weights: which ones are loaded, and what is refused."""

import json
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors.torch import load_file, save_file

from asp_env import registry
from asp_env.errors import CheckpointError
from asp_env.views import make_view
from predictors.inference.checkpoint import PredictorSpec
from predictors.training.initial_weights import InitialWeights
from tests.predictors.tiny import (
    PIXELS,
    RANGE,
    make_network,
    pixels_of,
    save_random,
    tiny_network,
    tiny_shape,
)


def spec_of(predictor: str) -> PredictorSpec:
    """The registered specification."""
    return registry.find("predictors", predictor)


def read(
    run: Path, predictor: str, view: str = "chauffeurnet", dt_s: float = 0.2
) -> InitialWeights:
    """The weights for a run of a predictor on a view."""
    drawn = make_view(view, pixels=pixels_of(view))
    return InitialWeights.read(run, spec_of(predictor), view=drawn, dt_s=dt_s)


NOT_LOADED: dict[str, set[str]] = {
    "ssp-asp": set(),
    "ffw-asp": {"head.layers.0.weight", "head.layers.0.bias"},
    "dkm": {"head.layers.2.weight", "head.layers.2.bias"},
    "mtp": {"head.layers.2.weight", "head.layers.2.bias"},
}
"""Weights that a network for 6 s does not load from one for 3 s."""


@pytest.mark.parametrize("view", ["chauffeurnet", "vectors"])
@pytest.mark.parametrize("predictor", NOT_LOADED)
def test_network_for_6_s_loads_what_fits_of_3_s(predictor: str, view: str, tmp_path: Path) -> None:
    """SSP-ASP loads all weights, the others all but the output, whose size is the horizon's."""
    run = save_random(tmp_path / "3s", predictor, view, seed=1)
    start = read(run, predictor, view)
    assert start.action_range == RANGE
    network = make_network(predictor, tiny_network(predictor, view), tiny_shape(view, 30))
    before = {name: value.clone() for name, value in network.state_dict().items()}
    assert set(start.apply(network)) == NOT_LOADED[predictor]
    weights = load_file(run / "weights.safetensors")
    for name, value in network.state_dict().items():
        expected = before[name] if name in NOT_LOADED[predictor] else weights[name]
        assert torch.equal(value, expected), name


def test_second_encoder_starts_as_a_copy_of_the_first(tmp_path: Path) -> None:
    """A run with a second encoder starts from a run without one."""
    run = save_random(tmp_path / "3s", "ssp-asp", "vectors", seed=1)
    config = tiny_network("ssp-asp", "vectors", ema=0.9)
    network = make_network("ssp-asp", config, tiny_shape("vectors", 30))
    read(run, "ssp-asp", "vectors").apply(network)
    state = network.state_dict()
    pairs = [(n, n.removeprefix("target_")) for n in state if n.startswith("target_encoder.")]
    assert pairs
    for second, first in pairs:
        assert torch.equal(state[second], state[first])


def change(run: Path, **fields: Any) -> None:
    """Changes fields of a run's configuration."""
    path = run / "config.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), **fields}))


def test_weights_of_another_kind_are_refused(tmp_path: Path) -> None:
    """Another predictor, view (also one without a trail), encoder or time step."""
    run = save_random(tmp_path / "run", "ffw-asp")
    refusals = {
        "the predictor 'ffw-asp', which 'dkm' cannot": (
            "dkm",
            "chauffeurnet",
            0.2,
        ),
        "has another view than this run": ("ffw-asp", "vectors", 0.2),
        "another view": ("ffw-asp", "chauffeurnet-no-trail", 0.2),
        r"time step of 0\.2 s, not of 0\.1 s": ("ffw-asp", "chauffeurnet", 0.1),
    }
    for message, (predictor, view, dt_s) in refusals.items():
        with pytest.raises(CheckpointError, match=message) as caught:
            read(run, predictor, view, dt_s)
        assert "\n" not in str(caught.value)
    other = make_network("ffw-asp", tiny_network("ffw-asp", features=6), tiny_shape())
    with pytest.raises(CheckpointError, match="has another encoder than this run") as caught:
        read(run, "ffw-asp").apply(other)
    assert "\n" not in str(caught.value)


def test_damaged_runs_are_refused(tmp_path: Path) -> None:
    """A missing run, no normaliser, truncated weights."""
    with pytest.raises(CheckpointError, match="holds no trained predictor"):
        read(tmp_path / "nothing", "dkm")
    run = save_random(tmp_path / "run", "dkm")
    change(run, normaliser={})
    with pytest.raises(CheckpointError, match="does not name its normaliser"):
        read(run, "dkm")
    weights = run / "weights.safetensors"
    weights.write_bytes(weights.read_bytes()[:1000])
    with pytest.raises(CheckpointError, match="cannot be read"):
        read(run, "dkm")


def test_resnet_weights_are_loaded_into_any_resnet(tmp_path: Path) -> None:
    """The file has no normaliser and fits the encoder of any predictor with a ResNet18."""
    source = make_network("dkm", tiny_network("dkm", encoder="resnet18"), tiny_shape(), seed=1)
    body = source.get_submodule("encoder.body").state_dict()
    path = tmp_path / "resnet18.safetensors"
    save_file(body, path)
    start = read(path, "ffw-asp")
    assert start.action_range is None
    network = make_network("ffw-asp", tiny_network("ffw-asp", encoder="resnet18"), tiny_shape())
    assert start.apply(network) == []
    for name, value in network.get_submodule("encoder.body").state_dict().items():
        assert torch.equal(value, body[name]), name
    with pytest.raises(CheckpointError, match="has no resnet18"):
        start.apply(make_network("ffw-asp", tiny_network("ffw-asp"), tiny_shape()))


def test_rasters_of_another_size_are_another_view(tmp_path: Path) -> None:
    """ResNet18 reads rasters of any size, but their scale differs."""
    run = save_random(tmp_path / "run", "dkm")
    drawn = make_view("chauffeurnet", pixels=(2 * PIXELS[0], 2 * PIXELS[1]))
    with pytest.raises(CheckpointError, match="another view"):
        InitialWeights.read(run, spec_of("dkm"), view=drawn, dt_s=0.2)
