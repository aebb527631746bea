"""Shipping of a run: weights in half precision, and a card that has their hash."""

from pathlib import Path

import numpy as np
import torch
from safetensors.numpy import load_file

from asp_env.data.predictor import load_predictor
from asp_env.data.snippets import gather_scene, index_snippets
from predictors.experiments.pretrained import ship
from predictors.inference.checkpoint import weights_hash
from predictors.inference.trained import TrainedPredictor
from tests.builders import make_recording
from tests.predictors.tiny import save_random


def test_shipped_weights_are_the_run_s_rounded(tmp_path: Path) -> None:
    """To the nearest float16; positions differ by less than 3 cm."""
    run, shipped = save_random(tmp_path / "run"), tmp_path / "shipped"
    ship(run, shipped, made_in=tmp_path)
    before, after = (load_file(each / "weights.safetensors") for each in (run, shipped))
    assert before.keys() == after.keys()
    for name, weights in before.items():
        np.testing.assert_array_equal(after[name], weights.astype(np.float16), name)
    recordings = [make_recording()]
    scene = gather_scene(recordings, index_snippets(recordings, dt_s=0.2, horizon_s=3.0))
    one, other = (
        load_predictor(f"ffw-asp:{each}", horizon=15, dt_s=0.2).predict(scene).states
        for each in (run, shipped)
    )
    assert 0 < np.abs(one - other).max() < 0.03


def test_weights_that_only_training_uses_have_four_bits(tmp_path: Path) -> None:
    """ξ of SSP-ASP; no forecast changes if ξ does."""
    run, shipped = save_random(tmp_path / "run", "ssp-asp", "vectors"), tmp_path / "shipped"
    ship(run, shipped, made_in=tmp_path)
    before, after = (load_file(each / "weights.safetensors") for each in (run, shipped))
    names = {name for name in before if name.startswith("reconstructor.")}
    assert names
    for name, weights in before.items():
        bits = 4 if name in names else 11
        fractions, _ = np.frexp(after[name].astype(np.float32))
        assert not (np.ldexp(fractions, bits) % 1).any(), name
        np.testing.assert_allclose(after[name], weights, rtol=2.0**-bits, atol=2.0**-24)
    predictor = load_predictor(f"ssp-asp:{shipped}", horizon=15, dt_s=0.2)
    assert isinstance(predictor, TrainedPredictor)
    recordings = [make_recording()]
    scene = gather_scene(recordings, index_snippets(recordings, dt_s=0.2, horizon_s=3.0))
    expected = predictor.predict(scene).states
    torch.nn.init.zeros_(predictor.network.get_parameter("reconstructor.0.weight"))
    np.testing.assert_array_equal(predictor.predict(scene).states, expected)


def test_card_of_shipped_weights_has_their_hash(tmp_path: Path) -> None:
    """The rest of the card is unchanged."""
    run, shipped = save_random(tmp_path / "run"), tmp_path / "shipped"
    ship(run, shipped, made_in=tmp_path)
    cards = [(each / "README.md").read_text() for each in (run, shipped)]
    hashes = [weights_hash(each) for each in (run, shipped)]
    assert hashes[0] != hashes[1]
    assert cards[1].replace(hashes[1], hashes[0]) == cards[0]
