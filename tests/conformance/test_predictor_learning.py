"""What learned predictors owe besides: they can be stored, and can learn."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import torch

from asp_env.data.predictor import load_predictor
from predictors.models.network import TrainingProgress
from predictors.training.recipes import RECIPES
from tests.conformance.predictor_cases import LEARNED, Case, ask, assert_same, situations
from tests.predictors.tiny import draw_samples, make_network, tiny_network, tiny_shape


@pytest.mark.parametrize("case", LEARNED, ids=[case.label for case in LEARNED])
def test_loaded_again_it_forecasts_the_same(case: Case, folder: Path) -> None:
    """Two loads of one folder are equal bit for bit; other weights are not."""
    name = case.save(folder)
    one, again = (load_predictor(name, horizon=case.horizon, dt_s=0.2) for _ in range(2))
    scene, future = situations(one)
    assert_same(ask(one, scene, future), ask(again, scene, future))
    name = case.save(folder / "other", seed=1)
    other = load_predictor(name, horizon=case.horizon, dt_s=0.2)
    assert np.abs(ask(other, scene, future).states - ask(again, scene, future).states).max() > 0.01


@pytest.mark.parametrize("name", RECIPES)
def test_it_overfits_four_snippets(name: str) -> None:
    """After 150 steps the most probable mode is within 1 m of four labels at every tick.

    No mode is drawn by chance: that takes longer.
    """
    sizes = {"features": 32, "gru_width": 32, "hidden": 64}
    config = tiny_network(name, assignment="angle")
    config = dataclasses.replace(
        config, **{k: v for k, v in sizes.items() if getattr(config, k, 0)}
    )
    network = make_network(name, config, tiny_shape())
    batch, labels = draw_samples([8, 30, 41, 55], later_ticks=network.later_ticks)
    optimizer = torch.optim.Adam(network.parameters(), lr=1e-2)
    falling = torch.optim.lr_scheduler.LinearLR(
        optimizer, start_factor=1.0, end_factor=0.0, total_iters=150
    )
    for _ in range(150):
        optimizer.zero_grad()
        network.training_loss(batch, labels, TrainingProgress())["loss"].backward()
        optimizer.step()
        network.after_step()
        falling.step()
    with torch.no_grad():
        modes = network(batch)
    chosen = modes.states[torch.arange(4), modes.logits.argmax(dim=1)]
    error = torch.linalg.vector_norm(chosen[..., :2] - labels.states[..., :2], dim=-1)
    assert float(error.max()) < 1
