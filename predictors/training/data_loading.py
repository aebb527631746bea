"""Loading of batches ahead of the network: in a thread, or in processes.

A thread shares the interpreter with the program that feeds the network; processes do not, which
pays where a GPU is faster than one thread. Each process opens the recordings itself, mapped from
the same cache. Batches come in their order and are equal bit for bit, wherever they are made.
"""

from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from itertools import islice
from typing import final

import torch

from asp_env.data.recording import Recording
from asp_env.data.snippets import SnippetIndex, gather_future, gather_scene
from asp_env.views import SceneView
from asp_env.workers import WorkerPool
from predictors.models.batch import Batch, Labels, make_batch, make_labels

PREFETCH = 4
"""Batches that each thread or process loads in advance. Chosen by hand: it smooths the differences
between batches."""

Sample = tuple[Batch, Labels]
"""Inputs and labels of one batch."""


@dataclass(frozen=True, slots=True, kw_only=True)
class BatchSource:
    """What batches are made from."""

    recordings: Sequence[Recording]
    """The recordings that labels are taken from."""
    histories: Sequence[Recording]
    """The same recordings, as the inputs show them."""
    view: SceneView
    later_ticks: tuple[int, ...] = ()
    """Ticks ahead at which labels hold future inputs."""

    def load(self, snippets: SnippetIndex) -> Sample:
        """Makes one batch of all the snippets."""
        scene = gather_scene(self.histories, snippets)
        later = tuple(
            make_batch(
                gather_scene(self.histories, snippets.shifted(ticks)), self.view, snippets.history
            )
            for ticks in self.later_ticks
        )
        labels = make_labels(scene, gather_future(self.recordings, snippets), later)
        return make_batch(scene, self.view, snippets.history), labels


@final
class BatchWorkers:
    """Processes that make batches; they end with the process that started them, even if killed."""

    def __init__(self, sources: Sequence[BatchSource], processes: int) -> None:
        """Starts the processes; each of them has all the sources."""
        self.prefetch = PREFETCH * processes
        self._pool = WorkerPool(
            partial(_load, tuple(sources)), processes, initializer=_use_one_thread
        )

    def submit(self, source: int, snippets: SnippetIndex) -> Future[Sample]:
        """Starts to make a batch of the snippets from the source of that index."""
        return self._pool.submit((source, snippets))

    def close(self) -> None:
        """Cancels the batches that are not begun, and ends the processes."""
        self._pool.close()


@contextmanager
def batch_workers(sources: Sequence[BatchSource], processes: int) -> Iterator[BatchWorkers | None]:
    """Processes for the duration of a `with` block; None if there are to be no processes."""
    if not processes:
        yield None
        return
    workers = BatchWorkers(sources, processes)
    try:
        yield workers
    finally:
        workers.close()


def load_by_thread(source: BatchSource, batches: Iterable[SnippetIndex]) -> Iterator[Sample]:
    """Makes batches in order, in a thread.

    Args:
        source: What they are made from.
        batches: The snippets of each batch.
    """
    with ThreadPoolExecutor(1, thread_name_prefix="load") as pool:
        yield from _in_order(batches, lambda each: pool.submit(source.load, each), PREFETCH)


def load_by_workers(
    workers: BatchWorkers, source: int, batches: Iterable[SnippetIndex]
) -> Iterator[Sample]:
    """Makes batches in order, in processes.

    Args:
        workers: The processes.
        source: Index of what they are made from.
        batches: The snippets of each batch.
    """
    return _in_order(batches, lambda each: workers.submit(source, each), workers.prefetch)


def _in_order(
    batches: Iterable[SnippetIndex],
    submit: Callable[[SnippetIndex], Future[Sample]],
    prefetch: int,
) -> Iterator[Sample]:
    remaining = iter(batches)
    pending = deque(submit(each) for each in islice(remaining, prefetch))
    while pending:
        ready = pending.popleft().result()
        pending.extend(submit(each) for each in islice(remaining, 1))
        yield ready


def _use_one_thread() -> None:
    torch.set_num_threads(1)


def _load(sources: tuple[BatchSource, ...], request: tuple[int, SnippetIndex]) -> Sample:
    source, snippets = request
    return sources[source].load(snippets)
