"""Drawing batches ahead: by a thread, or by processes of their own where a GPU outruns one.

A thread shares the interpreter with the program that feeds the network; processes do not. Each of
them opens the recordings anew, mapped from the same cache. Batches come in their order, whoever
draws them, and are the same to the last bit.
"""

import os
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import islice
from multiprocessing import connection, parent_process
from typing import final

import torch
from torch import multiprocessing

from asp_env.data.recording import Recording
from asp_env.data.snippets import SnippetIndex, gather_future, gather_scene
from asp_env.views import SceneView
from predictors.models.batch import Batch, Labels, make_batch, make_labels

AHEAD = 4
"""Batches drawn in advance by each thread or process."""

Drawn = tuple[Batch, Labels]


@dataclass(frozen=True, slots=True, kw_only=True)
class BatchSource:
    """What is drawn of snippets, and of which recordings."""

    recordings: Sequence[Recording]
    """What happened, which labels are taken from."""
    histories: Sequence[Recording]
    """The same recordings with what was known at the time."""
    view: SceneView
    later_ticks: tuple[int, ...] = ()
    """How long after now the later scenes lie that labels hold."""

    def draw(self, chosen: SnippetIndex) -> Drawn:
        """Some snippets as one batch."""
        scene = gather_scene(self.histories, chosen)
        later = tuple(
            make_batch(
                gather_scene(self.histories, chosen.shifted(ticks)), self.view, chosen.history
            )
            for ticks in self.later_ticks
        )
        labels = make_labels(scene, gather_future(self.recordings, chosen), later)
        return make_batch(scene, self.view, chosen.history), labels


@final
class BatchWorkers:
    """Processes that draw; they end with the one that started them, however it ends."""

    def __init__(self, drawings: Sequence[BatchSource], processes: int) -> None:
        """So many processes, of which each knows all the drawings by their number."""
        self.ahead = AHEAD * processes
        self._pool = ProcessPoolExecutor(
            processes,
            mp_context=multiprocessing.get_context("spawn"),  # GPUs and threads survive no fork
            initializer=_begin,
            initargs=(tuple(drawings),),
        )

    def submit(self, number: int, chosen: SnippetIndex) -> Future[Drawn]:
        """Has a batch drawn."""
        return self._pool.submit(_draw, number, chosen)

    def close(self) -> None:
        """Ends the processes; what is not begun is not drawn."""
        self._pool.shutdown(cancel_futures=True)


@contextmanager
def batch_workers(drawings: Sequence[BatchSource], processes: int) -> Iterator[BatchWorkers | None]:
    """A crew for as long as it is needed; None for no processes."""
    if not processes:
        yield None
        return
    crew = BatchWorkers(drawings, processes)
    try:
        yield crew
    finally:
        crew.close()


def load_by_thread(drawing: BatchSource, chosen: Iterable[SnippetIndex]) -> Iterator[Drawn]:
    """Batches in their order, drawn while the network works on the ones before."""
    with ThreadPoolExecutor(1, thread_name_prefix="draw") as pool:
        yield from _in_order(chosen, lambda each: pool.submit(drawing.draw, each), AHEAD)


def load_by_workers(
    crew: BatchWorkers, number: int, chosen: Iterable[SnippetIndex]
) -> Iterator[Drawn]:
    """The same by processes."""
    return _in_order(chosen, lambda each: crew.submit(number, each), crew.ahead)


def _in_order(
    chosen: Iterable[SnippetIndex],
    submit: Callable[[SnippetIndex], Future[Drawn]],
    ahead: int,
) -> Iterator[Drawn]:
    left = iter(chosen)
    waiting = deque(submit(each) for each in islice(left, ahead))
    while waiting:
        ready = waiting.popleft().result()
        waiting.extend(submit(each) for each in islice(left, 1))
        yield ready


_drawings: tuple[BatchSource, ...] = ()
"""What this process draws, if it is of a crew."""


def _begin(drawings: tuple[BatchSource, ...]) -> None:
    global _drawings
    _drawings = drawings
    torch.set_num_threads(1)
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    """A parent that was killed cannot tell its processes to end."""
    parent = parent_process()
    if parent is not None:
        connection.wait([parent.sentinel])
        os._exit(1)


def _draw(number: int, chosen: SnippetIndex) -> Drawn:
    return _drawings[number].draw(chosen)
