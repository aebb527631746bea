"""Training rate of ssp-asp on vectors and rasters: `python -m tests.benchmarks.training_rate`.

A step draws a batch of 32 snippets (at the present and at the end of the segment), then runs the
forward and the backward pass in bf16 on one thread. The networks take turns within one run.
"""

import dataclasses
import time
from typing import NamedTuple

import numpy as np
import torch
from rich.console import Console
from rich.table import Table

from asp_env import registry
from asp_env.data.snippets import index_snippets
from asp_env.data.source import open_data
from asp_env.views import make_view
from predictors.inference.checkpoint import PredictorSpec, shape_for
from predictors.models.batch import Batch, Labels
from predictors.models.network import AbstractNetwork, TrainingProgress
from predictors.training.data import Batches
from predictors.training.recipes import recipe

DATA = "sample:intersection"
BATCH = 32
ROUNDS = 3
TRIALS = (
    ("vectors", "vector", None),
    ("chauffeurnet", "small", (90, 60)),
    ("chauffeurnet", "resnet18", (90, 60)),
    ("chauffeurnet", "small", (360, 240)),
    ("chauffeurnet", "resnet18", (360, 240)),
)


class Trial(NamedTuple):
    """A network with its optimizer and a batch."""

    name: str
    network: AbstractNetwork
    optimizer: torch.optim.Optimizer
    batches: Batches

    def step(self) -> float:
        """Duration of a training step with data loading, s."""
        begin = time.perf_counter()
        for batch, labels in self.batches:
            self._learn(batch, labels)
        return (time.perf_counter() - begin) / len(self.batches)

    def _learn(self, batch: Batch, labels: Labels) -> None:
        with torch.autocast("cpu", dtype=torch.bfloat16):
            loss = self.network.training_loss(batch, labels, TrainingProgress())["loss"]
        self.optimizer.zero_grad()
        loss.backward()
        self.optimizer.step()


def make_trial(view_name: str, encoder: str, pixels: tuple[int, int] | None) -> Trial:
    """A network of the recipe `cpu` with a given encoder."""
    config = recipe("ssp-asp", "cpu", view=view_name, horizon_s=3.0)
    view = make_view(view_name, pixels=pixels)
    shape = shape_for(view, history=15, horizon=15, dt_s=0.2, action_range=(4.0, 0.5))
    plug: PredictorSpec = registry.find("predictors", "ssp-asp")
    network = plug.network(dataclasses.replace(config.network, encoder=encoder), shape)
    recordings = open_data(DATA)
    index = index_snippets(recordings, dt_s=0.2, horizon_s=3.0)
    rows = np.random.default_rng(0).permutation(len(index))[:BATCH]
    batches = Batches(
        recordings,
        index.select(rows),
        view=view,
        batch_size=BATCH,
        later_ticks=network.later_ticks,
    )
    size = "" if pixels is None else f" 12x{pixels[0]}x{pixels[1]}"
    optimizer = torch.optim.Adam(network.parameters(), lr=1e-4)
    return Trial(f"{view_name}{size}, {encoder}", network, optimizer, batches)


def main() -> None:
    """Prints the median rates, and the rate of vectors relative to each."""
    torch.set_num_threads(1)
    torch.manual_seed(0)
    trials = [make_trial(*trial) for trial in TRIALS]
    for trial in trials:
        trial.step()
    seconds = np.array([[trial.step() for trial in trials] for _ in range(ROUNDS)])
    rates = BATCH / np.median(seconds, axis=0)
    table = Table("ssp-asp, 3 s", "samples/s", "vectors / this")
    for trial, rate in zip(trials, rates, strict=True):
        table.add_row(trial.name, f"{rate:,.0f}", f"{rates[0] / rate:.1f}")
    Console().print(table)


if __name__ == "__main__":
    main()
