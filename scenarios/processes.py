"""Traffic is written in several processes, with a progress bar."""

from collections.abc import Callable
from contextlib import nullcontext

from rich.progress import track

from asp_env.arguments import check_jobs
from asp_env.console import text_console
from asp_env.workers import WorkerPool


def run_with_progress(
    work: Callable[[int], None], count: int, title: str, *, jobs: int, progress: bool
) -> None:
    """Calls a function with the numbers from 0 to `count - 1`, each in any of several processes.

    Args:
        work: the function; processes need that it can be pickled.
        count: number of calls.
        title: text beside the progress bar, which is on stderr.
        jobs: number of processes; with 1, this process does all.
        progress: whether to show the progress bar.

    Raises:
        AspEnvError: `jobs` is out of range, a process has ended, or as the function raises it.
    """
    check_jobs(jobs)
    processes = min(jobs, count)
    with WorkerPool(work, processes) if processes > 1 else nullcontext() as pool:
        done = pool.map(range(count)) if pool is not None else map(work, range(count))
        shown = track(
            done, title, total=count, console=text_console(stderr=True), disable=not progress
        )
        for _ in shown:
            pass
