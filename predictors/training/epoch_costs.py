"""The CPU time of an epoch, measured on a few batches for the budget `cpu`.

The process's CPU time counts, so that other programs matter little; data loading in its thread is
part of it. Rounds over all configurations alternate and the lowest time of each counts, since a
busy machine only ever adds time.
"""

import dataclasses
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, final

import lightning.pytorch as pl
import numpy as np
import torch

from asp_env import registry
from asp_env.data.recording import ticks
from asp_env.dynamics import MAX_ACCELERATION_MPS2, MAX_STEERING_RAD
from asp_env.views import make_view, with_history
from predictors.inference.checkpoint import PredictorSpec, shape_for
from predictors.training.budgets import EpochCost
from predictors.training.data import VALIDATION_BATCH, TrainingData, open_training_data
from predictors.training.data_loading import PREFETCH
from predictors.training.lightning_parts import TrainingModule
from predictors.training.recipes import TrainingConfig
from predictors.training.trainer import Hardware, make_trainer, quiet, threads

ROUNDS = 3
"""Rounds over all configurations. Chosen by hand."""

WARM_UP_BATCHES = 4
"""Batches at the start that do not count: they allocate memory and compile. Chosen by hand."""

MEASURED_BATCHES = 12
"""Batches that count in each round. Chosen by hand: they take seconds at small size."""

VALIDATION_BATCHES = 2
"""Validation batches that are measured in each round. Chosen by hand."""


def measure_epochs(configs: Sequence[TrainingConfig], data: str | Sequence[str]) -> list[EpochCost]:
    """Measures the CPU time of one epoch of each configuration.

    Args:
        configs: The configurations.
        data: One or several DATA, as `open_data` takes them.

    Raises:
        AspEnvError: The data are bad.
    """
    opened: dict[str, TrainingData] = {}
    for config in configs:
        if (key := _data_key(config)) not in opened:
            opened[key] = open_training_data(config, data)
    rounds = [
        [_measure(config, opened[_data_key(config)]) for config in configs] for _ in range(ROUNDS)
    ]
    return [EpochCost(*np.min(costs, axis=0).tolist()) for costs in zip(*rounds, strict=True)]


def _data_key(config: TrainingConfig) -> str:
    """Equal for configurations that take the same snippets from the data."""
    others = {
        *("predictor", "preset", "network", "view", "pixels", "precision", "batch_size"),
        *("epochs", "pretraining_epochs", "snippets_per_epoch", "learning_rate", "schedule"),
    }
    fields = dataclasses.asdict(config)
    return repr({name: value for name, value in fields.items() if name not in others})


def _measure(config: TrainingConfig, data: TrainingData) -> tuple[float, float]:
    """CPU time of a prediction epoch and of an epoch of pre-training, seconds, in one round."""
    spec: PredictorSpec = registry.find("predictors", config.predictor)
    history = ticks(config.history_s, config.dt_s)
    view = with_history(make_view(config.view, pixels=config.pixels), history)
    snippets = data.training.snippets
    shape = shape_for(
        view,
        history=history,
        horizon=snippets.horizon_ticks,
        dt_s=config.dt_s,
        action_range=(MAX_ACCELERATION_MPS2, MAX_STEERING_RAD),
    )
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(config.seed)
        network = spec.network(config.network, shape)
    batches = WARM_UP_BATCHES + MEASURED_BATCHES + PREFETCH
    short = dataclasses.replace(
        config,
        epochs=1,
        pretraining_epochs=min(1, config.pretraining_epochs),
        snippets_per_epoch=batches * config.batch_size,
    )
    training, validation = (
        split.batches(view, size=size, later_ticks=network.later_ticks, config=config)
        for split, size in (
            (data.training, config.batch_size),
            (data.validation, VALIDATION_BATCH),
        )
    )
    count = len(validation.snippets)
    measured = min(count, VALIDATION_BATCHES * VALIDATION_BATCH)
    validation = validation.reordered(np.arange(measured))
    module = TrainingModule(network, config=short, training=training, validation=validation)
    clock = _Clock()
    # Without logs nothing is written.
    trainer = make_trainer(
        short, Hardware(), out=Path(), started="costs", callbacks=[clock], shown=False
    )
    with quiet(), threads(config.threads):
        trainer.fit(module)
    per_epoch = min(config.snippets_per_epoch or len(snippets), len(snippets))
    steps = -(-per_epoch // config.batch_size)
    validating_s = clock.validation_s[-1] * count / measured
    costs = [steps * _per_batch_s(times) + validating_s for times in clock.batch_times_s]
    return costs[-1], costs[0] if config.pretraining_epochs else 0.0


def _per_batch_s(times_s: Sequence[float]) -> float:
    """Mean time of a batch, without the first ones and those at the end that are loaded before.

    Args:
        times_s: CPU time at the start of the epoch and at the end of each batch.
    """
    last = len(times_s) - 1
    first = min(WARM_UP_BATCHES, last // 2)
    last -= min(PREFETCH, (last - first) // 2)
    return (times_s[last] - times_s[first]) / (last - first)


@final
class _Clock(pl.Callback):
    """Reads the process's CPU time between batches."""

    def __init__(self) -> None:
        self.batch_times_s: list[list[float]] = []
        """CPU time at the start of each epoch and at the end of each of its batches."""
        self.validation_s: list[float] = []
        """CPU time of the validation of each epoch."""
        self._start_s = 0.0

    def on_train_epoch_start(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        del trainer, pl_module
        self.batch_times_s.append([time.process_time()])

    def on_train_batch_end(self, *args: Any, **kwargs: Any) -> None:
        del args, kwargs
        self.batch_times_s[-1].append(time.process_time())

    def on_validation_start(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        del trainer, pl_module
        self._start_s = time.process_time()

    def on_validation_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        del trainer, pl_module
        self.validation_s.append(time.process_time() - self._start_s)
