"""Worker processes: one pool for `asp-env drive --jobs`, batch loading and `asp-env table`.

A `WorkerPool` sends tasks to processes and returns `concurrent.futures.Future` objects. Scheduling
is that of `concurrent.futures.ThreadPoolExecutor`: each of its threads sends one task at a time to
an idle process and waits for the reply. The processes are new Python interpreters
(`python -m asp_env.workers FD`), because threads, such as those of torch, do not survive a fork.

`concurrent.futures.ProcessPoolExecutor` with the `spawn` method does the same in less code, but:

- When one of its processes dies, it terminates all others and fails their tasks. A training run
  that exceeds the memory would end the training runs beside it.
- It reports neither the exit status or signal of a process nor its CPU time, and its processes
  cannot have their own output and environment. The log and the cost of each cell of
  `asp-env table` need all of these.
- It imports the main module of the caller again in every process. A script that calls `drive`
  outside of `if __name__ == "__main__":` would fail.
- On Ctrl-C it waits until running tasks are done.

Processes end with the program that started them, even if that is killed: the kernel then closes
its end of the socket, which a thread of every worker process waits for. The programs that they have
started, such as SUMO, end with them: each worker process leads a process group.
"""

import os
import pickle
import select
import signal
import subprocess
import sys
import traceback
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from multiprocessing import current_process
from multiprocessing.connection import Connection
from multiprocessing.reduction import ForkingPickler
from queue import SimpleQueue
from socket import socketpair
from threading import Lock, Thread
from typing import IO, Any, Generic, Never, TypeVar, final

from asp_env.errors import AspEnvError

Task = TypeVar("Task")
Result = TypeVar("Result")

_END = b""
"""Ends a worker process. Pickled tasks are never empty."""


class WorkerExitError(AspEnvError):
    """A worker process ended before its task was done.

    Attributes:
        status: exit status of the process; the negative signal number if a signal ended it.
    """

    def __init__(self, status: int) -> None:
        self.status = status
        if status < 0:
            how = f"was killed by signal {-status}; if memory ran out, use fewer processes"
        else:
            how = f"ended with exit status {status}; its output is above or in its log"
        super().__init__(f"a worker process {how}")


@final
class WorkerPool(Generic[Task, Result]):
    """Processes that apply one function to many tasks.

    Use it as a context manager: it is closed at the end, and terminated after an exception. The
    processes are in process groups of their own, so Ctrl-C reaches only the parent process.
    """

    def __init__(
        self,
        work: Callable[[Task], Result],
        processes: int,
        *,
        initializer: Callable[[], object] | None = None,
        output: IO[bytes] | None = None,
        env: Mapping[str, str] | None = None,
    ) -> None:
        """Starts the processes. Each receives `initializer` and `work` with its first task.

        Args:
            work: function that is applied to every task; pickled once for each process.
            processes: number of processes, at least 1.
            initializer: called in every process before `work` is unpickled.
            output: file for the standard output and error of the processes; those of this process
                by default.
            env: environment variables of the processes; those of this process by default.
        """
        self._workers = [
            _Worker(work, initializer, output=output, env=env) for _ in range(processes)
        ]
        self._idle = SimpleQueue[_Worker]()
        for worker in self._workers:
            self._idle.put(worker)
        self._threads = ThreadPoolExecutor(processes, thread_name_prefix="worker")

    def submit(self, task: Task) -> Future[Result]:
        """Schedules one task; tasks start in the order in which they are submitted.

        Exceptions of the task are raised by the future, with the traceback of the worker process
        as a note unless they are an `AspEnvError` or `OSError`. If the process ends, the future
        raises `WorkerExitError`, and so do all later tasks of that process.
        """
        return self._threads.submit(self._run, task)

    def map(self, tasks: Iterable[Task]) -> Iterator[Result]:
        """Results of all tasks, in the order of the tasks.

        Raises:
            AspEnvError: as a task raised it, or a process has ended.
        """
        futures = deque(self.submit(task) for task in tasks)
        while futures:
            yield futures.popleft().result()

    def _run(self, task: Task) -> Result:
        worker = self._idle.get()  # never blocks: there is a worker for each thread
        try:
            return worker.run(task)
        finally:
            self._idle.put(worker)

    @property
    def cpu_s(self) -> float:
        """CPU time in seconds of the processes that have ended, including their children."""
        return sum(worker.cpu_s for worker in self._workers)

    def close(self) -> None:
        """Waits for running tasks and ends the processes; tasks that wait are cancelled."""
        self._threads.shutdown(cancel_futures=True)
        for worker in self._workers:
            worker.finish()
        for worker in self._workers:
            worker.wait()

    def terminate(self) -> None:
        """Ends the processes, and the programs that they have started, at once with SIGTERM."""
        for worker in self._workers:
            worker.terminate()
        self._threads.shutdown(cancel_futures=True)
        for worker in self._workers:
            worker.wait()

    def __enter__(self) -> "WorkerPool[Task, Result]":
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        try:
            if kind is None:
                self.close()
        finally:
            self.terminate()


