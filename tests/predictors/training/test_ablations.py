"""Ablations: each changes what its name says, and no training time but `long`'s."""

import dataclasses
from pathlib import Path

import pytest

from asp_env.errors import AspEnvError
from predictors.training.recipes import TrainingConfig, recipe
from predictors.training.command import Train
from predictors.training.variants import VARIANTS, variant, warm_starts_from_3s

EVERY = [(predictor, name) for predictor, names in VARIANTS.items() for name in names]


def both(
    predictor: str, name: str, *, preset: str = "cpu", view: str = "chauffeurnet"
) -> tuple[TrainingConfig, TrainingConfig]:
    """The recipe and its variant, as the command makes it."""
    horizon = VARIANTS[predictor][name].horizons_s[0]
    command = Train(
        predictor=predictor, data="", out=Path(), recipe=preset, view=view,
        horizon=horizon, variant=name,
    )  # fmt: skip
    return recipe(predictor, preset, view=view, horizon_s=horizon), command.config_for(horizon)


@pytest.mark.parametrize("preset", ["cpu", "paper"])
@pytest.mark.parametrize(("predictor", "name"), EVERY)
def test_something_changes_but_not_the_time(predictor: str, name: str, preset: str) -> None:
    """Another configuration of as many epochs in all; `long` has three times as many.

    What goes on from a run for 3 s counts that run's epochs too: a staged run of the paper's size
    has 20 in all, where 6 s at once have 10.
    """
    base, changed = both(predictor, name, preset=preset)
    assert changed.preset == f"{preset}+{name}"
    if (preset, name) not in (("paper", "euler"), ("paper", "staged")):  # Euler's; by its start
        assert dataclasses.replace(changed, preset=base.preset) != base
    epochs = base.all_epochs * (3 if name == "long" else 1)
    before = recipe(predictor, preset, view="chauffeurnet", horizon_s=3.0).all_epochs
    if name == "from-scratch":
        epochs += before
    if name == "staged":
        epochs = (16 if preset == "cpu" else 20) - before
    assert changed.all_epochs == epochs


@pytest.mark.parametrize(("preset", "hidden"), [("cpu", 256), ("paper", 4096)])
def test_connected_head_is_as_wide_as_dkms(preset: str, hidden: int) -> None:
    """The head of the paper's ablation has the width of DKM's own at either size."""
    network = dataclasses.asdict(both("ffw-asp", "connected-head", preset=preset)[1].network)
    assert (network["head"], network["hidden"]) == ("connected", hidden)
    own = recipe("dkm", preset, view="chauffeurnet", horizon_s=3.0).network
    assert dataclasses.asdict(own)["hidden"] == hidden


def test_no_future_loss_learns_actions_alone() -> None:
    """Neither features nor past actions weigh anything, and no epoch is spent on them."""
    config = both("ssp-asp", "no-future-loss")[1]
    network = dataclasses.asdict(config.network)
    assert (network["feature_weight"], network["action_weight"]) == (0.0, 0.0)
    assert not network["encoded_branch"]
    assert config.pretraining_epochs == 0


def test_trail_is_left_out_of_views_that_have_one() -> None:
    """Either view has a twin without the trail; the one of MTP has none, which is one line."""
    assert both("dkm", "no-trail")[1].view == "chauffeurnet-no-trail"
    assert both("dkm", "no-trail", view="vectors")[1].view == "vectors-no-trail"
    with pytest.raises(AspEnvError, match="unknown view 'mtp-no-trail'"):
        both("dkm", "no-trail", view="mtp")


def test_unknown_variants_list_the_known_ones() -> None:
    """A name of another predictor's is none of this one's."""
    with pytest.raises(AspEnvError, match=r"variant of dkm 'skip': known are .*causal, euler, "):
        variant("dkm", "skip")


@pytest.mark.parametrize(
    ("predictor", "name", "epochs"), [("dkm", "staged", 2), ("ssp-asp", "from-scratch", 8)]
)
def test_other_epochs_than_the_presets_are_shared_likewise(
    predictor: str, name: str, epochs: int
) -> None:
    """With 4 for 6 s: half of them after 3 s (8 of 16), or as many again at once (16 for 8)."""
    command = Train(predictor=predictor, data="", out=Path(), horizon=6.0, variant=name, epochs=4)
    assert command.config_for(6.0).epochs == epochs


def test_only_what_chains_goes_on_from_3_s() -> None:
    """As in the paper: FFW-ASP predicts 6 s at once; a variant says so where it does otherwise."""
    assert [each for each in VARIANTS if warm_starts_from_3s(each)] == ["ssp-asp"]
    assert warm_starts_from_3s("ssp-asp", "ema")
    assert not warm_starts_from_3s("ssp-asp", "from-scratch")
    assert warm_starts_from_3s("dkm", "staged")
    assert not warm_starts_from_3s("dkm", "long")
    with pytest.raises(AspEnvError, match="unknown variant of dkm"):
        warm_starts_from_3s("dkm", "from-scratch")
