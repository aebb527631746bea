"""Variants of recipes, for ablations: named changes of a configuration.

A variant has as many prediction epochs in total as its recipe, including those of the run that it
starts from. The exceptions are `long`, and `staged` of the recipe `paper`. Pre-training is
additional: `no-pretraining` omits it, and `long` does not repeat it.
"""

import dataclasses
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

from asp_env.errors import AspEnvError, unknown_name
from asp_env.views import view_names
from predictors.models.losses import Assignment
from predictors.training.recipes import (
    CHAINED,
    SEGMENT_S,
    SHORT_SEGMENT_SHARE,
    Budget,
    TrainingConfig,
    recipe,
)

Change = Callable[[TrainingConfig], TrainingConfig]


@dataclass(frozen=True, slots=True, kw_only=True)
class Variant:
    """A change of a recipe."""

    change: Change
    horizons_s: tuple[float, ...] = (SEGMENT_S,)
    """The horizons for which it is an ablation, seconds."""
    warm_starts_from_3s: bool | None = None
    """Whether a longer run starts from the weights of a run for one segment, or 3 s; None for what
    the predictor's recipe does."""
    segment_s: float | None = None
    """Length of the segments that are chained, seconds; None for the recipe's."""

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


def segments(segment_s: float, horizons_s: tuple[float, ...]) -> Variant:
    """A variant with segments of another length.

    Its runs have as many prediction epochs in total as those of the recipe, for every horizon. With
    segments shorter than 3 s half of those for 3 s (`SHORT_SEGMENT_SHARE`) are those of the run for
    one segment, which longer runs start from; with longer ones there is no such run. The
    pre-training is additional and comes before the run for one segment.

    Args:
        segment_s: Length of a segment, seconds.
        horizons_s: The horizons, each a whole number of segments.
    """

    def change(config: TrainingConfig) -> TrainingConfig:
        def epochs(horizon_s: float, length_s: float | None = None) -> int:
            return recipe(
                config.predictor,
                config.preset,
                view=config.view,
                horizon_s=horizon_s,
                segment_s=length_s,
            ).epochs

        whole = epochs(SEGMENT_S)
        shared = SHORT_SEGMENT_SHARE * whole if segment_s < SEGMENT_S else 0.0
        if config.horizon_s > SEGMENT_S:
            whole += epochs(config.horizon_s)
        own = shared if config.horizon_s < SEGMENT_S else whole - shared
        return _scaled(config, own / epochs(config.horizon_s, segment_s))

    return Variant(change=change, horizons_s=horizons_s, segment_s=segment_s)


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
    """Multiplies the number of prediction epochs by three."""
    return dataclasses.replace(config, epochs=3 * config.epochs)


def no_pretraining(config: TrainingConfig) -> TrainingConfig:
    """Omits the pre-training; the prediction epochs stay."""
    return dataclasses.replace(config, pretraining_epochs=0)


def both_stages(config: TrainingConfig) -> TrainingConfig:
    """Adds the pre-training and the epochs of the first stage, for a run that has none."""
    first, own = _recipe(config, config.first_stage_s), _recipe(config, config.horizon_s)
    scaled = _scaled(config, (first.epochs + own.epochs) / own.epochs)
    return dataclasses.replace(scaled, pretraining_epochs=first.pretraining_epochs)


def second_stage(config: TrainingConfig) -> TrainingConfig:
    """Trains as many epochs as a run for 3 s, for a run that starts from one."""
    first, own = _recipe(config, SEGMENT_S), _recipe(config, config.horizon_s)
    return _scaled(config, first.epochs / own.epochs)


def _recipe(config: TrainingConfig, horizon_s: float) -> TrainingConfig:
    """The unchanged recipe for a horizon."""
    return recipe(
        config.predictor,
        config.preset,
        view=config.view,
        horizon_s=horizon_s,
        segment_s=config.segment_s,
    )


