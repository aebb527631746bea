"""Runs the cells of a table side by side, each in a process of its own, and records their costs."""

import json
import os
import time
from collections.abc import Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, wait
from dataclasses import dataclass
from pathlib import Path
from typing import final

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from asp_env.errors import AspEnvError
from asp_env.files import atomic_file
from asp_env.workers import WorkerExitError, WorkerPool
from predictors.experiments.cells import Cell
from predictors.experiments.job import Job, run_job

ONE_THREAD = {"OMP_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1"}
"""Environment of the processes: results do not depend on the number of cores."""
COST = "cost.json"
LOGS = "logs"


@final
class Costs:
    """CPU and wall time of every cell, over all runs of the command, in a JSON file."""

    def __init__(self, path: Path) -> None:
        """Reads the file if it exists."""
        self._path = path
        self._cells: dict[str, dict[str, float]] = {}
        if path.exists():
            self._cells = json.loads(path.read_text(encoding="utf-8"))["cells"]

    @property
    def total_cpu_s(self) -> float:
        """CPU time of all cells in seconds."""
        return sum(cell["cpu_s"] for cell in self._cells.values())

    def cpu_s(self, name: str) -> float:
        """CPU time of one cell in seconds."""
        return self._cells.get(name, {}).get("cpu_s", 0.0)

    def training_cpu_s(self, name: str) -> float | None:
        """CPU time of the training of one cell in seconds; None if it is not known."""
        return self._cells.get(name, {}).get("training_cpu_s")

    def add(self, name: str, *, cpu_s: float, wall_s: float, training_cpu_s: float) -> None:
        """Adds the cost of a process that has ended, with or without success."""
        unused = {"cpu_s": 0.0, "training_cpu_s": 0.0, "wall_s": 0.0, "processes": 0}
        cell = self._cells.setdefault(name, unused)
        cell["cpu_s"] = round(cell["cpu_s"] + cpu_s, 1)
        if "training_cpu_s" in cell:  # earlier versions did not store it
            cell["training_cpu_s"] = round(cell["training_cpu_s"] + training_cpu_s, 1)
        cell["wall_s"] = round(cell["wall_s"] + wall_s, 1)
        cell["processes"] += 1
        content = {"total_cpu_s": round(self.total_cpu_s, 1), "cells": self._cells}
        with atomic_file(self._path) as partial:
            partial.write_text(json.dumps(content, indent=1) + "\n")


@dataclass(frozen=True, slots=True, kw_only=True)
class _Running:
    pool: WorkerPool[Job, float]
    result: Future[float]
    trains: bool
    """Whether the run was not finished when the process started."""
    log: Path
    start_s: float


