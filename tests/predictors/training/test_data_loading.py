"""Batches of processes equal those of a thread, and the processes end with the run."""

import os
import select
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import load_file
from torch.utils._pytree import tree_flatten

from asp_env.data.causal import causal_histories
from asp_env.data.snippets import SnippetIndex, index_snippets
from asp_env.data.source import open_data
from asp_env.errors import AspEnvError
from asp_env.views import make_view
from predictors.training.data import Batches
from predictors.training.data_loading import BatchRequest, BatchWorkers, Sample, batch_workers
from predictors.training.fitting import train
from predictors.training.trainer import Hardware
from tests.builders import make_recording
from tests.predictors.tiny import PIXELS, tiny_config, write_data

PROCESSES = 2


def opened(folder: str) -> Batches:
    """Rasters with causal histories, of recordings that processes open by name."""
    recordings = open_data(folder)
    return Batches(
        recordings,
        index_snippets(recordings, dt_s=0.2, horizon_s=3.0),
        view=make_view("chauffeurnet", pixels=PIXELS),
        batch_size=8,
        later_ticks=(15,),
        histories=causal_histories(recordings),
    )


def request(snippets: SnippetIndex) -> BatchRequest:
    """A batch of the first snippets of a run."""
    return BatchRequest(snippets, np.arange(len(snippets)))


def in_memory() -> Batches:
    """Vectors of a recording that exists only in memory."""
    recordings = [make_recording()]
    index = index_snippets(recordings, dt_s=0.2, horizon_s=3.0)
    return Batches(recordings, index, view=make_view("vectors"), batch_size=16)


@pytest.fixture(scope="module")
def both(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[BatchWorkers, list[Batches]]]:
    """Two processes with two sources."""
    batches = [opened(write_data(tmp_path_factory.mktemp("data"))), in_memory()]
    with batch_workers([each.source for each in batches], PROCESSES) as workers:
        assert workers is not None
        yield workers, batches


def equal(first: Sample, second: Sample) -> bool:
    """Whether two batches are equal bit for bit."""
    pairs = zip(tree_flatten(first)[0], tree_flatten(second)[0], strict=True)
    return all(torch.equal(one, other) for one, other in pairs)


@pytest.mark.parametrize("number", [0, 1], ids=["opened, causal", "in memory"])
def test_processes_load_the_batches_of_a_thread(
    both: tuple[BatchWorkers, list[Batches]], number: int
) -> None:
    """In the same order, bit for bit, for a shard of a shuffle."""
    workers, batches = both
    rows = np.random.default_rng(0).permutation(len(batches[number].snippets))
    by_thread = batches[number].reordered(rows).shard(1, 2)
    by_workers = by_thread.with_workers(workers, number)
    pairs = list(zip(by_thread, by_workers, strict=True))
    assert len(pairs) == len(by_thread) > PROCESSES
    assert all(equal(*pair) for pair in pairs)
    assert not equal(pairs[0][0], pairs[1][0])


def test_error_in_a_process_is_raised(both: tuple[BatchWorkers, list[Batches]]) -> None:
    """The error is raised where the batch is read; the processes continue."""
    workers, batches = both
    index = index_snippets(batches[1].source.recordings, dt_s=0.2, horizon_s=3.0, history_s=1.0)
    with pytest.raises(ValueError, match="needs 15 past ticks"):
        workers.submit(1, request(index)).result()
    few = request(batches[1].snippets.select(np.arange(3)))
    assert len(workers.submit(1, few).result()[1].states) == 3


def test_processes_do_not_change_the_weights(tmp_path: Path) -> None:
    """Training with a thread and with a process has equal results, bit for bit."""
    data = write_data(tmp_path / "data")
    config = tiny_config("ssp-asp", "vectors", epochs=1, pretraining_epochs=1)
    runs = [
        train(config, data, tmp_path / str(processes), hardware=Hardware(num_workers=processes))
        for processes in (0, 1)
    ]
    weights = [load_file(run / "weights.safetensors") for run in runs]
    assert weights[0].keys() == weights[1].keys()
    assert all(torch.equal(value, weights[1][name]) for name, value in weights[0].items())


def test_negative_number_of_processes_is_refused() -> None:
    with pytest.raises(AspEnvError, match="num_workers is -1, expected 0 or more"):
        Hardware(num_workers=-1)


KILLED = """
import os, signal
from predictors.training.data_loading import BatchWorkers
from tests.predictors.training.test_data_loading import in_memory, request

if __name__ == "__main__":
    batches = in_memory()
    workers = BatchWorkers([batches.source], 2)
    workers.submit(0, request(batches.snippets)).result()
    os.kill(os.getpid(), signal.SIGKILL)
"""


def test_processes_end_when_the_run_is_killed(tmp_path: Path) -> None:
    """They share its standard output, which is closed when the last of them ends."""
    script = tmp_path / "killed.py"
    script.write_text(KILLED)
    reading, writing = os.pipe()
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(path for path in sys.path if path)}
    process = subprocess.run(
        [sys.executable, str(script)],
        stdout=writing,
        stderr=subprocess.PIPE,
        env=environment,
        check=False,
    )
    os.close(writing)
    with os.fdopen(reading, "rb") as output:
        assert process.returncode < 0, process.stderr
        assert select.select([output], [], [], 60)[0], "still running after a minute"
        assert output.read() == b""
