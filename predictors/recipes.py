"""Runs as functions: each gives a whole configuration; variants change fields of another."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

from asp_env.data.clock import DEFAULT_DT_S
from asp_env.data.parts import Split
from asp_env.errors import AspEnvError, unknown_name
from predictors.ffw_asp import FFWASPConfig

NetworkConfig = FFWASPConfig


@dataclass(frozen=True, slots=True, kw_only=True)
class TrainingConfig:
    """Everything that decides the weights, but the data's content."""

    predictor: str
    preset: str
    """Name of the recipe that it comes from; tables show it."""
    network: NetworkConfig
    view: str
    height_px: int
    width_px: int
    horizon_s: float
    dt_s: float = DEFAULT_DT_S
    split: Split = "recording"
    seed: int = 0
    max_snippets: int | None = None
    """Training snippets to keep at most, at random; None keeps all."""
    max_validation_snippets: int | None = None
    standing_share: float = 1.0
    """Standing targets are at most this share of the training snippets."""
    epochs: int = 10
    snippets_per_epoch: int | None = None
    """At most; None shows all of them in every epoch. Bounds the time of a run on much data."""
    batch_size: int = 32
    learning_rate: float = 1e-4
    weight_decay: float = 0.0
    schedule: Literal["plateau", "one-cycle"] = "plateau"
    """`plateau` divides the learning rate by 5 after 3 epochs without improvement; `one-cycle`
    raises it over the first tenth of all steps and lowers it along a cosine to zero."""
    precision: Literal["32-true", "bf16-mixed"] = "32-true"
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
        if not 0 < self.standing_share <= 1:
            raise AspEnvError(
                f"training: standing_share is {self.standing_share}, expected within (0, 1]"
            )


def ffw_asp_paper(*, view: str, horizon_s: float) -> TrainingConfig:
    """asp-env train ffw-asp DATA --preset paper: the network and schedule of the paper."""
    return TrainingConfig(
        predictor="ffw-asp",
        preset="paper",
        network=FFWASPConfig(),
        view=view,
        height_px=360,
        width_px=240,
        horizon_s=horizon_s,
    )


def ffw_asp_cpu(*, view: str, horizon_s: float) -> TrainingConfig:
    """asp-env train ffw-asp DATA --preset cpu: minutes on two cores."""
    return TrainingConfig(
        predictor="ffw-asp",
        preset="cpu",
        network=FFWASPConfig(
            encoder="small",
            features=256,
            gru_width=128,
            gru_layers=1,
            skip=True,
            hidden=256,
            integrator="heun",
            assignment="distance",
        ),
        view=view,
        height_px=90,
        width_px=60,
        horizon_s=horizon_s,
        standing_share=0.5,
        epochs=8,
        snippets_per_epoch=15_000,
        max_validation_snippets=2_000,
        batch_size=64,
        learning_rate=4e-3,
        weight_decay=1e-2,
        schedule="one-cycle",
        precision="bf16-mixed",
        threads=1,
    )


RECIPES: dict[str, dict[str, Callable[..., TrainingConfig]]] = {
    "ffw-asp": {"cpu": ffw_asp_cpu, "paper": ffw_asp_paper},
}
"""Recipes by predictor and preset."""


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
    return presets[preset](view=view, horizon_s=horizon_s)