@final
class Campaign:
    """All cells of a table and their states.

    Each cell has a pool with one process, so that its output goes to a log file of its own, its
    CPU time can be measured, and the end of its process affects no other cell.
    """

    def __init__(self, jobs: Mapping[Cell, Job], out: Path, console: Console) -> None:
        """Stores the jobs; `run` starts them.

        Args:
            jobs: the work of every cell; each cell comes after the one that it starts from.
            out: folder of the table.
            console: console for progress.
        """
        self._jobs = jobs
        self._out = out
        self._console = console
        self._costs = Costs(out / COST)
        self._running: dict[Cell, _Running] = {}
        self._failed: dict[Cell, str] = {}
        self._done: set[Cell] = set()

    @property
    def failed(self) -> Mapping[Cell, str]:
        """Reasons of the failed cells."""
        return self._failed

    def training_cpu_s(self, cell: Cell) -> float | None:
        """CPU time of the training of a cell in seconds; None if it is not known."""
        return self._costs.training_cpu_s(cell.name)

    def run(self, processes: int) -> None:
        """Runs the cells that are not finished.

        Args:
            processes: number of cells at a time; 0 only checks the finished ones.
        """
        waiting = []
        for cell, job in self._jobs.items():
            if self._is_valid(cell, job):
                if job.done and (cell.start is None or self._jobs[cell.start].trained):
                    self._done.add(cell)
                else:
                    waiting.append(cell)
        if not processes:
            return
        columns = (
            TextColumn("{task.description}", markup=False), BarColumn(), MofNCompleteColumn(),
            TimeRemainingColumn(),
        )  # fmt: skip
        hidden = not self._console.is_terminal
        with Progress(*columns, console=self._console, transient=True, disable=hidden) as bar:
            task = bar.add_task("cells", total=len(waiting))
            try:
                while waiting or self._running:
                    waiting = self._start(waiting, processes)
                    bar.update(task, description=", ".join(cell.name for cell in self._running))
                    for cell in self._collect():
                        bar.advance(task)
                        self._report(cell, len(waiting) + len(self._running))
            finally:
                self._stop()

    def _is_valid(self, cell: Cell, job: Job) -> bool:
        """Whether the results of a cell, and of the cell that it starts from, are current."""
        try:
            if cell.start is not None and cell.start in self._failed:
                raise AspEnvError(f"{cell.start.name}, which it starts from, failed")
            job.check()
        except AspEnvError as error:
            self._failed[cell] = str(error)
            self._report(cell, len(self._jobs))
        return cell not in self._failed

    def _start(self, waiting: Sequence[Cell], processes: int) -> list[Cell]:
        """Starts as many cells as possible and returns those that still wait."""
        left = []
        for cell in waiting:
            if cell.start is not None and cell.start in self._failed:
                self._is_valid(cell, self._jobs[cell])
            elif len(self._running) < processes and (
                cell.start is None or cell.start in self._done
            ):
                self._running[cell] = self._launch(cell)
            else:
                left.append(cell)
        return left

    def _launch(self, cell: Cell) -> _Running:
        log = self._out / LOGS / f"{cell.name}.txt"
        log.parent.mkdir(parents=True, exist_ok=True)
        with log.open("ab") as file:
            pool = WorkerPool(run_job, 1, output=file, env={**os.environ, **ONE_THREAD})
        job = self._jobs[cell]
        return _Running(
            pool=pool,
            result=pool.submit(job),
            trains=not job.trained,
            log=log,
            start_s=time.monotonic(),
        )

    def _collect(self) -> list[Cell]:
        """Waits until a cell has ended and returns all cells that have ended."""
        wait([running.result for running in self._running.values()], return_when=FIRST_COMPLETED)
        ended = [cell for cell, running in self._running.items() if running.result.done()]
        for cell in ended:
            running = self._running[cell]
            running.pool.close()
            self._remove(cell)
            error = running.result.exception()
            if error is None:
                self._done.add(cell)
            else:
                self._failed[cell] = _reason(error, running.log)
        return ended

    def _remove(self, cell: Cell) -> None:
        """Removes a cell whose process has ended and records its cost."""
        running = self._running.pop(cell)
        wall_s, cpu_s = time.monotonic() - running.start_s, running.pool.cpu_s
        # A process without a result has ended while it trained, if it had to.
        training_cpu_s = cpu_s if running.trains else 0.0
        if running.result.done() and running.result.exception() is None:
            training_cpu_s = running.result.result()
        self._costs.add(cell.name, cpu_s=cpu_s, wall_s=wall_s, training_cpu_s=training_cpu_s)

    def _stop(self) -> None:
        """Terminates the running cells; the next run of the command resumes them."""
        for cell, running in list(self._running.items()):
            running.pool.terminate()
            self._remove(cell)

    def _report(self, cell: Cell, left: int) -> None:
        state = f"finished, {self._costs.cpu_s(cell.name):.0f} s of CPU time"
        if cell in self._failed:
            state = f"failed: {self._failed[cell]}"
        self._console.print(f"{cell.name}: {state} ({left} left)", soft_wrap=True, highlight=False)


def _reason(error: BaseException, log: Path) -> str:
    """The last line of the log, or the signal that ended the process."""
    if isinstance(error, WorkerExitError) and error.status < 0:
        return f"killed by signal {-error.status}; see {log}"
    lines = [
        line.strip() for line in log.read_text(encoding="utf-8", errors="replace").splitlines()
    ]
    stated = [line.removeprefix("asp-env: ") for line in lines if line]
    return f"{stated[-1] if stated else error}; see {log}"
