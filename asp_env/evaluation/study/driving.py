"""Cells that are missing are driven, in this process or in several."""

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, wait
from dataclasses import dataclass, replace
from typing import Any, final

from asp_env.data.rollout import Rollout
from asp_env.data.source import Recordings, open_readable
from asp_env.errors import AspEnvError
from asp_env.evaluation.closed_loop.comparison import EpisodeScores, Methods
from asp_env.evaluation.study.conditions import Cell, Group
from asp_env.workers import WorkerExitError, WorkerPool

ATTEMPTS = 3
"""How often a cell is driven whose process ends before it is done."""


DriveTasks = Callable[
    [Sequence[Group], float, Sequence["Task"]], Iterator[tuple["Task", EpisodeScores]]
]
"""Drives tasks: groups, duration of a tick and tasks to tasks with their scores, in any order."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Task:
    """A cell to drive."""

    cell: Cell
    rollouts: tuple[int, ...] = ()
    """Positions in the work unit of the scenarios whose rollouts are wanted."""


@final
class CellDriver:
    """Drives cells, with data and methods that are loaded once in each process."""

    def __init__(self, groups: Sequence[Group], dt_s: float) -> None:
        """Loads nothing.

        Args:
            groups: the groups that cells refer to.
            dt_s: duration of a tick.
        """
        self._groups = groups
        self._dt_s = dt_s
        self._recordings: dict[str, Recordings] = {}
        self._methods: tuple[int, Methods] | None = None

    def add_recordings(self, data: str, recordings: Recordings) -> None:
        """States where DATA are, instead of opening them by their name."""
        self._recordings[data] = recordings

    def __reduce__(self) -> tuple[Any, ...]:
        return CellDriver, (self._groups, self._dt_s)

    def __call__(self, task: Task) -> EpisodeScores:
        """Drives a cell.

        Args:
            task: the cell.

        Returns:
            The scores, with the rollouts that the task names.

        Raises:
            AspEnvError: the data do not suit a predictor or a driver.
        """
        data = self._groups[task.cell.group].condition.data
        if data not in self._recordings:
            self._recordings[data] = open_readable(data, dt_s=self._dt_s)
        if self._methods is None or self._methods[0] != task.cell.group:
            self._methods = (task.cell.group, self._groups[task.cell.group].methods())
        scores = self._methods[1].drive(self._recordings[data], task.cell.unit)
        return replace(scores, rollouts=_chosen(scores.rollouts, task.rollouts))


def _chosen(rollouts: Sequence[Rollout], positions: Sequence[int]) -> tuple[Rollout, ...]:
    return tuple(rollouts[position] for position in positions)


def drive_tasks(
    groups: Sequence[Group], dt_s: float, tasks: Sequence[Task], jobs: int
) -> Iterator[tuple[Task, EpisodeScores]]:
    """Drives tasks, and yields each as soon as it is done.

    If a process ends, all others are started anew, and what it drove is driven again.

    Args:
        groups: the groups that cells refer to.
        dt_s: duration of a tick.
        tasks: the tasks.
        jobs: number of processes; with 1, this process drives.

    Raises:
        AspEnvError: the data do not suit a predictor or a driver, or a process has ended
            `ATTEMPTS` times in the same cell.
    """
    driver = CellDriver(groups, dt_s)
    if jobs == 1:
        for task in tasks:
            yield task, driver(task)
        return
    failed: dict[str, int] = {}
    remaining = list(tasks)
    while remaining:
        done: set[str] = set()
        try:
            for task, scores in _in_processes(driver, remaining, jobs):
                done.add(task.cell.key)
                yield task, scores
        except _TaskEndedError as error:
            key = error.task.cell.key
            failed[key] = failed.get(key, 0) + 1
            if failed[key] == ATTEMPTS:
                names = ", ".join(each.name for each in error.task.cell.unit.scenarios[:3])
                raise AspEnvError(
                    f"{error}; this happened {ATTEMPTS} times in the cell {key} (scenarios {names} "
                    "and others); cells that are done are stored, so that the study goes on from "
                    "here"
                ) from error
        remaining = [task for task in remaining if task.cell.key not in done]


class _TaskEndedError(Exception):
    """The process that drove a task has ended."""

    def __init__(self, task: Task, error: WorkerExitError) -> None:
        self.task = task
        super().__init__(str(error))


def _in_processes(
    driver: Callable[[Task], EpisodeScores], tasks: Sequence[Task], jobs: int
) -> Iterator[tuple[Task, EpisodeScores]]:
    with WorkerPool(driver, jobs) as pool:
        waiting: dict[Future[EpisodeScores], Task] = {pool.submit(task): task for task in tasks}
        while waiting:
            finished, _ = wait(waiting, return_when=FIRST_COMPLETED)
            ended: _TaskEndedError | None = None
            for future in sorted(finished, key=lambda each: waiting[each].cell.key):
                task = waiting.pop(future)
                try:
                    scores = future.result()
                except WorkerExitError as error:
                    ended = ended or _TaskEndedError(task, error)
                    continue
                yield task, scores
            if ended is not None:
                raise ended
