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
from typing import NamedTuple, final

import numpy as np
import torch
from jaxtyping import Int

from asp_env.data.recording import Recording
from asp_env.data.snippets import SnippetIndex, gather_future, gather_scene
from asp_env.views import SceneView
from asp_env.workers import WorkerPool
from predictors.models.batch import Batch, Labels, make_batch, make_labels
from predictors.training.augmentation import (
    Augmentation,
    measured_again,
    off_the_map,
    one_situation_each,
    reshaped,
    reshaped_labels,
    sample_keys,
)

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
    augmentation: Augmentation | None = None
    seed: int = 0
    """Seed of the augmentation."""

    def load(self, request: "BatchRequest") -> Sample:
        """Makes one batch of all the snippets."""
        if self.augmentation is not None:
            return self._augmented(request, self.augmentation)
        snippets = request.snippets
        scene = gather_scene(self.histories, snippets)
        later = tuple(
            make_batch(
                gather_scene(self.histories, snippets.shifted(ticks)), self.view, snippets.history
            )
            for ticks in self.later_ticks
        )
        labels = make_labels(scene, gather_future(self.recordings, snippets), later)
        return make_batch(scene, self.view, snippets.history), labels

    def _augmented(self, request: "BatchRequest", ranges: Augmentation) -> Sample:
        snippets, keys = request.snippets, sample_keys(self.seed, request.visits)
        recorded = one_situation_each(gather_scene(self.histories, snippets))
        about = recorded.target_states[:, :2].astype(np.float64)
        scenes = [measured_again(recorded, keys, ranges)]
        for part, ticks in enumerate(self.later_ticks, start=1):
            later = one_situation_each(gather_scene(self.histories, snippets.shifted(ticks)))
            scenes.append(measured_again(later, keys, ranges, part=part))
        labels = make_labels(scenes[0], gather_future(self.recordings, snippets))
        batches = []
        for scene in scenes:
            moved = off_the_map(scene, about, keys, ranges)
            batches.append(reshaped(make_batch(moved, self.view, snippets.history), keys, ranges))
        states = reshaped_labels(labels.states, keys, ranges)
        return batches[0], Labels(states=states, later=tuple(batches[1:]))


class BatchRequest(NamedTuple):
    """The snippets of a batch."""

    snippets: SnippetIndex
    visits: Int[np.ndarray, " n"]
    """Number of snippets that the run visits before each; augmentation depends on it."""


@final
class BatchWorkers:
    """Processes that make batches; they end with the process that started them, even if killed."""

    def __init__(self, sources: Sequence[BatchSource], processes: int) -> None:
        """Starts the processes; each of them has all the sources."""
        self.prefetch = PREFETCH * processes
        self._pool = WorkerPool(
            partial(_load, tuple(sources)), processes, initializer=_use_one_thread
        )

    def submit(self, source: int, request: BatchRequest) -> Future[Sample]:
        """Starts to make a batch from the source of that index."""
        return self._pool.submit((source, request))

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


def load_by_thread(source: BatchSource, batches: Iterable[BatchRequest]) -> Iterator[Sample]:
    """Makes batches in order, in a thread.

    Args:
        source: What they are made from.
        batches: The snippets of each batch.
    """
    with ThreadPoolExecutor(1, thread_name_prefix="load") as pool:
        yield from _in_order(batches, lambda each: pool.submit(source.load, each), PREFETCH)


def load_by_workers(
    workers: BatchWorkers, source: int, batches: Iterable[BatchRequest]
) -> Iterator[Sample]:
    """Makes batches in order, in processes.

    Args:
        workers: The processes.
        source: Index of what they are made from.
        batches: The snippets of each batch.
    """
    return _in_order(batches, lambda each: workers.submit(source, each), workers.prefetch)


def _in_order(
    batches: Iterable[BatchRequest],
    submit: Callable[[BatchRequest], Future[Sample]],
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


def _load(sources: tuple[BatchSource, ...], request: tuple[int, BatchRequest]) -> Sample:
    source, batch = request
    return sources[source].load(batch)
