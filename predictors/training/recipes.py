"""Runs as functions: each gives a whole configuration; variants change fields of another."""

import dataclasses
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Literal

from asp_env.data.recording import DEFAULT_DT_S
from asp_env.data.split import Split
from asp_env.errors import AspEnvError, unknown_name
from predictors.models.dkm import DKMConfig
from predictors.models.ffw_asp import FFWASPConfig
from predictors.models.mtp import MTPConfig
from predictors.models.network import NetworkConfig
from predictors.models.ssp_asp import SSPASPConfig

SEGMENT_S = 3.0
"""How much a predictor that chains segments forecasts at once."""

CHAINED = frozenset({"ssp-asp"})
"""Predictors whose runs for longer horizons go on from the weights of a run for one segment, as in
the paper; the others predict any horizon at once and learn it from the start."""


@dataclass(frozen=True, slots=True, kw_only=True)
class TrainingConfig:
    """Everything that decides the weights, but the data's content."""

    predictor: str
    preset: str
    """Name of the recipe that it comes from; tables show it."""
    network: NetworkConfig
    view: str
    pixels: tuple[int, int] | None
    """Height and width of pictures; None for a view that draws none."""
    horizon_s: float
    dt_s: float = DEFAULT_DT_S
    split: Split = "recording"
    validation: str | None = None
    """Other data to select on; all of DATA is learned from then."""
    history: Literal["recorded", "causal"] = "recorded"
    """Whether histories are as recorded, smoothed with what came after, or filtered forward."""
    seed: int = 0
    max_snippets: int | None = None
    """Training snippets to keep at most, at random; None keeps all."""
    max_validation_snippets: int | None = None
    standing_share: float = 1.0
    """Standing targets are at most this share of the training snippets."""
    epochs: int = 10
    pretraining_epochs: int = 0
    """Before those: epochs in which ssp-asp learns its features alone."""
    snippets_per_epoch: int | None = None
    """At most; None shows all of them in every epoch. Bounds the time of a run on much data."""
    batch_size: int = 32
    learning_rate: float = 1e-4
    weight_decay: float = 0.0
    schedule: Literal["plateau", "one-cycle"] = "plateau"
    """`plateau` divides the learning rate by 5 after 3 epochs without improvement; `one-cycle`
    raises it over the first tenth of all steps and lowers it along a cosine to zero."""
    precision: Literal["32-true", "bf16-mixed"] = "32-true"
    """Of the encoder; all that follows it is always float32."""
    threads: int | None = None
    """Threads of torch within one operation; None leaves its own choice."""

    def __post_init__(self) -> None:
        """Checks the numbers.

        Raises:
            AspEnvError: one is out of its range.
        """
        for field in (
            "epochs",
            "batch_size",
            "snippets_per_epoch",
            "max_snippets",
            "max_validation_snippets",
            "threads",
        ):
            value = getattr(self, field)
            if value is not None and value < 1:
                raise AspEnvError(f"training: {field} is {value}, expected 1 or more")
        if self.pretraining_epochs < 0:
            raise AspEnvError(
                f"training: pretraining_epochs is {self.pretraining_epochs}, expected 0 or more"
            )
        if not 0 < self.standing_share <= 1:
            raise AspEnvError(
                f"training: standing_share is {self.standing_share}, expected within (0, 1]"
            )

    @property
    def all_epochs(self) -> int:
        """Those of pre-training and those after it."""
        return self.pretraining_epochs + self.epochs


def _paper(predictor: str, network: NetworkConfig, view: str, horizon_s: float) -> TrainingConfig:
    """The schedule of the paper at full size: Adam at 1e-4, batches of 32, 10 epochs."""
    if view.startswith("vectors"):
        network = dataclasses.replace(network, encoder="vector")
    return TrainingConfig(
        predictor=predictor,
        preset="paper",
        network=network,
        view=view,
        pixels=None,
        horizon_s=horizon_s,
    )


def _small(
    predictor: str, preset: str, network: NetworkConfig, view: str, horizon_s: float
) -> TrainingConfig:
    """Minutes on two cores: pictures of a quarter of the resolution, a small encoder, one cycle.

    A longer horizon takes as many epochs again: after those for 3 s, where a predictor chains
    segments, or in one go.
    """
    at_once = horizon_s > SEGMENT_S and predictor not in CHAINED
    vectors = view.startswith("vectors")
    pixels = (90, 90) if view == "mtp" else (90, 60)
    network = dataclasses.replace(network, encoder="vector" if vectors else "small", features=256)
    return TrainingConfig(
        predictor=predictor,
        preset=preset,
        network=network,
        view=view,
        pixels=None if vectors else pixels,
        horizon_s=horizon_s,
        standing_share=0.25,
        epochs=16 if at_once else 8,
        snippets_per_epoch=6_000,
        max_validation_snippets=2_000,
        batch_size=64,
        learning_rate=1e-3,
        weight_decay=1e-2,
        schedule="one-cycle",
        precision="32-true" if vectors else "bf16-mixed",
        threads=1,
    )


def mtp_paper(view: str, horizon_s: float) -> TrainingConfig:
    """Of the paper's references: state to positions."""
    return _paper("mtp", MTPConfig(), view, horizon_s)


