"""How fast a GPU trains at full size: `python -m tests.benchmarks.gpu_rate`.

The `paper` preset of ssp-asp on 12x360x240 rasters, one epoch of Lightning's own loop with each
precision, drawn by a thread or by processes. What a GPU waits for is the time between the end of a
step's work there and the arrival of the next batch, told by events on its own clock.
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
"""Steps that do not count."""


class Clock(pl.Callback):
    """Marks when each step's batch has come and when its work is done."""

    def __init__(self) -> None:
        """No marks yet."""
        self.come: list[Any] = []
        self.done: list[Any] = []

    def on_train_batch_start(self, *args: Any, **kwargs: Any) -> None:
        """The batch has been asked to be copied."""
        del args, kwargs
        self.come.append(_mark())

    def on_train_batch_end(self, *args: Any, **kwargs: Any) -> None:
        """All of the step's work has been asked for."""
        del args, kwargs
        self.done.append(_mark())

    def found(self) -> tuple[float, float]:
        """Seconds of a step, and of its waiting; means after the warm-up."""
        if torch.cuda.is_available():
            torch.cuda.synchronize()
        come, done = self.come[WARM_UP:], self.done[WARM_UP:]
        waits = [_between(*pair) for pair in zip(done[:-1], come[1:], strict=True)]
        return _between(done[0], done[-1]) / len(waits), float(np.mean(waits))


def _mark() -> Any:
    if not torch.cuda.is_available():
        return time.perf_counter()
    event = torch.cuda.Event(enable_timing=True)
    event.record()
    return event


def _between(first: Any, last: Any) -> float:
    return first.elapsed_time(last) / 1e3 if torch.cuda.is_available() else last - first


@dataclass(frozen=True, slots=True, kw_only=True)
class GpuRate:
    """Measures and prints a table."""

    data: Annotated[str, tyro.conf.Positional] = "sample:intersection"
    """What is learned from."""
    predictor: str = "ssp-asp"
    """Which one."""
    view: str = "chauffeurnet"
    """What it looks at."""
    preset: str = "paper"
    """Its recipe."""
    precisions: tuple[Literal["32-true", "bf16-mixed"], ...] = ("32-true", "bf16-mixed")
    """Of the encoder."""
    drawing: tuple[int, ...] = (0, 4)
    """Processes that draw; 0 is a thread."""
    batch_size: int = 32
    """Snippets at once."""
    steps: int = 120
    """Of each trial, warm-up included."""

    def run(self) -> None:
        """Prints the rates of all trials."""
        torch.set_num_threads(1)
        told = torch.cuda.get_device_name() if torch.cuda.is_available() else "CPU"
        table = Table(
            "precision", "drawn by", "samples/s", "ms a step", "waiting",
            title=f"{self.predictor} {self.preset} {self.view} on {told}",
        )  # fmt: skip
        for precision in self.precisions:
            for processes in self.drawing:
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
        config = recipe(self.predictor, self.preset, view=self.view, horizon_s=3.0)
        config = dataclasses.replace(
            config,
            precision=precision,
            batch_size=self.batch_size,
            epochs=1,
            pretraining_epochs=0,
        )
        training, validation, network = self._parts(config)
        clock = Clock()
        with (
            tempfile.TemporaryDirectory() as out,
            batch_workers([training.source], processes) as crew,
            quiet(),
        ):
            if crew is not None:
                training = training.with_workers(crew, 0)
            trainer = make_trainer(
                config, Hardware(), out=Path(out), started="trial", callbacks=[clock]
            )
            trainer.fit(
                TrainingModule(network, config=config, training=training, validation=validation)
            )
        return clock.found()

    def _parts(self, config: TrainingConfig) -> tuple[Batches, Batches, Any]:
        """As many snippets as steps need, some more than once, and a network."""
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
