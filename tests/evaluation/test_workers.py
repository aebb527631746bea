"""Processes that work side by side, and how they end."""

import operator
import os
import signal
import time
from collections.abc import Callable
from functools import partial
from multiprocessing.connection import Connection
from pathlib import Path
from socket import socketpair
from typing import Any

import pytest

from asp_env.data.source import open_data
from asp_env.errors import AspEnvError
from asp_env.evaluation.workers import ABANDONED, hired, start


def done(processes: int, tasks: list[Callable[[], Any]]) -> dict[int, Any]:
    """Results by the tasks' numbers, of which each comes once."""
    with hired(processes) as crew:
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


@pytest.mark.parametrize("processes", [1, 2])
def test_every_task_is_done_once(processes: int) -> None:
    """Five tasks, more than there are processes."""
    assert done(processes, [partial(pow, 3, n) for n in range(5)]) == {
        0: 1, 1: 3, 2: 9, 3: 27, 4: 81
    }  # fmt: skip


def test_who_works() -> None:
    """One process is this one; of two, both others have tasks; a third has none left."""
    assert done(1, [os.getpid]) == {0: os.getpid()}
    both = {*done(3, [os.getpid, os.getpid]).values()}
    assert len(both) == 2
    assert os.getpid() not in both
    assert not any(is_there(process) for process in both)


def test_whoever_is_ready_goes_on() -> None:
    """While one is at a long task, the other does all the short ones."""
    with hired(2) as crew:
        order = [n for n, _ in crew.do(operator.call, [partial(time.sleep, 1.0), *[os.getpid] * 4])]
    assert sorted(order) == [0, 1, 2, 3, 4]
    assert order[-1] == 0


@pytest.mark.parametrize("processes", [1, 2])
def test_bad_input_is_told_as_if_it_were_here(processes: int, tmp_path: Path) -> None:
    """The same line; of the system's errors, the same file."""
    with pytest.raises(AspEnvError, match="nowhere does not exist; expected a folder"):
        done(processes, [os.getpid, partial(open_data, str(tmp_path / "nowhere"))])
    with pytest.raises(FileNotFoundError) as caught:
        done(processes, [partial(os.stat, "nowhere")])
    assert caught.value.filename == "nowhere"


def test_bad_work_is_told_too(tmp_path: Path) -> None:
    """A copy of the work that another process cannot make."""

    class Unmakable:
        def __reduce__(self) -> tuple[Any, ...]:
            return open_data, (str(tmp_path / "nowhere"),)

        def __call__(self, task: object) -> object:
            return task

    with pytest.raises(AspEnvError, match="nowhere does not exist"), hired(2) as crew:
        list(crew.do(Unmakable(), [1, 2, 3]))


@pytest.mark.parametrize(
    ("task", "how"),
    [
        (partial(signal.raise_signal, signal.SIGKILL), "was killed by signal 9; if memory ran out"),
        (partial(os._exit, 7), "ended with exit status 7"),
    ],
    ids=["killed", "ended"],
)
def test_a_process_that_ends_is_told(task: Callable[[], Any], how: str) -> None:
    """One line instead of waiting for ever."""
    with pytest.raises(AspEnvError, match=how):
        done(2, [task, os.getpid])


def test_nobody_is_left_behind() -> None:
    """Interrupted, with a process at a task of an hour."""
    began = time.monotonic()
    found: list[int] = []

    def interrupted() -> None:
        with hired(2) as crew:
            tasks = [os.getpid, os.getpid, *[partial(time.sleep, 3600.0)] * 2]
            for _, process in crew.do(operator.call, tasks):
                found.append(process)
                if len(found) == 2:
                    raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert time.monotonic() - began < 60
    assert not any(is_there(process) for process in found)


def test_a_process_ends_with_whoever_started_it() -> None:
    """In the midst of a task of an hour."""
    ours, theirs = socketpair()
    with Connection(ours.detach()) as link, theirs:
        number = theirs.fileno()
        process = start("asp_env.evaluation.workers", str(number), pass_fds=(number,))
        for what in (operator.call, os.getpid, partial(time.sleep, 3600.0)):
            link.send(what)
        assert link.recv() == (None, process.pid)
        assert process.stdin is not None
        process.stdin.close()
        assert process.wait(timeout=60) == ABANDONED
