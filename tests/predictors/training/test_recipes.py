"""Recipes: the numbers of the paper, budgets, and invalid configurations."""

import dataclasses
from typing import Any

import pytest

from asp_env.errors import AspEnvError
from predictors.models.ffw_asp import FFWASPConfig
from predictors.models.losses import DEFAULT_ASSIGNMENT
from predictors.models.ssp_asp import SSPASPConfig
from predictors.training.augmentation import Augmentation
from predictors.training.recipes import RECIPES, TrainingConfig, recipe
from tests.predictors.tiny import tiny_config


@pytest.mark.parametrize("predictor", RECIPES)
@pytest.mark.parametrize("horizon_s", [3.0, 6.0])
def test_recipes_paper_have_the_numbers_of_the_paper(predictor: str, horizon_s: float) -> None:
    """ResNet18 of 512, 3 modes by the common rule, Euler; Adam 1e-4, batches of 32, 10 epochs.

    SSP-ASP has three more epochs of pre-training, unless its run for 6 s starts from 3 s.
    """
    config = recipe(predictor, "paper", view="chauffeurnet", horizon_s=horizon_s)
    network = config.network
    assert (network.encoder, network.features, network.modes) == ("resnet18", 512, 3)
    assert (network.assignment, network.annealed) == (DEFAULT_ASSIGNMENT, False)
    assert network.classification == "cross-entropy"
    assert getattr(network, "integrator", "euler") == "euler"
    assert (config.learning_rate, config.batch_size, config.epochs) == (1e-4, 32, 10)
    assert (config.schedule, config.weight_decay) == ("plateau", 0.0)
    assert (config.pixels, config.snippets_per_epoch) == (None, None)
    assert (config.standing_share, config.max_snippets) == (1.0, None)
    assert (config.view, config.horizon_s, config.dt_s) == ("chauffeurnet", horizon_s, 0.2)
    first = predictor == "ssp-asp" and horizon_s == 3.0
    assert config.pretraining_epochs == (3 if first else 0)


def test_recurrent_networks_of_the_paper() -> None:
    """GRUs of 2x512 without skip or hidden layer; SSP-ASP has four equal weights and both branches.

    Its options beyond the paper are off.
    """
    ffw = recipe("ffw-asp", "paper", view="mtp", horizon_s=3.0).network
    ssp = recipe("ssp-asp", "paper", view="mtp", horizon_s=3.0).network
    assert isinstance(ffw, FFWASPConfig)
    assert isinstance(ssp, SSPASPConfig)
    assert ffw.head == "recurrent"
    for network in (ffw, ssp):
        assert (network.gru_width, network.gru_layers) == (512, 2)
        assert (network.skip, network.hidden) == (False, 0)
    assert (ssp.action_weight, ssp.feature_weight) == (1.0, 1.0)
    assert (ssp.regression_weight, ssp.classification_weight) == (1.0, 1.0)
    assert ssp.encoded_branch
    assert not any((ssp.normalise, ssp.stop_gradient, ssp.ema, ssp.scheduled))


CASES = [(predictor, name) for predictor, names in RECIPES.items() for name in names]


@pytest.mark.parametrize(("predictor", "name"), CASES)
def test_every_recipe_is_for_every_view(predictor: str, name: str) -> None:
    """The encoder fits the view; small rasters have 90x60 pixels, or 90x90 in the square view.

    The recipe `robust` refuses rasters, which it cannot augment.
    """
    for view, pixels in (("chauffeurnet", (90, 60)), ("mtp", (90, 90)), ("vectors", None)):
        if name == "robust" and view != "vectors":
            with pytest.raises(AspEnvError, match="give --view vectors"):
                recipe(predictor, name, view=view, horizon_s=3.0)
            continue
        config = recipe(predictor, name, view=view, horizon_s=3.0)
        assert (config.predictor, config.preset, config.view) == (predictor, name, view)
        if name == "paper":
            pixels = None
        assert config.pixels == pixels
        encoder = "resnet18" if name == "paper" else "small"
        assert config.network.encoder == ("vector" if view == "vectors" else encoder)