def _scaled(config: TrainingConfig, factor: float) -> TrainingConfig:
    """Multiplies the epochs, which may differ from the recipe's."""
    return dataclasses.replace(config, epochs=max(1, round(factor * config.epochs)))


def _assigned(assignment: Assignment) -> Change:
    """Changes how the best mode of a label is chosen.

    The change raises an `AspEnvError` if the recipe chooses in this way.
    """

    def change(config: TrainingConfig) -> TrainingConfig:
        if config.network.assignment == assignment:
            raise AspEnvError(
                f"the recipe {config.preset} of {config.predictor} has the assignment "
                f"{assignment!r} without a variant: leave the variant out"
            )
        return _network(assignment=assignment)(config)

    return change


ASSIGNMENTS: Mapping[str, Assignment] = MappingProxyType(
    {"nearest": "angle", "distance": "distance", "angle-random": "angle-random"}
)
"""The variants of the rule by which a mode learns, see `predictors.models.losses`.

`nearest` is the paper's text: the mode with the lowest mean distance among those within 5° of the
label's end, of all modes where there is none. `angle-random` is the published code of MTP, which
draws a random mode there. `distance` ignores the angle.
"""

_COMMON = {
    "no-trail": Variant(change=no_trail),
    "causal": Variant(change=causal),
    "long": Variant(change=long),
    "annealed": Variant(change=_network(annealed=True)),
    **{name: Variant(change=_assigned(rule)) for name, rule in ASSIGNMENTS.items()},
}
_ACTION_SPACE = _COMMON | {
    "euler": Variant(change=_network(integrator="euler")),
    "literal-classification": Variant(change=_network(classification="softmax")),
}

_UNROLLED = {"unrolled": Variant(change=_network(decoder="unrolled"), horizons_s=(SEGMENT_S, 6.0))}

_SEGMENTS = {
    "segment-0.6s": segments(0.6, (3.0, 6.0)),
    "segment-1s": segments(1.0, (3.0, 6.0, 9.0, 12.0)),
    "segment-1.2s": segments(1.2, (6.0, 12.0)),
    "segment-2s": segments(2.0, (6.0, 12.0)),
    "segment-6s": segments(6.0, (6.0,)),
}
"""Lengths that are whole numbers of ticks of 0.2 s and divide the horizons; that of the recipes is
3 s. 1.5 s are 7.5 ticks."""

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
        }
        | _UNROLLED,
        "ssp-asp": _ACTION_SPACE
        | {
            "skip": Variant(change=_network(skip=True)),
            "no-pretraining": Variant(change=no_pretraining),
            "from-scratch": Variant(
                change=both_stages, horizons_s=(6.0,), warm_starts_from_3s=False
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
        }
        | _UNROLLED
        | _SEGMENTS,
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


def ablations(predictor: str, recipe_name: str, *, budget: Budget = "epochs") -> dict[str, Variant]:
    """The variants that differ from a recipe under a budget.

    The recipe's own assignment is not among them, nor is `long` where the budget sets the number of
    epochs.

    Args:
        predictor: Name of the predictor.
        recipe_name: Name of the recipe.
        budget: What the number of epochs follows from.

    Raises:
        AspEnvError: The predictor has no such recipe.
    """
    own = recipe(predictor, recipe_name, view="vectors", horizon_s=SEGMENT_S).network.assignment
    omitted = {name for name, rule in ASSIGNMENTS.items() if rule == own}
    if budget != "epochs":
        omitted.add("long")
    variants = VARIANTS.get(predictor, {})
    return {name: each for name, each in variants.items() if name not in omitted}


def warm_starts_from_3s(predictor: str, name: str | None = None) -> bool:
    """Whether a longer run starts from the weights of a run for one segment, or 3 s.

    Args:
        predictor: Name of the predictor.
        name: Name of a variant; None for the recipe.

    Raises:
        AspEnvError: The predictor has no such variant.
    """
    own = None if name is None else variant(predictor, name).warm_starts_from_3s
    return predictor in CHAINED if own is None else own