@final
class _Worker:
    """A process and the socket to it."""

    def __init__(
        self,
        work: Callable[[Any], Any],
        initializer: Callable[[], object] | None,
        *,
        output: IO[bytes] | None,
        env: Mapping[str, str] | None,
    ) -> None:
        self._setup = (initializer, work)
        self._is_set_up = False
        self._lock = Lock()
        self.cpu_s = 0.0
        own, other = socketpair()
        self._socket = Connection(own.detach())
        with other:
            self._process = subprocess.Popen(
                [sys.executable, "-m", "asp_env.workers", str(other.fileno())],
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=None if output is None else subprocess.STDOUT,
                env=env,
                pass_fds=(other.fileno(),),
                process_group=0,
            )

    def run(self, task: object) -> Any:
        messages = [ForkingPickler.dumps(task)]
        if not self._is_set_up:
            setup = [ForkingPickler.dumps(each) for each in self._setup]
            # Tensors are passed as file descriptors over sockets that require a common key.
            messages = [current_process().authkey, *setup, *messages]
        try:
            for message in messages:
                self._socket.send_bytes(message)
            self._is_set_up = True
            reply = self._socket.recv_bytes()
        except (EOFError, OSError):
            raise WorkerExitError(self.wait()) from None
        error, result = pickle.loads(reply)
        if error is not None:
            raise error
        return result

    def finish(self) -> None:
        with self._lock:
            if self._process.returncode is None:
                try:
                    self._socket.send_bytes(_END)
                except OSError:
                    return  # it has ended already

    def terminate(self) -> None:
        with self._lock:
            if self._process.returncode is None:
                os.killpg(self._process.pid, signal.SIGTERM)

    def wait(self) -> int:
        """Waits until the process has ended; its exit status."""
        with self._lock:
            if self._process.returncode is None:
                _, status, usage = os.wait4(self._process.pid, 0)
                self._process.returncode = os.waitstatus_to_exitcode(status)
                self.cpu_s = usage.ru_utime + usage.ru_stime
                self._socket.close()
            return self._process.returncode


def _serve(socket: Connection) -> None:
    """Replies to tasks until the pool is closed."""
    Thread(target=_end_with_parent, args=(socket.fileno(),), daemon=True).start()
    try:
        key = socket.recv_bytes()
        if key == _END:
            return
        current_process().authkey = key
        work = _set_up(socket.recv_bytes(), socket.recv_bytes())
        while (task := socket.recv_bytes()) != _END:
            socket.send_bytes(_reply(work, task))
    except (EOFError, OSError):
        _end_group()


def _end_with_parent(descriptor: int) -> None:
    poll = select.poll()
    poll.register(descriptor, 0)  # waits for POLLHUP alone: the other end is closed
    poll.poll()
    _end_group()


def _end_group() -> None:
    """Ends this process, whose parent process has ended, and the programs that it has started."""
    os.killpg(os.getpgrp(), signal.SIGKILL)


def _set_up(initializer: bytes, work: bytes) -> Callable[[Any], Any]:
    try:
        call = pickle.loads(initializer)
        if call is not None:
            call()
        return pickle.loads(work)
    except Exception as error:
        failure = error

        def fail(task: object) -> Never:
            del task
            raise failure

        return fail


def _reply(work: Callable[[Any], Any], task: bytes) -> Any:
    """The pickled pair (error, result)."""
    try:
        return ForkingPickler.dumps((None, work(pickle.loads(task))))
    except (AspEnvError, OSError) as error:
        return _dump_error(error)
    except Exception as error:
        error.add_note(f"In a worker process:\n{traceback.format_exc()}")
        return _dump_error(error)


def _dump_error(error: Exception) -> Any:
    try:
        reply = ForkingPickler.dumps((error, None))
        pickle.loads(reply)  # an exception with a constructor of its own may fail only here
        return reply
    except Exception:
        kind = AspEnvError if isinstance(error, AspEnvError) else RuntimeError
        return ForkingPickler.dumps((kind(str(error)), None))


if __name__ == "__main__":
    _serve(Connection(int(sys.argv[1])))


@contextmanager
def one_thread() -> Iterator[None]:
    """Limits torch to one thread, so that sums do not depend on the number of cores."""
    torch = sys.modules.get("torch")
    if torch is None:
        yield
        return
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)
