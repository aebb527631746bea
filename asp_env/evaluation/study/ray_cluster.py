"""Cells are driven on a Ray cluster; needs the extra `ray`.

Every cell is a Ray task of one core. Ray runs the tasks of workers and nodes that are lost again,
and this process stores each result as soon as it arrives, so results are the same byte for byte as
those of one process. Nodes must have the same code and versions, which each task checks. Ray
pickles what it sends: use a cluster to which only trusted processes have access.
"""

import logging
import os
import socket
import warnings
from collections.abc import Iterator, Mapping, Sequence
from hashlib import sha256
from pathlib import Path
from typing import Any

from asp_env.data.cache import get_or_create
from asp_env.data.source import open_readable, scheme_of
from asp_env.errors import AspEnvError, MissingExtraError
from asp_env.evaluation.closed_loop.comparison import EpisodeScores
from asp_env.evaluation.study.conditions import Group
from asp_env.evaluation.study.driving import CellDriver, Task
from asp_env.evaluation.study.identity import CORE, package_hash, versions

MAX_RETRIES = 10
"""How often Ray runs a cell again whose worker or node is lost."""

AHEAD = 4
"""Number of tasks per core of the cluster that are submitted at a time, so that the object store
holds few results."""

CONNECT_S = 10.0
"""Longest time that a connection to the address of a cluster may take."""

CONNECT_ATTEMPTS = "2"
"""How often Ray tries to connect, which takes it up to 45 s each time."""

Files = Mapping[str, bytes]
"""Content of the files of a folder by their path in it."""


def drive_on_ray(
    groups: Sequence[Group],
    dt_s: float,
    tasks: Sequence[Task],
    address: str,
    *,
    send_data: bool = False,
) -> Iterator[tuple[Task, EpisodeScores]]:
    """Drives tasks on a cluster, and yields each as soon as it is done.

    Args:
        groups: the groups that cells refer to.
        dt_s: duration of a tick.
        tasks: the tasks.
        address: address of the cluster, or `auto` for the one that runs on this machine.
        send_data: whether the files of DATA that are folders are sent through the object store;
            otherwise every node must see them under the same path.

    Raises:
        MissingExtraError: Ray is not installed.
        AspEnvError: there is no cluster at the address, a node has other code or data, or the data
            do not suit a predictor or a driver.
    """
    ray = _connected(address)
    try:
        data = {group.condition.data for group in groups}
        sent = {name: _files_of(name) for name in data} if send_data else {}
        state = ray.put((_Setup(groups, dt_s, sent), package_hash(CORE), versions()))
        remote = ray.remote(num_cpus=1, max_retries=MAX_RETRIES)(_drive)
        most = max(1, int(ray.cluster_resources().get("CPU", 1))) * AHEAD
        remaining, running = list(reversed(tasks)), dict[Any, Task]()
        while remaining or running:
            while remaining and len(running) < most:
                task = remaining.pop()
                running[remote.remote(state, task)] = task
            for reference in ray.wait(list(running), num_returns=1)[0]:
                yield running.pop(reference), _result(ray, reference)
    finally:
        ray.shutdown()


class _Setup:
    """What every worker needs to drive cells of a study."""

    def __init__(
        self, groups: Sequence[Group], dt_s: float, sent: Mapping[str, Files | None]
    ) -> None:
        self.groups = groups
        self.dt_s = dt_s
        self.sent = sent

    def driver(self) -> CellDriver:
        """The driver, for which files that were sent are written to this node's cache."""
        driver = CellDriver(self.groups, self.dt_s)
        for data, files in self.sent.items():
            if files is not None:
                driver.add_recordings(data, open_readable(_written(data, files), dt_s=self.dt_s))
        return driver


_DRIVERS: dict[str, CellDriver] = {}
"""The driver of the study that this worker drives, by Ray's number of the job."""


def _drive(state: tuple[_Setup, str, Mapping[str, str]], task: Task) -> EpisodeScores:
    """Drives a cell in a worker."""
    import ray  # pyright: ignore[reportMissingImports]

    setup, code, expected = state
    found = versions()
    if package_hash(CORE) != code or found != expected:
        different = [name for name in expected if found.get(name) != expected[name]]
        what = ", ".join(different) or "the code of asp_env"
        raise AspEnvError(
            f"the Ray node {ray.util.get_node_ip_address()} has another version of {what}; install "
            "the same versions on all nodes"
        )
    job = ray.get_runtime_context().get_job_id()
    if job not in _DRIVERS:
        _DRIVERS.clear()
        _DRIVERS[job] = setup.driver()
    return _DRIVERS[job](task)


def _connected(address: str) -> Any:
    """The module `ray`, connected to a cluster.

    Raises:
        MissingExtraError: Ray is not installed.
        AspEnvError: there is no cluster at the address.
    """
    os.environ.setdefault("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")
    os.environ.setdefault("RAY_NUM_REDIS_GET_RETRIES", CONNECT_ATTEMPTS)
    try:
        import ray  # pyright: ignore[reportMissingImports]
    except ModuleNotFoundError as error:
        raise MissingExtraError("ray", "ray", "--ray") from error
    try:
        _check_reachable(address)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            ray.init(
                address=address,
                log_to_driver=False,
                logging_level=logging.ERROR,
                runtime_env={"env_vars": {"OMP_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1"}},
            )
    except (OSError, ValueError, RuntimeError) as error:
        reason = " ".join(str(error).split())
        raise AspEnvError(
            f"--ray {address}: no cluster ({reason}); start one by `ray start --head`, or leave "
            "--ray out"
        ) from error
    return ray


def _check_reachable(address: str) -> None:
    """Connects to HOST:PORT and disconnects; Ray itself would try for a quarter of an hour.

    Raises:
        OSError: nothing answers at the address.
    """
    host, _, port = address.rpartition(":")
    if host and port.isdecimal() and "://" not in host:
        socket.create_connection((host.strip("[]"), int(port)), timeout=CONNECT_S).close()


def _result(ray: Any, reference: Any) -> EpisodeScores:
    try:
        return ray.get(reference)
    except ray.exceptions.RayTaskError as error:
        cause = error.as_instanceof_cause()
        if isinstance(cause, AspEnvError | OSError):
            raise AspEnvError(str(error.cause or cause)) from error
        raise
    except ray.exceptions.RayError as error:
        reason = " ".join(str(error).split())
        raise AspEnvError(f"a Ray task was lost {MAX_RETRIES} times: {reason}") from error


def _files_of(data: str) -> Files | None:
    """Content of the files of DATA, None for data that each node makes itself."""
    if scheme_of(data) is not None:
        return None
    folder = Path(data)
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


def _written(data: str, files: Files) -> str:
    """A folder in the cache of this node with the files."""
    name = Path(data).name

    def make(folder: Path) -> None:
        for path, content in files.items():
            target = folder / name / path
            target.parent.mkdir(parents=True, exist_ok=True)
            target.write_bytes(content)

    total = sha256()
    for path, content in files.items():
        total.update(f"{path}\0{len(content)}\0".encode())
        total.update(content)
    return str(get_or_create("sent", total.hexdigest(), make) / name)
