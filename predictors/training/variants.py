"""Variants of recipes, for ablations: named changes of a configuration.

A variant has as many training steps in total as its recipe, including those of the run that it
starts from, so that a difference is not one of training time. The exceptions are `long`, and
`staged` of the recipe `paper`.
"""

import dataclasses
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

from asp_env.errors import unknown_name
from asp_env.views import view_names
from predictors.training.recipes import CHAINED, SEGMENT_S, TrainingConfig, recipe

Change = Callable[[TrainingConfig], TrainingConfig]


@dataclass(frozen=True, slots=True, kw_only=True)
class Variant:
    """A change of a recipe."""

    change: Change
    horizons_s: tuple[float, ...] = (SEGMENT_S,)
    """The horizons for which it is an ablation, seconds."""
    warm_starts_from_3s: bool | None = None
    """Whether a run for more than 3 s starts from the weights of a run for 3 s; None for what the
    predictor's recipe does."""

    def apply(self, config: TrainingConfig, name: str) -> TrainingConfig:
        """The changed configuration; the name of its recipe ends with that of the variant."""
        return dataclasses.replace(self.change(config), preset=f"{config.preset}+{name}")


def _network(**fields: Any) -> Change:
    """Changes fields of the network's configuration."""

    def change(config: TrainingConfig) -> TrainingConfig:
        return dataclasses.replace(config, network=dataclasses.replace(config.network, **fields))

    return change


def _sequence(*changes: Change) -> Change:
    """Applies several changes in order."""

    def change(config: TrainingConfig) -> TrainingConfig:
        for each in changes:
            config = each(config)
        return config

    return change


def connected_head(config: TrainingConfig) -> TrainingConfig:
    """Replaces the recurrent head by that of DKM, with the same width."""
    hidden = 4096 if config.network.encoder == "resnet18" else 256
    return _network(head="connected", hidden=hidden)(config)


def no_trail(config: TrainingConfig) -> TrainingConfig:
    """Replaces the view by the one that does not show a target's own past.

    Raises:
        AspEnvError: There is no such view.
    """
    view = f"{config.view}-no-trail"
    if view not in view_names():
        raise unknown_name("view", view, view_names())
    return dataclasses.replace(config, view=view)


def causal(config: TrainingConfig) -> TrainingConfig:
    """Filters histories without later frames."""
    return dataclasses.replace(config, history="causal")


def long(config: TrainingConfig) -> TrainingConfig:
    """Multiplies the number of epochs by three."""
    return dataclasses.replace(
        config, epochs=3 * config.epochs, pretraining_epochs=3 * config.pretraining_epochs
    )


def no_pretraining(config: TrainingConfig) -> TrainingConfig:
    """Replaces pre-training by epochs of full training."""
    return dataclasses.replace(config, pretraining_epochs=0, epochs=config.all_epochs)


def all_epochs(config: TrainingConfig) -> TrainingConfig:
    """Adds the epochs of a run for 3 s, for a run that does not start from one."""
    first, own = _epochs(config, SEGMENT_S), _epochs(config, config.horizon_s)
    return _scaled(config, (first + own) / own)


def second_stage(config: TrainingConfig) -> TrainingConfig:
    """Trains as many epochs as a run for 3 s, for a run that starts from one."""
    return _scaled(config, _epochs(config, SEGMENT_S) / _epochs(config, config.horizon_s))


def _epochs(config: TrainingConfig, horizon_s: float) -> int:
    """Number of epochs of the recipe."""
    return recipe(config.predictor, config.preset, view=config.view, horizon_s=horizon_s).all_epochs


def _scaled(config: TrainingConfig, factor: float) -> TrainingConfig:
    """Multiplies the epochs, which may differ from the recipe's."""
    return dataclasses.replace(config, epochs=max(1, round(factor * config.epochs)))


_COMMON = {
    "no-trail": Variant(change=no_trail),
    "causal": Variant(change=causal),
    "long": Variant(change=long),
    "annealed": Variant(change=_network(annealed=True)),
}
_ACTION_SPACE = _COMMON | {
    "euler": Variant(change=_network(integrator="euler")),
    "literal-classification": Variant(change=_network(classification="softmax")),
}

_STAGED = {"staged": Variant(change=second_stage, horizons_s=(6.0,), warm_starts_from_3s=True)}

VARIANTS: Mapping[str, Mapping[str, Variant]] = MappingProxyType(
    {
        "mtp": _COMMON | _STAGED,
        "dkm": _ACTION_SPACE | _STAGED,
        "ffw-asp": _ACTION_SPACE
        | _STAGED
        | {
            "connected-head": Variant(change=connected_head),
            "skip": Variant(change=_network(skip=True)),
        },
        "ssp-asp": _ACTION_SPACE
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
                change=_sequence(
                    _network(feature_weight=0.0, action_weight=0.0, encoded_branch=False),
                    no_pretraining,
                )
            ),
            "scheduled": Variant(change=_network(scheduled=True), horizons_s=(6.0,)),
        },
    }
)
"""Variants by predictor and name."""


def variant(predictor: str, name: str) -> Variant:
    """The variant of a predictor.

    Raises:
        AspEnvError: The name is unknown (known ones are listed).
    """
    variants = VARIANTS.get(predictor, {})
    if name not in variants:
        raise unknown_name(f"variant of {predictor}", name, variants)
    return variants[name]


def warm_starts_from_3s(predictor: str, name: str | None = None) -> bool:
    """Whether a run for more than 3 s starts from the weights of a run for 3 s.

    Args:
        predictor: Name of the predictor.
        name: Name of a variant; None for the recipe.

    Raises:
        AspEnvError: The predictor has no such variant.
    """
    own = None if name is None else variant(predictor, name).warm_starts_from_3s
    return predictor in CHAINED if own is None else own
