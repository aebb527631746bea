"""Kills commands at random moments, and compares what their reruns write with undisturbed runs.

    python -m tests.campaigns.crashes --kills 8 --seed 0

Every case is a command of `asp-env` on tiny data. It runs once undisturbed, while the folder that
it writes is watched: each change of a name, a size or a time stamp there is a moment. Then it is
killed at random ones of these moments (SIGKILL of its process group) and runs again. The rerun must
write the same bytes under the same names and leave nothing else behind, no process of the killed
command may go on, and nothing may block the rerun.

On a full disk (a tmpfs of a fraction of the size that is needed, mounted by root), the command must
end with one line that names a file, and leave nothing half written; once there is space, the rerun
must write the same bytes.

A study on Ray, where that is installed, runs on two nodes of this machine. In turn the command, a
worker and a node are killed; without a worker or a node the command must go on.
"""

import argparse
import fnmatch
import hashlib
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from importlib.util import find_spec
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

from tests.crossing_files import ON_ROAD, write_crossing
from tests.evaluation.study.ray_nodes import TwoNodes, two_nodes

POLL_S = 0.005
END_S = 20.0
"""Longest time that processes of a killed command may take to end. They end at once, but a busy
machine may not run them at once."""

LIMIT_S = 900.0

SHARES = (0.0, 0.4, 0.8)
"""Sizes of full disks as shares of the bytes that an undisturbed run leaves."""

