"""Training with Lightning: recipes and variants, data, runs, and the command `asp-env train`.

The names are imported on first access, so that the command needs no torch before it runs.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from predictors.training.data import Batches, DatasetSplit, TrainingData, open_training_data
    from predictors.training.data_loading import BatchSource, BatchWorkers, batch_workers
    from predictors.training.fitting import train, train_stages
    from predictors.training.initial_weights import InitialWeights
    from predictors.training.lightning_parts import BestCheckpoint, EpochLogger, TrainingModule
    from predictors.training.recipes import RECIPES, TrainingConfig, recipe
    from predictors.training.trainer import Hardware, make_trainer
    from predictors.training.variants import VARIANTS, Variant, variant, warm_starts_from_3s

__all__ = [
    "RECIPES",
    "VARIANTS",
    "BatchSource",
    "BatchWorkers",
    "Batches",
    "BestCheckpoint",
    "DatasetSplit",
    "EpochLogger",
    "Hardware",
    "InitialWeights",
    "TrainingConfig",
    "TrainingData",
    "TrainingModule",
    "Variant",
    "batch_workers",
    "make_trainer",
    "open_training_data",
    "recipe",
    "train",
    "train_stages",
    "variant",
    "warm_starts_from_3s",
]

_MODULES = {
    "data": ("Batches", "DatasetSplit", "TrainingData", "open_training_data"),
    "data_loading": ("BatchSource", "BatchWorkers", "batch_workers"),
    "fitting": ("train", "train_stages"),
    "initial_weights": ("InitialWeights",),
    "lightning_parts": ("BestCheckpoint", "EpochLogger", "TrainingModule"),
    "recipes": ("RECIPES", "TrainingConfig", "recipe"),
    "trainer": ("Hardware", "make_trainer"),
    "variants": ("VARIANTS", "Variant", "variant", "warm_starts_from_3s"),
}


def __getattr__(name: str) -> Any:
    for module, names in _MODULES.items():
        if name in names:
            return getattr(import_module(f"{__name__}.{module}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
