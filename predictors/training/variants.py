"""What is changed of a recipe to learn what a part of it is good for, by name.

Each change leaves the number of steps as it was, those of a run that it goes on from included, so
that a difference is not one of training time; but `long`, and `staged` at the paper's size.
"""

import dataclasses
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

from asp_env.errors import unknown_name
from asp_env.views import VIEWS
from predictors.training.recipes import CHAINED, SEGMENT_S, TrainingConfig, recipe

Change = Callable[[TrainingConfig], TrainingConfig]


@dataclass(frozen=True, slots=True, kw_only=True)
class Variant:
    """A change of a recipe, and where it says something."""

    change: Change
    horizons_s: tuple[float, ...] = (SEGMENT_S,)
    """The horizons that it is meant for."""
    warm_starts_from_3s: bool | None = None
    """Whether a run for more than 3 s goes on from the weights of one for 3 s; None for what
    the predictor's recipe does."""

    def apply(self, config: TrainingConfig, name: str) -> TrainingConfig:
        """The changed recipe; its preset tells the change."""
        return dataclasses.replace(self.change(config), preset=f"{config.preset}+{name}")


def _network(**fields: Any) -> Change:
    """Other fields of the network."""

    def change(config: TrainingConfig) -> TrainingConfig:
        return dataclasses.replace(config, network=dataclasses.replace(config.network, **fields))

    return change


def _after(*changes: Change) -> Change:
    """One change after the other."""

    def change(config: TrainingConfig) -> TrainingConfig:
        for each in changes:
            config = each(config)
        return config

    return change


def connected_head(config: TrainingConfig) -> TrainingConfig:
    """The head of DKM, as wide as there, in place of the recurrent one."""
    hidden = 4096 if config.network.encoder == "resnet18" else 256
    return _network(head="connected", hidden=hidden)(config)


def no_trail(config: TrainingConfig) -> TrainingConfig:
    """A target's own past is not drawn.

    Raises:
        AspEnvError: the view has no such twin.
    """
    view = f"{config.view}-no-trail"
    if view not in VIEWS:
        raise unknown_name("view", view, VIEWS)
    return dataclasses.replace(config, view=view)


def causal(config: TrainingConfig) -> TrainingConfig:
    """Histories know nothing that came later."""
    return dataclasses.replace(config, history="causal")


def long(config: TrainingConfig) -> TrainingConfig:
    """Three times the epochs."""
    return dataclasses.replace(
        config, epochs=3 * config.epochs, pretraining_epochs=3 * config.pretraining_epochs
    )


def no_pretraining(config: TrainingConfig) -> TrainingConfig:
    """All epochs learn actions."""
    return dataclasses.replace(config, pretraining_epochs=0, epochs=config.all_epochs)


def all_epochs(config: TrainingConfig) -> TrainingConfig:
    """Those of a run for 3 s besides its own, for a run that does not go on from one."""
    before, own = _epochs(config, SEGMENT_S), _epochs(config, config.horizon_s)
    return _share(config, (before + own) / own)


def second_stage(config: TrainingConfig) -> TrainingConfig:
    """As many epochs as a run for 3 s had, for a run that goes on from it."""
    return _share(config, _epochs(config, SEGMENT_S) / _epochs(config, config.horizon_s))


def _epochs(config: TrainingConfig, horizon_s: float) -> int:
    """Those of the preset."""
    return recipe(config.predictor, config.preset, view=config.view, horizon_s=horizon_s).all_epochs


def _share(config: TrainingConfig, share: float) -> TrainingConfig:
    """So many times the epochs, which may be others than the preset's."""
    return dataclasses.replace(config, epochs=max(1, round(share * config.epochs)))


_OF_ALL = {
    "no-trail": Variant(change=no_trail),
    "causal": Variant(change=causal),
    "long": Variant(change=long),
    "annealed": Variant(change=_network(annealed=True)),
}
_OF_ACTIONS = _OF_ALL | {
    "euler": Variant(change=_network(integrator="euler")),
    "literal-classification": Variant(change=_network(classification="softmax")),
}

_AT_ONCE = {"staged": Variant(change=second_stage, horizons_s=(6.0,), warm_starts_from_3s=True)}

VARIANTS: Mapping[str, Mapping[str, Variant]] = MappingProxyType(
    {
        "mtp": _OF_ALL | _AT_ONCE,
        "dkm": _OF_ACTIONS | _AT_ONCE,
        "ffw-asp": _OF_ACTIONS
        | _AT_ONCE
        | {
            "connected-head": Variant(change=connected_head),
            "skip": Variant(change=_network(skip=True)),
        },
        "ssp-asp": _OF_ACTIONS
        | {
            "skip": Variant(change=_network(skip=True)),
            "no-pretraining": Variant(change=no_pretraining),
            "from-scratch": Variant(
                change=all_epochs, horizons_s=(6.0,), warm_starts_from_3s=False
            ),
            "ema": Variant(change=_network(ema=0.99)),
            "stop-gradient": Variant(change=_network(stop_gradient=True)),
            "normalise": Variant(change=_network(normalise=True)),
            "ema+normalise": Variant(change=_network(ema=0.99, normalise=True)),
            "no-encoded-branch": Variant(change=_network(encoded_branch=False)),
            "no-future-loss": Variant(
                change=_after(
                    _network(feature_weight=0.0, action_weight=0.0, encoded_branch=False),
                    no_pretraining,
                )
            ),
            "scheduled": Variant(change=_network(scheduled=True), horizons_s=(6.0,)),
        },
    }
)
"""By predictor and name."""


def variant(predictor: str, name: str) -> Variant:
    """A predictor's variant of that name.

    Raises:
        AspEnvError: there is none; those that there are get listed.
    """
    variants = VARIANTS.get(predictor, {})
    if name not in variants:
        raise unknown_name(f"variant of {predictor}", name, variants)
    return variants[name]


def warm_starts_from_3s(predictor: str, name: str | None = None) -> bool:
    """Whether a run for more than 3 s goes on from the weights of one for 3 s.

    Args:
        predictor: whose.
        name: of a change of its recipe; None for the recipe.

    Raises:
        AspEnvError: the predictor has no such variant.
    """
    told = None if name is None else variant(predictor, name).warm_starts_from_3s
    return predictor in CHAINED if told is None else told