@pytest.mark.parametrize(("name", "epochs", "pretraining"), [("cpu", 8, 2), ("paper", 10, 3)])
def test_pretraining_is_additional(name: str, epochs: int, pretraining: int) -> None:
    """All predictors have equal prediction epochs at 3 s; SSP-ASP's pre-training comes before."""
    for predictor in RECIPES:
        config = recipe(predictor, name, view="vectors", horizon_s=3.0)
        own = pretraining if predictor == "ssp-asp" else 0
        assert (config.epochs, config.pretraining_epochs) == (epochs, own)
        assert config.all_epochs == epochs + own


@pytest.mark.parametrize(("predictor", "name"), CASES)
def test_the_rule_for_the_best_mode_is_one_constant(predictor: str, name: str) -> None:
    """Every recipe has it but `ours`, which was chosen with `distance`, and `robust`."""
    network = recipe(predictor, name, view="vectors", horizon_s=3.0).network
    assert network.assignment == ("distance" if name in ("ours", "robust") else DEFAULT_ASSIGNMENT)


def test_small_runs_for_6_s_have_equal_prediction_epochs() -> None:
    """16 epochs each: SSP-ASP has 8 for 3 s and 8 for 6 s, the others have 16 at once."""
    small = [case for case in CASES if case[1] != "paper"]
    assert len(small) == 8
    for predictor, name in small:
        short, long = (
            recipe(predictor, name, view="vectors", horizon_s=horizon_s).epochs
            for horizon_s in (3.0, 6.0)
        )
        assert (short + long if predictor == "ssp-asp" else long) == 16


def test_unknown_names_list_the_known_ones() -> None:
    """The error suggests the nearest name and lists all."""
    with pytest.raises(AspEnvError, match="did you mean 'ffw-asp'"):
        recipe("ffw", "cpu", view="chauffeurnet", horizon_s=3.0)
    with pytest.raises(AspEnvError, match="known are cpu, ours, paper, robust"):
        recipe("ffw-asp", "gpu", view="chauffeurnet", horizon_s=3.0)


@pytest.mark.parametrize(
    "field",
    [
        *("epochs", "patience", "progress_epochs", "batch_size"),
        *("snippets_per_epoch", "max_snippets", "max_validation_snippets"),
    ],
)
def test_numbers_of_zero_are_refused(field: str) -> None:
    zero: Any = {field: 0}
    with pytest.raises(AspEnvError, match=f"{field} is 0, expected 1 or more"):
        tiny_config(**zero)


def test_numbers_out_of_range_are_refused() -> None:
    """A share of standing targets above one, negative epochs, or patience with `one-cycle`."""
    with pytest.raises(AspEnvError, match="patience is 2 with the schedule one-cycle"):
        tiny_config(patience=2)
    with pytest.raises(AspEnvError, match=r"standing_share is 1\.5"):
        tiny_config(standing_share=1.5)
    with pytest.raises(AspEnvError, match="augmentation infers past actions from changed states"):
        tiny_config(augmentation=Augmentation(), history="accelerations")
    with pytest.raises(AspEnvError, match="pretraining_epochs is -1"):
        tiny_config(pretraining_epochs=-1)
    assert isinstance(tiny_config(), TrainingConfig)
    assert dataclasses.replace(tiny_config(), pretraining_epochs=2).all_epochs == 6


@pytest.mark.parametrize("name", RECIPES["ssp-asp"])
@pytest.mark.parametrize("horizon_s", [1.5, 4.0])
def test_horizon_that_is_no_number_of_segments_is_refused(name: str, horizon_s: float) -> None:
    """1.5 and 4 s are no whole number of segments of 3 s."""
    with pytest.raises(AspEnvError, match=f"horizon of {horizon_s:g} s is no whole number"):
        recipe("ssp-asp", name, view="vectors", horizon_s=horizon_s)


@pytest.mark.parametrize("seed", [-1, 2**32])
def test_seeds_that_not_all_generators_take_are_refused(seed: int) -> None:
    """NumPy refuses the first one, others the second."""
    config = recipe("ffw-asp", "cpu", view="vectors", horizon_s=3.0)
    with pytest.raises(AspEnvError, match=f"seed is {seed}, expected 0 to 4294967295"):
        dataclasses.replace(config, seed=seed)
