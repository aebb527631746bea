"""Shipping of a run: weights in half precision, and a card that has their hash."""

from pathlib import Path

import numpy as np
from safetensors.numpy import load_file

from asp_env.data.predictor import load_predictor
from asp_env.data.snippets import gather_scene, index_snippets
from predictors.experiments.pretrained import ship
from predictors.inference.checkpoint import weights_hash
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


def test_card_of_shipped_weights_has_their_hash(tmp_path: Path) -> None:
    """The rest of the card is unchanged."""
    run, shipped = save_random(tmp_path / "run"), tmp_path / "shipped"
    ship(run, shipped, made_in=tmp_path)
    cards = [(each / "README.md").read_text() for each in (run, shipped)]
    hashes = [weights_hash(each) for each in (run, shipped)]
    assert hashes[0] != hashes[1]
    assert cards[1].replace(hashes[1], hashes[0]) == cards[0]