def mtp_cpu(view: str, horizon_s: float) -> TrainingConfig:
    """The same structure, small."""
    return _small("mtp", "cpu", MTPConfig(hidden=256), view, horizon_s)


def dkm_paper(view: str, horizon_s: float) -> TrainingConfig:
    """What the paper compares with: state to actions."""
    return _paper("dkm", DKMConfig(), view, horizon_s)


def dkm_cpu(view: str, horizon_s: float) -> TrainingConfig:
    """The same structure, small, under Heun."""
    return _small("dkm", "cpu", DKMConfig(hidden=256, integrator="heun"), view, horizon_s)


def ffw_asp_paper(view: str, horizon_s: float) -> TrainingConfig:
    """The paper's feed-forward network; 6 s are predicted at once."""
    return _paper("ffw-asp", FFWASPConfig(), view, horizon_s)


def ffw_asp_cpu(view: str, horizon_s: float) -> TrainingConfig:
    """The same structure, small, under Heun."""
    network = FFWASPConfig(gru_width=128, integrator="heun")
    return _small("ffw-asp", "cpu", network, view, horizon_s)


def ffw_asp_ours(view: str, horizon_s: float) -> TrainingConfig:
    """Small, with what the ablations taught: features and actions skip past the recurrent head."""
    network = FFWASPConfig(
        gru_width=128, gru_layers=1, skip=True, hidden=256, integrator="heun", assignment="distance"
    )
    config = _small("ffw-asp", "ours", network, view, horizon_s)
    return dataclasses.replace(
        config, standing_share=0.5, snippets_per_epoch=15_000, learning_rate=4e-3
    )


def ssp_asp_paper(view: str, horizon_s: float) -> TrainingConfig:
    """The paper's self-supervised network, with three epochs of forward-model pre-training."""
    _check_segments(horizon_s)
    config = _paper("ssp-asp", SSPASPConfig(), view, horizon_s)
    return _pretrained(config, horizon_s, 3, of=config.epochs + 3)


def ssp_asp_cpu(view: str, horizon_s: float) -> TrainingConfig:
    """The same structure, small, under Heun; pre-training takes two of the eight epochs."""
    _check_segments(horizon_s)
    network = SSPASPConfig(gru_width=128, integrator="heun")
    config = _small("ssp-asp", "cpu", network, view, horizon_s)
    return _pretrained(config, horizon_s, 2, of=config.epochs)


def ssp_asp_ours(view: str, horizon_s: float) -> TrainingConfig:
    """Small, with what the ablations taught.

    Annealed modes hold apart what the best mode alone lets collapse; a run that goes on from one
    that had them keeps them as they are. Chains that run near each other speak for each other.
    """
    _check_segments(horizon_s)
    network = SSPASPConfig(
        gru_width=128,
        gru_layers=1,
        skip=True,
        hidden=256,
        integrator="heun",
        assignment="distance",
        annealed=horizon_s <= SEGMENT_S,
        kept=3,
        spread_mps=0.8,
        normalise=True,
        stop_gradient=True,
        scheduled=True,
    )
    return _small("ssp-asp", "ours", network, view, horizon_s)


def _check_segments(horizon_s: float) -> None:
    """Refuses, before anything is trained, what cannot be chained."""
    if horizon_s < SEGMENT_S or abs(horizon_s / SEGMENT_S - round(horizon_s / SEGMENT_S)) > 1e-6:
        raise AspEnvError(
            f"ssp-asp chains segments of {SEGMENT_S:g} s, the horizon of {horizon_s:g} s is no "
            "whole number of them: give 3, 6 or 9"
        )


def _pretrained(
    config: TrainingConfig, horizon_s: float, epochs: int, *, of: int
) -> TrainingConfig:
    """With pre-training, where the run does not go on from one that had it."""
    if horizon_s > SEGMENT_S:
        return config
    return dataclasses.replace(config, pretraining_epochs=epochs, epochs=of - epochs)


Recipe = Callable[[str, float], TrainingConfig]

RECIPES: Mapping[str, Mapping[str, Recipe]] = MappingProxyType(
    {
        "mtp": {"cpu": mtp_cpu, "paper": mtp_paper},
        "dkm": {"cpu": dkm_cpu, "paper": dkm_paper},
        "ffw-asp": {"cpu": ffw_asp_cpu, "paper": ffw_asp_paper, "ours": ffw_asp_ours},
        "ssp-asp": {"cpu": ssp_asp_cpu, "paper": ssp_asp_paper, "ours": ssp_asp_ours},
    }
)
"""Of (view, horizon in seconds), by predictor and preset."""


def recipe(predictor: str, preset: str, *, view: str, horizon_s: float) -> TrainingConfig:
    """The configuration of a predictor's preset.

    Raises:
        AspEnvError: there is none; those that there are get listed.
    """
    if predictor not in RECIPES:
        raise unknown_name("trainable predictor", predictor, RECIPES)
    presets = RECIPES[predictor]
    if preset not in presets:
        raise unknown_name(f"preset of {predictor}", preset, presets)
    return presets[preset](view, horizon_s)
