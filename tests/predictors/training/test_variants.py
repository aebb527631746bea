"""Variants: each changes the recipe, but not the prediction epochs, except `long`."""

import dataclasses
from pathlib import Path

import pytest

from asp_env.errors import AspEnvError
from predictors.models.losses import DEFAULT_ASSIGNMENT
from predictors.training.command import Train
from predictors.training.recipes import RECIPES, TrainingConfig, recipe
from predictors.training.variants import (
    ASSIGNMENTS,
    VARIANTS,
    ablations,
    variant,
    warm_starts_from_3s,
)

EVERY = [
    (predictor, name)
    for predictor, names in VARIANTS.items()
    for name in names
    if ASSIGNMENTS.get(name) != DEFAULT_ASSIGNMENT
]


def both(
    predictor: str, name: str, *, recipe_name: str = "cpu", view: str = "chauffeurnet"
) -> tuple[TrainingConfig, TrainingConfig]:
    """The configurations of a recipe and of its variant, as the command makes it."""
    horizon = VARIANTS[predictor][name].horizons_s[0]
    command = Train(
        predictor=predictor, data=("",), out=Path(), recipe=recipe_name, view=view,
        horizon=horizon, variant=name,
    )  # fmt: skip
    return recipe(predictor, recipe_name, view=view, horizon_s=horizon), command.config_for(horizon)


@pytest.mark.parametrize("recipe_name", ["cpu", "paper"])
@pytest.mark.parametrize(("predictor", "name"), EVERY)
def test_variant_changes_the_recipe_but_not_the_time(
    predictor: str, name: str, recipe_name: str
) -> None:
    """A different configuration with equal prediction epochs; `long` has three times as many.

    The epochs of a run for 3 s that the run starts from count, too, and those of the run for one
    segment. With the recipe `paper`, `staged` has 20 in total, 6 s at once have 10. Pre-training
    is that of the recipe, or of the run for 3 s that is left out, or it comes before the run for
    one shorter segment; two variants omit it.
    """
    base, changed = both(predictor, name, recipe_name=recipe_name)
    assert changed.preset == f"{recipe_name}+{name}"
    if (recipe_name, name) not in (("paper", "euler"), ("paper", "staged")):  # equal but for start
        assert dataclasses.replace(changed, preset=base.preset) != base
    epochs, pretraining = base.epochs * (3 if name == "long" else 1), base.pretraining_epochs
    first = recipe(predictor, recipe_name, view="chauffeurnet", horizon_s=3.0)
    if name == "from-scratch":
        epochs, pretraining = epochs + first.epochs, first.pretraining_epochs
    segment_s = VARIANTS[predictor][name].segment_s
    if segment_s is not None:  # 6 s: from scratch, without a run for 3 s
        epochs = first.epochs if base.horizon_s == 3.0 else first.epochs + base.epochs
        pretraining = first.pretraining_epochs
        if segment_s < base.horizon_s:
            stage = first_segment(predictor, name, recipe_name)
            assert (2 * stage.epochs, stage.pretraining_epochs) == (first.epochs, pretraining)
            epochs, pretraining = epochs - stage.epochs, 0
    if name == "staged":
        epochs = (16 if recipe_name == "cpu" else 20) - first.epochs
    if name in ("no-pretraining", "no-future-loss"):
        pretraining = 0
    assert (changed.epochs, changed.pretraining_epochs) == (epochs, pretraining)


RECIPES_OF = [(predictor, name) for predictor, names in RECIPES.items() for name in names]


@pytest.mark.parametrize(("predictor", "recipe_name"), RECIPES_OF)
def test_every_recipe_has_the_other_rules_for_the_best_mode(
    predictor: str, recipe_name: str
) -> None:
    """`nearest` is `angle`; a variant equal to the recipe's own rule is refused and no ablation."""
    own = recipe(predictor, recipe_name, view="vectors", horizon_s=3.0).network.assignment
    offered = ablations(predictor, recipe_name)
    for name, rule in {
        "nearest": "angle", "distance": "distance", "angle-random": "angle-random",
    }.items():  # fmt: skip
        assert (name in offered) == (rule != own)
        if rule == own:
            with pytest.raises(AspEnvError, match=f"has the assignment '{rule}' without a variant"):
                both(predictor, name, recipe_name=recipe_name, view="vectors")
        else:
            network = both(predictor, name, recipe_name=recipe_name, view="vectors")[1].network
            assert network.assignment == rule


def test_long_is_no_ablation_where_the_budget_sets_the_epochs() -> None:
    """The other variants stay."""
    offered = ablations("dkm", "cpu"), ablations("dkm", "cpu", budget="cpu")
    assert set(offered[0]) - set(offered[1]) == {"long"}


def first_segment(predictor: str, name: str, recipe_name: str) -> TrainingConfig:
    """The configuration of the run for one segment that longer runs of a variant start from."""
    segment_s = VARIANTS[predictor][name].segment_s
    assert segment_s is not None
    command = Train(
        predictor=predictor, data=("",), out=Path(), recipe=recipe_name, variant=name,
        horizon=segment_s,
    )  # fmt: skip
    return command.config_for(segment_s)


