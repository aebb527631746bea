"""Processes that work side by side, and how they end."""

import operator
import os
import signal
import subprocess
import time
from collections.abc import Callable
from functools import partial
from multiprocessing.connection import Connection
from pathlib import Path
from socket import socketpair
from threading import Event
from typing import Any

import pytest

from asp_env.data.source import open_data
from asp_env.errors import AspEnvError
from asp_env.workers import ABANDONED, start, worker_pool


def done(processes: int, tasks: list[Callable[[], Any]]) -> dict[int, Any]:
    """Results by the tasks' numbers, of which each comes once."""
    with worker_pool(processes) as crew:
        found = list(crew.do(operator.call, tasks))
    assert len(found) == len(tasks)
    return dict(found)


def is_there(process: int) -> bool:
    """Whether a process exists."""
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    return True


class Elsewhere:
    """A task of another process. Here it waits until one like it is on its way there."""

    def __init__(self, sent: Event, what: Callable[..., Any], *about: Any) -> None:
        """The task is `what(*about)`."""
        self._sent, self._what, self._about = sent, what, about

    def __reduce__(self) -> tuple[Any, ...]:
        """The task itself."""
        self._sent.set()
        return partial, (self._what, *self._about)

    def __call__(self) -> None:
        """Nothing else."""
        assert self._sent.wait(60)


@pytest.mark.parametrize("processes", [1, 2])
def test_every_task_is_done_once(processes: int) -> None:
    """Five tasks, more than there are processes."""
    assert done(processes, [partial(pow, 3, n) for n in range(5)]) == {
        0: 1, 1: 3, 2: 9, 3: 27, 4: 81
    }  # fmt: skip


def test_who_works() -> None:
    """One process is this one; of two, this one and another, which is gone afterwards."""
    assert done(1, [os.getpid]) == {0: os.getpid()}
    sent = Event()
    here, there = sorted(done(2, [Elsewhere(sent, os.getpid)] * 2).values(), key=bool)
    assert here is None
    assert there != os.getpid()
    assert not is_there(there)


def test_whoever_is_ready_goes_on(tmp_path: Path) -> None:
    """While one process waits for the last task to be done, the other does all the rest."""
    sign = tmp_path / "done"
    wait = ["sh", "-c", 'until [ -e "$0" ]; do sleep 0.05; done', str(sign)]
    tasks = [partial(subprocess.run, wait, timeout=60), *[os.getpid] * 3, partial(sign.touch)]
    found = done(2, tasks)
    assert len({found[n] for n in (1, 2, 3)}) == 1


@pytest.mark.parametrize("where", ["here", "elsewhere"])
def test_bad_input_is_told_as_if_it_were_here(where: str, tmp_path: Path) -> None:
    """The same line; of the system's errors, the same file."""

    def failing(*task: Any) -> None:
        if where == "here":
            done(1, [partial(*task)])
        else:
            done(2, [Elsewhere(Event(), *task)] * 2)

    with pytest.raises(AspEnvError, match="nowhere does not exist; expected a folder"):
        failing(open_data, str(tmp_path / "nowhere"))
    with pytest.raises(FileNotFoundError) as caught:
        failing(os.stat, "nowhere")
    assert caught.value.filename == "nowhere"


def test_work_that_cannot_be_copied_is_told_too(tmp_path: Path) -> None:
    """Data that are gone before another process opens them."""
    sent = Event()

    class Work:
        def __reduce__(self) -> tuple[Any, ...]:
            sent.set()
            return open_data, (str(tmp_path / "nowhere"),)

        def __call__(self, task: object) -> object:
            assert sent.wait(60)
            return task

    with pytest.raises(AspEnvError, match="nowhere does not exist"), worker_pool(2) as crew:
        list(crew.do(Work(), [1, 2]))


@pytest.mark.parametrize(
    ("task", "how"),
    [
        ((signal.raise_signal, signal.SIGKILL), "was killed by signal 9; if memory ran out"),
        ((os._exit, 7), "ended with exit status 7"),
    ],
    ids=["killed", "ended"],
)
def test_a_process_that_ends_is_told(task: tuple[Callable[..., Any], int], how: str) -> None:
    """One line instead of waiting for ever."""
    with pytest.raises(AspEnvError, match=how):
        done(2, [Elsewhere(Event(), *task)] * 2)


def test_nobody_is_left_behind() -> None:
    """Interrupted, with a process at a task of an hour."""
    began, sent = time.monotonic(), Event()
    short, long = Elsewhere(sent, os.getpid), Elsewhere(sent, time.sleep, 3600.0)
    found: list[int] = []

    def interrupted() -> None:
        with worker_pool(2) as crew:
            for _, process in crew.do(operator.call, [short, short, long, long]):
                if process is not None:
                    found.append(process)
                    raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert time.monotonic() - began < 60
    assert not is_there(*found)


def test_a_process_ends_with_whoever_started_it() -> None:
    """In the midst of a task of an hour."""
    ours, theirs = socketpair()
    with Connection(ours.detach()) as link, theirs:
        number = theirs.fileno()
        process = start("asp_env.workers", str(number), pass_fds=(number,))
        for what in (operator.call, os.getpid, partial(time.sleep, 3600.0)):
            link.send(what)
        assert link.recv() == (None, process.pid)
        assert process.stdin is not None
        process.stdin.close()
        assert process.wait(timeout=60) == ABANDONED
