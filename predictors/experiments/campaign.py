"""Runs the cells of a table in processes side by side, and keeps account of what they cost."""

import json
import os
import subprocess
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import final

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from asp_env.errors import AspEnvError
from asp_env.files import atomic_file
from asp_env.workers import start
from predictors.experiments.cells import Cell
from predictors.experiments.worker import Job

ONE_THREAD = {"OMP_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1"}
POLL_S = 0.1
COST = "cost.json"
LOGS = "logs"


@final
class Costs:
    """CPU time by cell, over all starts of the command; a file of its own beside the results."""

    def __init__(self, path: Path) -> None:
        """Goes on with what the file holds."""
        self._path = path
        self._cells: dict[str, dict[str, float]] = {}
        if path.exists():
            self._cells = json.loads(path.read_text())["cells"]

    @property
    def total_cpu_s(self) -> float:
        """Of all cells."""
        return sum(cell["cpu_s"] for cell in self._cells.values())

    def cpu_s(self, name: str) -> float:
        """Of one cell."""
        return self._cells.get(name, {}).get("cpu_s", 0.0)

    def add(self, name: str, *, cpu_s: float, wall_s: float) -> None:
        """Adds a process that has ended, whatever became of it."""
        known = self._cells.setdefault(name, {"cpu_s": 0.0, "wall_s": 0.0, "processes": 0})
        known["cpu_s"] = round(known["cpu_s"] + cpu_s, 1)
        known["wall_s"] = round(known["wall_s"] + wall_s, 1)
        known["processes"] += 1
        content = {"total_cpu_s": round(self.total_cpu_s, 1), "cells": self._cells}
        with atomic_file(self._path) as partial:
            partial.write_text(json.dumps(content, indent=1) + "\n")


@dataclass(frozen=True, slots=True, kw_only=True)
class _Running:
    process: subprocess.Popen[bytes]
    log: Path
    since_s: float


@final
class Campaign:
    """All cells of a table, from the first start of the command to the last."""

    def __init__(self, jobs: Mapping[Cell, Job], out: Path, console: Console) -> None:
        """Runs nothing yet.

        Args:
            jobs: what a cell's process is to do; each cell behind the one that it starts from.
            out: the table's folder.
            console: where progress is told.
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
        """Why, by cell."""
        return self._failed

    def run(self, processes: int) -> None:
        """Runs what is not finished, so many processes at a time; with 0 nothing."""
        waiting = []
        for cell, job in self._jobs.items():
            if self._fits(cell, job):
                if job.done and (cell.start is None or self._jobs[cell.start].trained):
                    self._done.add(cell)
                else:
                    waiting.append(cell)
        if not processes:
            return
        columns = (
            TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(),
            TimeRemainingColumn(),
        )  # fmt: skip
        shown = self._console.is_terminal
        with Progress(*columns, console=self._console, transient=True, disable=not shown) as bar:
            task = bar.add_task("cells", total=len(waiting))
            try:
                while waiting or self._running:
                    waiting = self._start(waiting, processes)
                    for cell in self._reap():
                        bar.advance(task)
                        self._tell(cell, len(waiting) + len(self._running))
                    bar.update(task, description=", ".join(c.name for c in self._running))
                    if self._running:
                        time.sleep(POLL_S)
            finally:
                self._stop()

    def _fits(self, cell: Cell, job: Job) -> bool:
        """Whether what there is of a cell is what was asked for, and what it started from too."""
        try:
            self._check_start(cell)
            job.check()
        except AspEnvError as error:
            self._failed[cell] = str(error)
            self._tell(cell, len(self._jobs))
        return cell not in self._failed

    def _check_start(self, cell: Cell) -> None:
        if cell.start is not None and cell.start in self._failed:
            raise AspEnvError(f"{cell.start.name}, which it starts from, failed")

    def _start(self, waiting: Sequence[Cell], processes: int) -> list[Cell]:
        """Starts the first cells that can be; those that still wait."""
        left = []
        for cell in waiting:
            if cell.start is not None and cell.start in self._failed:
                self._fits(cell, self._jobs[cell])
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
            process = start(
                "predictors.experiments.worker",
                self._jobs[cell].dump(),
                output=file,
                env={**os.environ, **ONE_THREAD},
            )
        return _Running(process=process, log=log, since_s=time.monotonic())

    def _reap(self) -> list[Cell]:
        """Takes leave of the processes that have ended; their cells."""
        ended = []
        for cell, running in list(self._running.items()):
            if self._ended(cell, running, os.WNOHANG):
                ended.append(cell)
                if running.process.returncode == 0:
                    self._done.add(cell)
                else:
                    self._failed[cell] = _why(running)
        return ended

    def _ended(self, cell: Cell, running: _Running, options: int) -> bool:
        process = running.process
        pid, status, usage = os.wait4(process.pid, options)
        if not pid:
            return False
        process.returncode = os.waitstatus_to_exitcode(status)
        if process.stdin is not None:
            process.stdin.close()
        del self._running[cell]
        self._costs.add(
            cell.name,
            cpu_s=usage.ru_utime + usage.ru_stime,
            wall_s=time.monotonic() - running.since_s,
        )
        return True

    def _stop(self) -> None:
        """Ends what still runs; it is gone on with at the next start."""
        for running in self._running.values():
            running.process.terminate()
        for cell, running in list(self._running.items()):
            self._ended(cell, running, 0)

    def _tell(self, cell: Cell, left: int) -> None:
        what = f"finished, {self._costs.cpu_s(cell.name):.0f} s of CPU time"
        if cell in self._failed:
            what = f"failed: {self._failed[cell]}"
        self._console.print(
            f"{cell.name}: {what} ({left} to go)", soft_wrap=True, highlight=False, markup=False
        )


def _why(running: _Running) -> str:
    """The last line that a process said, or how it ended."""
    lines = [line.strip() for line in running.log.read_text(errors="replace").splitlines()]
    said = [line.removeprefix("asp-env: ") for line in lines if line]
    code = running.process.returncode
    if code < 0:
        return f"killed by signal {-code}; see {running.log}"
    return f"{said[-1] if said else f'exit status {code}'}; see {running.log}"