VOLATILE = ("*/logs", "*/logs/*", "*events.out.tfevents*", "*progress.csv", "*/table.lock")
"""Logs, which hold times of day."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Case:
    """A command and what it writes.

    Attributes:
        command: arguments of `asp-env`; DATA stands for the data.
        rerun: arguments that the rerun has in addition if the run had begun.
        begun: file that exists once the run has begun.
        state: patterns of what an interrupted run keeps for its continuation.
        ignored: patterns of files whose bytes differ between undisturbed runs.
        own_cache: whether the cache folder is empty at the start, and compared.
        on_ray: whether the command runs on a cluster, whose address ADDRESS stands for.
        on_full_disk: exit statuses on a full disk; 0 where it works nevertheless, and 1 where it
            goes on with other parts and states what failed at the end.
    """

    command: tuple[str, ...]
    rerun: tuple[str, ...] = ()
    begun: str = ""
    state: tuple[str, ...] = ()
    ignored: tuple[str, ...] = ()
    own_cache: bool = False
    on_ray: bool = False
    on_full_disk: tuple[int, ...] = (2,)


_REPORT = ("*/report.html", "*/manifest.json")
"""They state versions and times."""

_STUDY = (
    *("study", "--out", "out", "--data", "DATA", "--methods", "constant-velocity", "idm"),
    *("--no-controls", "--max-scenarios", "3"),
)

CASES: Mapping[str, Case] = {
    "read": Case(command=("inspect", "DATA"), own_cache=True, on_full_disk=(0,)),
    "synthesize": Case(
        command=(
            *("synthesize", "out", "--site", "highway:intersection"),
            *("--recordings", "1", "--minutes", "0.05"),
        )
    ),
    "synthesize --jobs 2": Case(
        command=(
            *("synthesize", "out", "--site", "intersection", "--recordings", "2"),
            *("--locations", "2", "--minutes", "0.03", "--jobs", "2"),
        )
    ),
    "drive --jobs 2": Case(
        command=(
            *("drive", "DATA", "--out", "out", "--planner", "idm", "--predictors"),
            *("constant-velocity", "--max-scenarios", "2", "--jobs", "2"),
        ),
        ignored=_REPORT,
    ),
    "train": Case(
        command=(
            *("train", "mtp", "DATA", "--out", "out", "--view", "vectors", "--horizon", "1"),
            *("--epochs", "2", "--max-snippets", "64"),
        ),
        state=("*/unfinished*",),
    ),
    "table": Case(
        command=(
            *("table", "DATA", "--out", "out", "--predictors", "mtp", "--views", "vectors"),
            *("--horizons", "1", "--seeds", "0", "--epochs", "1", "--max-snippets", "64"),
            *("--per-recording", "50", "--jobs", "1"),
        ),
        state=("out/*",),
        ignored=(*_REPORT, "*/cost.json", "*/table.txt"),
        on_full_disk=(1, 2),
    ),
    "rl train": Case(
        command=(
            *("rl", "train", "DATA", "--out", "out", "--steps", "256", "--num-envs", "4"),
            *("--set", "n_steps=32", "n_epochs=1"),
        ),
        rerun=("--resume",),
        begun="out/config.json",
        state=("out/config.json",),
    ),
    "study": Case(command=_STUDY),
    "study --jobs 2": Case(command=(*_STUDY, "--jobs", "2")),
    "study --ray": Case(command=(*_STUDY, "--ray", "ADDRESS"), on_ray=True),
}


@dataclass(slots=True, kw_only=True)
class Outcome:
    """What became of the kills of one case."""

    moments: int = 0
    killed: int = 0
    ended_before: int = 0
    faults: list[str] = field(default_factory=list)


@dataclass(frozen=True, slots=True, kw_only=True)
class Bench:
    """Where commands run.

    Attributes:
        folder: scratch folder, removed by the caller.
        data: the data that DATA stands for.
        cache: a cache folder that is filled, for cases without one of their own.
        address: address of the Ray cluster that ADDRESS stands for.
    """

    folder: Path
    data: Path
    cache: Path
    address: str = ""

    def start(self, case: Case, where: Path, *, again: bool = False) -> subprocess.Popen[str]:
        """Starts the command of a case in a session of its own, in the folder `where`."""
        (where / "tmp").mkdir(parents=True, exist_ok=True)
        rerun = case.rerun if again and (where / case.begun).is_file() else ()
        given = {"DATA": str(self.data), "ADDRESS": self.address}
        arguments = [given.get(each, each) for each in case.command]
        path = [str(Path(__file__).parents[2]), os.environ.get("PYTHONPATH", "")]
        return subprocess.Popen(
            [sys.executable, "-m", "asp_env.cli", *arguments, *rerun],
            cwd=where,
            env={
                **os.environ,
                "ASP_ENV_CACHE": str(where / "cache" if case.own_cache else self.cache),
                "TMPDIR": str(where / "tmp"),
                "OMP_NUM_THREADS": "1",
                "PYTHONPATH": os.pathsep.join(filter(None, path)),
            },
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
            start_new_session=True,
        )


def content(where: Path, case: Case) -> dict[str, str]:
    """A hash of each file below a folder that is not volatile, and the names of all folders."""
    found: dict[str, str] = {}
    for path in sorted(where.rglob("*")):
        name = f"{path.relative_to(where)}"
        if any(fnmatch.fnmatch(name, pattern) for pattern in VOLATILE):
            continue
        ignored = path.is_dir() or any(fnmatch.fnmatch(name, each) for each in case.ignored)
        found[name] = "" if ignored else hashlib.sha256(path.read_bytes()).hexdigest()
    return found


def undisturbed(bench: Bench, case: Case, where: Path) -> int:
    """Runs a case to its end.

    Returns:
        The number of moments.

    Raises:
        RuntimeError: the command failed.
    """
    process = bench.start(case, where)
    moments = sum(1 for _ in _changes(where, process))
    _, stderr = process.communicate(timeout=LIMIT_S)
    if process.returncode != 0:
        raise RuntimeError(f"{' '.join(case.command)}: {stderr}")
    return moments


def _started(bench: Bench, case: Case, where: Path, moment: int) -> subprocess.Popen[str]:
    """Starts a case, and returns at the change of its folder with the number `moment`."""
    process = bench.start(case, where)
    for number, _ in enumerate(_changes(where, process)):
        if number == moment:
            break
    return process


def kill_once(
    bench: Bench, case: Case, where: Path, expected: Mapping[str, str], moment: int
) -> tuple[bool, str]:
    """Kills the command at a moment, runs it again and compares.

    Args:
        bench: where commands run.
        case: the case.
        where: a new folder.
        expected: content of the folder after an undisturbed run.
        moment: number of the change at which the process is killed.

    Returns:
        Whether the command was killed before its end, and the fault; empty if there is none.
    """
    process = _started(bench, case, where, moment)
    was_killed = process.poll() is None
    if was_killed:
        os.killpg(process.pid, signal.SIGKILL)
    process.communicate()
    deadline = time.monotonic() + END_S
    while orphans := _of_session(process.pid):
        if time.monotonic() > deadline:
            return was_killed, f"processes {orphans} go on"
        time.sleep(0.05)
    complete = content(where, case) == expected
    again = bench.start(case, where, again=True)
    try:
        _, stderr = again.communicate(timeout=LIMIT_S)
    except subprocess.TimeoutExpired:
        os.killpg(again.pid, signal.SIGKILL)
        return was_killed, "the rerun is blocked"
    if again.returncode != 0 and not complete:
        return was_killed, f"the rerun ends with {again.returncode}: {_brief(stderr)}"
    return was_killed, difference(expected, content(where, case))


def lose_once(
    bench: Bench,
    case: Case,
    where: Path,
    expected: Mapping[str, str],
    moment: int,
    lose: Callable[[], bool],
) -> tuple[bool, str]:
    """Loses a part of the cluster at a moment or as soon after it as there is one, and compares.

    Args:
        bench: where commands run.
        case: the case.
        where: a new folder.
        expected: content of the folder after an undisturbed run.
        moment: number of the change from which on the part is lost.
        lose: kills a part of the cluster; returns whether there was one.

    Returns:
        Whether a part was lost before the end, and the fault; empty if there is none.
    """
    process = _started(bench, case, where, moment)
    lost = False
    while process.poll() is None and not lost:
        lost = lose()
        time.sleep(POLL_S)
    _, stderr = process.communicate(timeout=LIMIT_S)
    if process.returncode != 0:
        return lost, f"ends with {process.returncode}: {_brief(stderr)}"
    return lost, difference(expected, content(where, case))


def fill_disk(bench: Bench, case: Case, where: Path, expected: Mapping[str, str], size: int) -> str:
    """Runs a case on a disk of `size` bytes, and again with enough space.

    Args:
        bench: where commands run.
        case: the case.
        where: an empty folder on a file system of its own, see `small_disk`.
        expected: content of the folder after an undisturbed run.
        size: bytes of the file system.

    Returns:
        The fault; empty if there is none.
    """
    _resize(where, size)
    process = bench.start(case, where)
    _, stderr = process.communicate(timeout=LIMIT_S)
    status = process.returncode
    if status not in case.on_full_disk or "Traceback" in stderr:
        return f"ends with {status}: {_brief(stderr)}"
    if status == 2 and (fault := _line_fault(stderr, where)):
        return fault
    half = [
        name
        for name, value in content(where, case).items()
        if value != expected.get(name)
        and not any(fnmatch.fnmatch(name, pattern) for pattern in case.state)
    ]
    if half:
        return f"half written: {half[:3]}"
    _resize(where, 1 << 28)
    again = bench.start(case, where, again=True)
    _, stderr = again.communicate(timeout=LIMIT_S)
    if again.returncode != 0:
        return f"the rerun ends with {again.returncode}: {_brief(stderr)}"
    return difference(expected, content(where, case))


def _line_fault(stderr: str, where: Path) -> str:
    """What is wrong with the error of a command on a full disk: one line that names a file."""
    lines = [line for line in stderr.splitlines() if line.startswith("asp-env: ")]
    errors = [line for line in lines if not line.startswith("asp-env: warning: ")]
    if len(errors) != 1 or not any(name in errors[0] for name in ("out", str(where))):
        return f"is no line that names a file: {_brief(stderr)}"
    return ""


def fill_together(bench: Bench, case: Case, where: Path, expected: Mapping[str, str]) -> str:
    """Runs a case twice at the same time in one folder; returns the fault."""
    both = [bench.start(case, where) for _ in range(2)]
    for process in both:
        _, stderr = process.communicate(timeout=LIMIT_S)
        if process.returncode != 0:
            return f"ends with {process.returncode}: {_brief(stderr)}"
    return difference(expected, content(where, case))


def difference(expected: Mapping[str, str], found: Mapping[str, str]) -> str:
    """What two contents differ in, in words; empty if they are equal."""
    parts = {
        "missing": sorted(set(expected) - set(found)),
        "left over": sorted(set(found) - set(expected)),
        "different": sorted(n for n in set(expected) & set(found) if expected[n] != found[n]),
    }
    return "; ".join(f"{kind}: {', '.join(names[:4])}" for kind, names in parts.items() if names)


def run_case(bench: Bench, name: str, kills: int, rng: np.random.Generator) -> Outcome:
    """Runs a case once undisturbed and kills it `kills` times."""
    case = CASES[name]
    if not case.on_ray:
        return _run_case(bench, name, kills, rng, None)
    with two_nodes() as cluster:
        return _run_case(replace(bench, address=cluster.address), name, kills, rng, cluster)


def _run_case(
    bench: Bench, name: str, kills: int, rng: np.random.Generator, cluster: TwoNodes | None
) -> Outcome:
    case, outcome = CASES[name], Outcome()
    folder = bench.folder / name.replace(" ", "-")
    outcome.moments = undisturbed(bench, case, folder / "undisturbed")
    expected = content(folder / "undisturbed", case)
    for number in range(kills):
        moment = int(rng.integers(outcome.moments))
        where = folder / str(number)
        if cluster is None or number % 3 == 0:
            killed, fault = kill_once(bench, case, where, expected, moment)
        elif number % 3 == 1:
            lose = cluster.kill_worker
            killed, fault = lose_once(bench, case, where, expected, moment, lose)
        else:
            lose = cluster.kill_second_node
            killed, fault = lose_once(bench, case, where, expected, moment, lose)
            cluster.add_second_node()
        outcome.killed += killed
        outcome.ended_before += not killed
        if fault:
            outcome.faults.append(f"killed at moment {moment} of {outcome.moments}: {fault}")
        else:
            shutil.rmtree(where)
    return outcome


@contextmanager
def bench_with_data(folder: Path) -> Iterator[Bench]:
    """A bench whose data are three made-up recordings of a crossing."""
    data = folder / "data"
    write_crossing(data, drives=(ON_ROAD,) * 3)
    bench = Bench(folder=folder, data=data, cache=folder / "cache")
    yield bench


@contextmanager
def small_disk(where: Path) -> Iterator[None]:
    """Mounts a tmpfs at an empty folder, which needs root.

    Raises:
        OSError: it cannot be mounted.
    """
    where.mkdir(parents=True)
    done = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", "size=1m", "none", str(where)],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    if done.returncode != 0:
        raise OSError(f"no tmpfs can be mounted: {done.stderr.strip()}")
    try:
        yield
    finally:
        subprocess.run(["umount", "--lazy", str(where)], check=True)


def _resize(where: Path, size: int) -> None:
    subprocess.run(["mount", "-o", f"remount,size={size}", str(where)], check=True)


def _changes(where: Path, process: subprocess.Popen[str]) -> Iterator[None]:
    """Yields once for every change of names, sizes or times, while a process runs."""
    before = _state(where)
    while process.poll() is None:
        time.sleep(POLL_S)
        state = _state(where)
        if state != before:
            before = state
            yield


def _state(folder: Path) -> list[tuple[str, int, int]]:
    state: list[tuple[str, int, int]] = []
    folders = [str(folder)]
    while folders:
        try:
            entries = sorted(os.scandir(folders.pop()), key=lambda entry: entry.name)
        except OSError:  # it has been renamed or removed
            continue
        for entry in entries:
            try:
                status = entry.stat(follow_symlinks=False)
            except OSError:
                continue
            state.append((entry.path, status.st_size, status.st_mtime_ns))
            if entry.is_dir(follow_symlinks=False):
                folders.append(entry.path)
    return state


def _of_session(session: int) -> list[int]:
    """The processes of a session that run."""
    found = []
    for path in Path("/proc").glob("[0-9]*/stat"):
        try:
            fields = path.read_text().rpartition(")")[2].split()
        except OSError:  # it has ended
            continue
        if int(fields[3]) == session and fields[0] not in "ZX":
            found.append(int(path.parent.name))
    return found


def _brief(text: str) -> str:
    return " ".join(text.split())[-300:] or "no message"


def main(argv: Sequence[str] | None = None) -> int:
    """Runs the campaign and prints a table.

    Args:
        argv: arguments, by default those of the process.

    Returns:
        The exit status: 1 if there is a fault.
    """
    parser = argparse.ArgumentParser(description="Kill commands at random moments.")
    parser.add_argument("--kills", type=int, default=8, help="kills of each case")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--cases", nargs="*", default=list(CASES), help="names of cases")
    options = parser.parse_args(argv)
    console, faults = Console(), 0
    table = Table("case", "moments", "killed", "ended before", "full disks", "faults", box=None)
    with (
        tempfile.TemporaryDirectory() as folder,
        bench_with_data(Path(folder)) as bench,
    ):
        for number, name in enumerate(options.cases):
            if CASES[name].on_ray and find_spec("ray") is None:
                console.print(f"{name}: left out, as Ray is not installed")
                continue
            rng = np.random.default_rng([options.seed, number])
            outcome = run_case(bench, name, options.kills, rng)
            disks = full_disks(bench, name, outcome)
            if CASES[name].own_cache:
                where = bench.folder / "together"
                expected = content(bench.folder / name / "undisturbed", CASES[name])
                if fault := fill_together(bench, CASES[name], where, expected):
                    outcome.faults.append(f"two at the same time: {fault}")
            table.add_row(
                name, str(outcome.moments), str(outcome.killed), str(outcome.ended_before),
                str(disks), str(len(outcome.faults)),
            )  # fmt: skip
            for fault in outcome.faults:
                console.print(f"{name}: {fault}", markup=False, soft_wrap=True)
            faults += len(outcome.faults)
    console.print(table)
    return int(faults > 0)


def full_disks(bench: Bench, name: str, outcome: Outcome) -> int:
    """Runs a case on full disks, and adds the faults; returns the number of disks.

    The sizes are fractions of what an undisturbed run leaves. Without root there are none.
    """
    case, folder = CASES[name], bench.folder / name.replace(" ", "-")
    if case.on_ray:
        return 0
    where = folder / "undisturbed"
    expected = content(where, case)
    needed = sum(path.stat().st_size for path in where.rglob("*") if path.is_file())
    disks = 0
    for share in SHARES:
        disk = folder / f"disk{share}"
        try:
            with small_disk(disk):
                fault = fill_disk(bench, case, disk, expected, max(1 << 14, int(share * needed)))
        except OSError:
            return disks
        disks += 1
        if fault:
            outcome.faults.append(f"disk of {share:.0%} of what is needed: {fault}")
    return disks


if __name__ == "__main__":
    sys.exit(main())
