"""A program that trains a tiny network with others like it and keeps what each process ends with.

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
from predictors.training.lightning_parts import EpochLogger, Fit
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
    """Trains, or dies after an epoch; `rank-N.safetensors` beside `out` is what process N has.

    `backend` is what compiles in place of the usual one, which takes half a minute.
    """

    def keep(self: Fit) -> None:
        path = out.with_name(f"rank-{self.trainer.global_rank}.safetensors")
        save_weights(self.network.state_dict(), path)

    def die(self: EpochLogger, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        del self, pl_module
        if trainer.current_epoch == die_after:
            os._exit(9)

    Fit.on_train_end = keep
    if backend is not None:
        usual = nn.Module.compile

        def traced(self: nn.Module, *args: Any, **options: Any) -> None:
            usual(self, *args, backend=backend, **options)

        nn.Module.compile = traced
    if die_after is not None:
        EpochLogger.on_train_epoch_end = die
    train(tiny_config(predictor, view, **changes), data, out, hardware=Hardware(**hardware))


if __name__ == "__main__":
    told = json.loads(sys.argv[1])
    run(data=told.pop("data"), out=Path(told.pop("out")), **told)
