"""Training rate on a GPU at full size: `python -m tests.benchmarks.gpu_rate`.

Trains ssp-asp by the recipe `paper` on 12x360x240 rasters for one epoch of Lightning's loop, with
each precision and with batches that a thread or processes load. The waiting time of the GPU is the
time between the end of a step and the arrival of the next batch, measured by CUDA events.
"""

import dataclasses
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import lightning.pytorch as pl
import numpy as np
import torch
import tyro
from rich.console import Console
from rich.table import Table

from asp_env import registry
from asp_env.data.snippets import index_snippets
from asp_env.data.source import open_data
from asp_env.views import make_view
from predictors.inference.checkpoint import PredictorSpec, shape_for
from predictors.training.data import Batches
from predictors.training.data_loading import batch_workers
from predictors.training.lightning_parts import TrainingModule
from predictors.training.recipes import TrainingConfig, recipe
from predictors.training.trainer import Hardware, make_trainer, quiet

WARM_UP = 20
"""Steps that are not measured."""


class StepTimer(pl.Callback):
    """Records when the batch of each step arrives and when the step ends."""

    def __init__(self) -> None:
        self.starts: list[Any] = []
        self.ends: list[Any] = []

    def on_train_batch_start(self, *args: Any, **kwargs: Any) -> None:
        """Follows the copy of the batch in the CUDA stream."""
        del args, kwargs
        self.starts.append(_now())

    def on_train_batch_end(self, *args: Any, **kwargs: Any) -> None:
        """Follows the work of the step in the CUDA stream."""
        del args, kwargs
        self.ends.append(_now())

    def means_s(self) -> tuple[float, float]:
        """Mean duration of a step and of the waiting in it after the warm-up, s."""
        if torch.cuda.is_available():
            torch.cuda.synchronize()
        starts, ends = self.starts[WARM_UP:], self.ends[WARM_UP:]
        waits = [_seconds(*pair) for pair in zip(ends[:-1], starts[1:], strict=True)]
        return _seconds(ends[0], ends[-1]) / len(waits), float(np.mean(waits))


def _now() -> Any:
    if not torch.cuda.is_available():
        return time.perf_counter()
    event = torch.cuda.Event(enable_timing=True)
    event.record()
    return event


def _seconds(first: Any, last: Any) -> float:
    return first.elapsed_time(last) / 1e3 if torch.cuda.is_available() else last - first


@dataclass(frozen=True, slots=True, kw_only=True)
class GpuRate:
    """Measure the training rate for each precision and number of workers."""

    data: Annotated[str, tyro.conf.Positional] = "sample:intersection"
    """DATA to train on."""
    predictor: str = "ssp-asp"
    """The predictor."""
    view: str = "chauffeurnet"
    """The view of the predictor."""
    recipe: str = "paper"
    """How the predictor is trained."""
    precisions: tuple[Literal["32-true", "bf16-mixed"], ...] = ("32-true", "bf16-mixed")
    """Precisions of the encoder."""
    num_workers: tuple[int, ...] = (0, 4)
    """Numbers of processes that load batches; 0 stands for a thread."""
    batch_size: int = 32
    """Snippets per batch."""
    steps: int = 120
    """Steps of each trial, warm-up included."""

    def run(self) -> None:
        """Runs all trials and prints a table."""
        torch.set_num_threads(1)
        device = torch.cuda.get_device_name() if torch.cuda.is_available() else "CPU"
        table = Table(
            "precision", "loaded by", "samples/s", "ms per step", "waiting",
            title=f"{self.predictor} {self.recipe} {self.view} on {device}",
        )  # fmt: skip
        for precision in self.precisions:
            for processes in self.num_workers:
                step_s, waiting_s = self._trial(precision, processes)
                table.add_row(
                    precision,
                    f"{processes} processes" if processes else "a thread",
                    f"{self.batch_size / step_s:,.0f}",
                    f"{1e3 * step_s:.1f}",
                    f"{waiting_s / step_s:.1%}",
                )
        Console().print(table)

    def _trial(self, precision: Any, processes: int) -> tuple[float, float]:
        config = recipe(self.predictor, self.recipe, view=self.view, horizon_s=3.0)
        config = dataclasses.replace(
            config,
            precision=precision,
            batch_size=self.batch_size,
            epochs=1,
            pretraining_epochs=0,
        )
        training, validation, network = self._parts(config)
        timer = StepTimer()
        with (
            tempfile.TemporaryDirectory() as out,
            batch_workers([training.source], processes) as crew,
            quiet(),
        ):
            if crew is not None:
                training = training.with_workers(crew, 0)
            trainer = make_trainer(
                config, Hardware(), out=Path(out), started="trial", callbacks=[timer]
            )
            trainer.fit(
                TrainingModule(network, config=config, training=training, validation=validation)
            )
        return timer.means_s()

    def _parts(self, config: TrainingConfig) -> tuple[Batches, Batches, Any]:
        """Batches for training, which may repeat snippets, for validation, and a network."""
        view = make_view(config.view, pixels=config.pixels)
        shape = shape_for(view, history=15, horizon=15, dt_s=0.2, action_range=(4.0, 0.5))
        plug: PredictorSpec = registry.find("predictors", self.predictor)
        network = plug.network(config.network, shape)
        recordings = open_data(self.data)
        index = index_snippets(recordings, dt_s=0.2, horizon_s=3.0)
        rows = np.random.default_rng(0).integers(0, len(index), self.steps * config.batch_size)
        training, validation = (
            Batches(
                recordings,
                index.select(some),
                view=view,
                batch_size=config.batch_size,
                later_ticks=network.later_ticks,
            )
            for some in (rows, rows[:1])
        )
        return training, validation, network


if __name__ == "__main__":
    tyro.cli(GpuRate).run()