@pytest.mark.parametrize(
    ("horizon", "epochs"), [(1.0, 4), (3.0, 4), (6.0, 12), (9.0, 12), (12.0, 12)]
)
def test_segments_of_1_s_share_their_first_run(horizon: float, epochs: int) -> None:
    """Prediction epochs of `segment-1s`: 4 of the recipe's 8 for 1 s; the rest for each horizon."""
    command = Train(
        predictor="ssp-asp", data=("",), out=Path(), variant="segment-1s", horizon=horizon
    )
    config = command.config_for(horizon)
    assert (config.epochs, config.segment_s, config.first_stage_s) == (epochs, 1.0, 1.0)
    assert config.pretraining_epochs == (2 if horizon == 1.0 else 0)


def test_lengths_of_segments_that_are_refused() -> None:
    """1.5 s are 7.5 ticks; two lengths at once; FFW-ASP chains no segments."""
    fields = {"data": ("",), "out": Path(), "horizon": 6.0}
    ssp = Train(predictor="ssp-asp", **fields)
    with pytest.raises(AspEnvError, match=r"1\.5 s, they are no whole number of ticks of 0\.2 s"):
        dataclasses.replace(ssp, segment_s=1.5).config_for(6.0)
    with pytest.raises(AspEnvError, match=r"into segments of 0\.2, 0\.4, 0\.6, 1, 1\.2, 2, 3, 6 s"):
        dataclasses.replace(ssp, segment_s=2.5).config_for(6.0)
    with pytest.raises(AspEnvError, match="variant segment-1s has segments of 1 s: leave out"):
        dataclasses.replace(ssp, segment_s=2.0, variant="segment-1s").config_for(6.0)
    with pytest.raises(AspEnvError, match="ffw-asp forecasts the whole horizon at once"):
        Train(predictor="ffw-asp", segment_s=1.0, **fields).config_for(6.0)
    with pytest.raises(AspEnvError, match=r"0\.5 s is no whole number of ticks"):
        Train(predictor="ffw-asp", history_s=0.5, **fields).config_for(6.0)


@pytest.mark.parametrize(("recipe_name", "hidden"), [("cpu", 256), ("paper", 4096)])
def test_connected_head_has_the_width_of_dkm(recipe_name: str, hidden: int) -> None:
    network = dataclasses.asdict(
        both("ffw-asp", "connected-head", recipe_name=recipe_name)[1].network
    )
    assert (network["head"], network["hidden"]) == ("connected", hidden)
    own = recipe("dkm", recipe_name, view="chauffeurnet", horizon_s=3.0).network
    assert dataclasses.asdict(own)["hidden"] == hidden


def test_no_future_loss_trains_actions_only() -> None:
    """Features and past actions have the weight 0, and there is no pre-training."""
    config = both("ssp-asp", "no-future-loss")[1]
    network = dataclasses.asdict(config.network)
    assert (network["feature_weight"], network["action_weight"]) == (0.0, 0.0)
    assert not network["encoded_branch"]
    assert config.pretraining_epochs == 0


def test_no_trail_changes_the_view() -> None:
    """There are views without the trail, except for `mtp`."""
    assert both("dkm", "no-trail")[1].view == "chauffeurnet-no-trail"
    assert both("dkm", "no-trail", view="vectors")[1].view == "vectors-no-trail"
    with pytest.raises(AspEnvError, match="unknown view 'mtp-no-trail'"):
        both("dkm", "no-trail", view="mtp")


def test_unknown_variants_list_the_known_ones() -> None:
    """Variants of another predictor are unknown."""
    with pytest.raises(AspEnvError, match=r"variant of dkm 'skip': known are .*causal, distance, "):
        variant("dkm", "skip")


@pytest.mark.parametrize(
    ("predictor", "name", "epochs"), [("dkm", "staged", 2), ("ssp-asp", "from-scratch", 8)]
)
def test_other_numbers_of_epochs_are_scaled(predictor: str, name: str, epochs: int) -> None:
    """Of 4 epochs for 6 s: half of them after 3 s (8 of 16), twice as many at once (16 for 8)."""
    command = Train(
        predictor=predictor, data=("",), out=Path(), horizon=6.0, variant=name, epochs=4
    )
    assert command.config_for(6.0).epochs == epochs


def test_only_ssp_asp_starts_from_3_s() -> None:
    """As in the paper, where FFW-ASP predicts 6 s at once; variants may differ."""
    assert [each for each in VARIANTS if warm_starts_from_3s(each)] == ["ssp-asp"]
    assert warm_starts_from_3s("ssp-asp", "ema")
    assert not warm_starts_from_3s("ssp-asp", "from-scratch")
    assert warm_starts_from_3s("dkm", "staged")
    assert not warm_starts_from_3s("dkm", "long")
    with pytest.raises(AspEnvError, match="unknown variant of dkm"):
        warm_starts_from_3s("dkm", "from-scratch")
