"""A program that trains a tiny network in several processes and stores the weights of each.

Lightning starts it again for every further device, so it cannot be the test run itself.
"""

import json
import os
import sys
from pathlib import Path
from typing import Any

import lightning.pytorch as pl
from torch import nn

from predictors.inference.checkpoint import save_weights
from predictors.training.fitting import train
from predictors.training.lightning_parts import EpochLogger, TrainingModule
from predictors.training.trainer import Hardware
from tests.predictors.tiny import tiny_config


def run(
    *,
    predictor: str,
    view: str,
    data: str,
    out: Path,
    changes: dict[str, Any],
    hardware: dict[str, Any],
    die_after: int | None,
    backend: str | None,
) -> None:
    """Trains; writes the final weights of process N to `rank-N.safetensors` beside `out`.

    Args:
        predictor: Name of the predictor.
        view: Name of the view.
        data: DATA.
        out: The run's folder.
        changes: Changes of the configuration.
        hardware: Fields of `Hardware`.
        die_after: Index of the epoch after which the process exits; None for never.
        backend: Backend of `torch.compile` instead of the default, which takes half a minute.
    """

    def store_weights(self: TrainingModule) -> None:
        path = out.with_name(f"rank-{self.trainer.global_rank}.safetensors")
        save_weights(self.network.state_dict(), path)

    def die(self: EpochLogger, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        del self, pl_module
        if trainer.current_epoch == die_after:
            os._exit(9)

    TrainingModule.on_train_end = store_weights
    if backend is not None:
        default = nn.Module.compile

        def compile_with_backend(self: nn.Module, *args: Any, **options: Any) -> None:
            default(self, *args, backend=backend, **options)

        nn.Module.compile = compile_with_backend
    if die_after is not None:
        EpochLogger.on_train_epoch_end = die
    train(tiny_config(predictor, view, **changes), data, out, hardware=Hardware(**hardware))


if __name__ == "__main__":
    given = json.loads(sys.argv[1])
    run(data=given.pop("data"), out=Path(given.pop("out")), **given)
