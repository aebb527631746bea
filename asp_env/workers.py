"""Processes side by side. `python -m asp_env.workers DESCRIPTOR` is one of a crew.

Each is an interpreter of its own, since threads, such as torch's, survive no fork. It ends when its
standard input does, so that it never outlives whoever started it, however that ends.
"""

import os
import subprocess
import sys
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from multiprocessing import connection
from queue import SimpleQueue
from socket import socketpair
from threading import Thread
from typing import IO, Any, TypeVar, final

from asp_env.errors import AspEnvError

Task = TypeVar("Task")
Result = TypeVar("Result")

ABANDONED = 3
"""Exit status of a process whose starter is gone."""


def start(
    module: str,
    argument: str,
    *,
    output: IO[bytes] | None = None,
    env: Mapping[str, str] | None = None,
    pass_fds: Sequence[int] = (),
    process_group: int | None = None,
) -> subprocess.Popen[bytes]:
    """Starts `python -m MODULE ARGUMENT`, which is to call `end_with_starter`.

    Args:
        module: full name.
        argument: its only one.
        output: where all goes that it says; by default where this process's does.
        env: as `subprocess.Popen` has it, like what follows.
        pass_fds: descriptors that it keeps.
        process_group: 0 for one of its own.
    """
    return subprocess.Popen(
        [sys.executable, "-m", module, argument],
        stdin=subprocess.PIPE,
        stdout=output,
        stderr=None if output is None else subprocess.STDOUT,
        env=env,
        pass_fds=pass_fds,
        process_group=process_group,
    )


def end_with_starter() -> None:
    """Ends this process, whatever it is at, once whoever started it is gone."""
    Thread(target=_watch_input, daemon=True).start()


def _watch_input() -> None:
    # Of the descriptor itself: a lock of a buffer that is held here would spoil an orderly end.
    while os.read(0, 1):
        pass
    os._exit(ABANDONED)


@dataclass(frozen=True, slots=True, kw_only=True)
class _Worker:
    process: subprocess.Popen[bytes]
    connection: connection.Connection

    def tell(self, what: object) -> None:
        """Sends it something.

        Raises:
            AspEnvError: it has ended.
        """
        try:
            self.connection.send(what)
        except ConnectionError:
            raise self._ended() from None

    def hear(self) -> Any:
        """The result of its task.

        Raises:
            AspEnvError: the input was bad, or it has ended.
            OSError: as the task raised it.
        """
        try:
            error, result = self.connection.recv()
        except (EOFError, ConnectionError):
            raise self._ended() from None
        if error is not None:
            raise error
        return result

    def _ended(self) -> AspEnvError:
        status = self.process.wait()
        if status < 0:
            how = f"was killed by signal {-status}; if memory ran out, give fewer --jobs"
        else:
            how = f"ended with exit status {status}; what it said stands above"
        return AspEnvError(f"a worker process {how}")


@final
class WorkerPool:
    """This process and some others."""

    def __init__(self, workers: Sequence[_Worker]) -> None:
        """See `worker_pool`."""
        self._workers = tuple(workers)

    def do(
        self, work: Callable[[Task], Result], tasks: Sequence[Task]
    ) -> Iterator[tuple[int, Result]]:
        """Does all tasks, the first ones first; their numbers and results as these come.

        Args:
            work: what is done with each. Every other process unpickles a copy, once.
            tasks: pickled too for other processes, as are results.

        Raises:
            AspEnvError: the input was bad, or a process has ended.
        """
        waiting = deque(enumerate(tasks))
        found = SimpleQueue[tuple[int, Any, Exception | None]]()
        for worker in self._workers:
            # Ends at the latest with its process, which nobody waits for after an error.
            Thread(target=_attend, args=(worker, work, waiting, found), daemon=True).start()
        for _ in tasks:
            mine = _next(waiting) if found.empty() else None
            if mine is not None:
                number, task = mine
                yield number, work(task)
                continue
            number, result, error = found.get()
            if error is not None:
                raise error
            yield number, result


def _next(waiting: deque[tuple[int, Task]]) -> tuple[int, Task] | None:
    try:
        return waiting.popleft()
    except IndexError:
        return None


def _attend(
    worker: _Worker,
    work: object,
    waiting: deque[tuple[int, Task]],
    found: SimpleQueue[tuple[int, Any, Exception | None]],
) -> None:
    """Hands tasks to another process until there are none, or one fails."""
    told = False
    while (following := _next(waiting)) is not None:
        number, task = following
        try:
            if not told:
                worker.tell(work)
                told = True
            worker.tell(task)
            found.put((number, worker.hear(), None))
        except Exception as error:  # goes on where results are waited for
            found.put((number, None, error))
            return


@contextmanager
def worker_pool(processes: int) -> Iterator[WorkerPool]:
    """A crew of so many processes, this one among them, for as long as it is needed.

    The others do not hear of Ctrl-C, and end here whatever happens.
    """
    with ExitStack() as stack:
        yield WorkerPool([_hire(stack) for _ in range(processes - 1)])


def _hire(stack: ExitStack) -> _Worker:
    ours, theirs = socketpair()
    link = stack.enter_context(connection.Connection(ours.detach()))
    with theirs:
        number = theirs.fileno()
        process = start("asp_env.workers", str(number), pass_fds=(number,), process_group=0)
    stack.enter_context(process)
    stack.callback(process.terminate)
    return _Worker(process=process, connection=link)


def _serve(link: connection.Connection) -> None:
    """Answers every task with an error or a result, until there is an error or no more tasks."""
    try:
        work = link.recv()
        while True:
            link.send((None, work(link.recv())))
    except EOFError:
        return
    except AspEnvError as error:
        link.send((AspEnvError(str(error)), None))  # others need not survive pickling
    except OSError as error:
        link.send((error, None))


if __name__ == "__main__":
    end_with_starter()
    _serve(connection.Connection(int(sys.argv[1])))
