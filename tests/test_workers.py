"""Worker processes: what tasks return, how errors arrive, and how the processes end."""

import operator
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from asp_env.data.source import open_data
from asp_env.errors import AspEnvError, DataError, MissingExtraError
from asp_env.workers import WorkerExitError, WorkerPool


def results(processes: int, tasks: list[Callable[[], Any]]) -> list[Any]:
    with WorkerPool(operator.call, processes) as pool:
        return list(pool.map(tasks))


def exists(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    return True


@pytest.mark.parametrize("processes", [1, 2])
def test_results_are_in_the_order_of_the_tasks(processes: int) -> None:
    """The first of five tasks takes the longest."""
    slow = partial(time.sleep, 0.5)
    assert results(processes, [slow, *(partial(pow, 3, n) for n in range(4))]) == [
        None,
        1,
        3,
        9,
        27,
    ]


def test_tasks_run_in_other_processes_that_end_afterwards() -> None:
    processes = set(results(2, [partial(_slowly, os.getpid)] * 4))
    assert len(processes) == 2
    assert os.getpid() not in processes
    assert not any(exists(process) for process in processes)


def _slowly(function: Callable[[], Any]) -> Any:
    time.sleep(0.3)
    return function()


def test_an_idle_process_takes_the_next_task(tmp_path: Path) -> None:
    """While one process waits for the last task, the other one does all the rest."""
    sign = tmp_path / "done"
    wait = ["sh", "-c", 'until [ -e "$0" ]; do sleep 0.05; done', str(sign)]
    tasks = [partial(subprocess.run, wait, timeout=60), *[os.getpid] * 3, partial(sign.touch)]
    assert len(set(results(2, tasks)[1:4])) == 1


def test_errors_arrive_as_they_were_raised(tmp_path: Path) -> None:
    """The same type and message; of the system's errors, the same file."""
    with pytest.raises(AspEnvError, match="nowhere does not exist; expected a folder"):
        results(1, [partial(open_data, str(tmp_path / "nowhere"))])
    with pytest.raises(FileNotFoundError) as caught:
        results(1, [partial(os.stat, "nowhere")])
    assert caught.value.filename == "nowhere"
    with pytest.raises(DataError, match="broken"):
        results(1, [partial(_fail, DataError("broken"))])


def _fail(error: Exception) -> None:
    raise error


def _fail_with_missing_extra() -> None:
    raise MissingExtraError("torch", "train", "training")


def test_errors_that_cannot_be_unpickled_keep_their_message() -> None:
    with pytest.raises(AspEnvError, match="training needs the package 'torch'"):
        results(1, [_fail_with_missing_extra])


def test_other_exceptions_carry_the_traceback_of_the_process() -> None:
    with pytest.raises(ZeroDivisionError) as caught:
        results(1, [partial(operator.truediv, 1, 0)])
    assert "In a worker process:\nTraceback" in caught.value.__notes__[0]


def test_a_process_goes_on_after_an_error() -> None:
    with WorkerPool(operator.call, 1) as pool:
        first, second = pool.submit(partial(os.stat, "nowhere")), pool.submit(os.getpid)
        assert isinstance(first.exception(), FileNotFoundError)
        assert second.result() != os.getpid()


class Unloadable:
    """Work that opens data which do not exist when a process unpickles it."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def __reduce__(self) -> tuple[Any, ...]:
        return open_data, (str(self._folder),)

    def __call__(self, task: object) -> object:
        return task


def test_errors_of_unpickling_the_work_arrive(tmp_path: Path) -> None:
    with (
        pytest.raises(AspEnvError, match="nowhere does not exist"),
        WorkerPool(Unloadable(tmp_path / "nowhere"), 2) as pool,
    ):
        list(pool.map([1, 2, 3]))


def test_the_initializer_runs_once_in_every_process(tmp_path: Path) -> None:
    initializer = partial(os.chdir, tmp_path)
    with WorkerPool(operator.call, 1, initializer=initializer) as pool:
        assert list(pool.map([os.getcwd] * 2)) == [str(tmp_path)] * 2


@pytest.mark.parametrize(
    ("task", "status", "message"),
    [
        (partial(signal.raise_signal, signal.SIGKILL), -9, "was killed by signal 9; if memory ran"),
        (partial(os._exit, 7), 7, "ended with exit status 7"),
    ],
    ids=["killed", "ended"],
)
def test_the_end_of_a_process_is_an_error(
    task: Callable[[], Any], status: int, message: str
) -> None:
    with pytest.raises(WorkerExitError, match=message) as caught:
        results(2, [task] * 2)
    assert caught.value.status == status


def test_the_end_of_a_process_leaves_its_neighbour_alone() -> None:
    with WorkerPool(operator.call, 2) as pool:
        killed = pool.submit(partial(signal.raise_signal, signal.SIGKILL))
        slow = pool.submit(partial(_slowly, os.getpid))
        assert isinstance(killed.exception(), WorkerExitError)
        assert slow.result() != os.getpid()


def test_an_interrupt_ends_running_tasks() -> None:
    """With both processes at tasks of an hour."""
    began = time.monotonic()
    processes: list[Any] = []

    def interrupted() -> None:
        with WorkerPool(operator.call, 2) as pool:
            for process in pool.map([os.getpid, *[partial(time.sleep, 3600.0)] * 3]):
                processes.append(process)
                raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert time.monotonic() - began < 60
    assert len(processes) == 1
    assert not exists(*processes)


def test_output_environment_and_cost_of_a_process(tmp_path: Path) -> None:
    """Both streams go to the file, also what is buffered; CPU time counts once it has ended."""
    path = tmp_path / "log.txt"
    with path.open("wb") as output:
        env = {**os.environ, "ASP_ENV_TEST": "word"}
        pool = WorkerPool(operator.call, 1, output=output, env=env)
    with pool:
        pool.submit(partial(os.system, "echo $ASP_ENV_TEST >&2")).result()
        pool.submit(partial(print, "buffered")).result()
        assert pool.cpu_s == 0.0
    assert sorted(path.read_text().split()) == ["buffered", "word"]
    assert pool.cpu_s > 0.01


SCRIPT = """
import operator, os, signal, subprocess, sys, time
from functools import partial
from asp_env.workers import WorkerPool

pool = WorkerPool(operator.call, 3)
pool.submit(os.getpid).result()
if sys.argv[1] != "ended":
    pool.submit(partial(time.sleep, 3600.0))
    pool.submit(partial(subprocess.run, ["sh", "-c", "touch started; exec sleep 3600"]))
    while not os.path.exists("started"):
        time.sleep(0.01)
    if sys.argv[1] == "killed":
        os.kill(os.getpid(), signal.SIGKILL)
    pool.terminate()
    sys.exit(5)
with pool:
    print(list(pool.map([partial(pow, 2, 3)])))
"""


def run_script(folder: Path, argument: str) -> tuple[int, bytes]:
    """Exit status and output of the script, once all processes that share its output have ended."""
    script = folder / "script.py"
    script.write_text(SCRIPT)
    env = {**os.environ, "PYTHONPATH": os.pathsep.join(path for path in sys.path if path)}
    command = [sys.executable, str(script), argument]
    done = subprocess.run(
        command, cwd=folder, stdout=subprocess.PIPE, env=env, timeout=120, check=False
    )
    return done.returncode, done.stdout


@pytest.mark.parametrize(("how", "status"), [("killed", -signal.SIGKILL), ("terminated", 5)])
def test_processes_end_with_their_parent(tmp_path: Path, how: str, status: int) -> None:
    """One of them idle, one at a task of an hour, and one with a program that takes an hour."""
    assert run_script(tmp_path, how) == (status, b"")


def test_a_script_needs_no_main_guard(tmp_path: Path) -> None:
    assert run_script(tmp_path, "ended") == (0, b"[8]\n")
