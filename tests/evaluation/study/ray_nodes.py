"""A Ray cluster of two nodes on this machine, in a process of its own.

    python -m tests.evaluation.study.ray_nodes

prints the address of the cluster and the process of the second node. Each line on the standard
input adds a node and prints its process; at its end the cluster ends.
"""

import os
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import IO

TASK = b"ray::_drive"
"""Start of the title of a worker that drives a cell."""

_PATIENT = {
    "RAY_ENABLE_UV_RUN_RUNTIME_ENV": "0",
    "RAY_agent_register_timeout_ms": "300000",
    "RAY_health_check_timeout_ms": "60000",
}
"""Settings of Ray for a busy machine."""


class TwoNodes:
    """A running cluster: a head and a second node, with one core each."""

    def __init__(self, process: subprocess.Popen[str]) -> None:
        """Waits for the cluster.

        Args:
            process: the process that owns the cluster.
        """
        assert process.stdin is not None
        assert process.stdout is not None
        self._owner = process.pid
        self._stdin: IO[str] = process.stdin
        self._stdout: IO[str] = process.stdout
        self.address = self._stdout.readline().strip()
        self._second = int(self._stdout.readline())

    def kill_second_node(self) -> bool:
        """Kills the second node, with which its workers end; returns whether there was one."""
        os.kill(self._second, signal.SIGKILL)
        return True

    def add_second_node(self) -> None:
        """Starts a node in place of one that was killed."""
        self._stdin.write("\n")
        self._stdin.flush()
        self._second = int(self._stdout.readline())

    def kill_worker(self) -> bool:
        """Kills a worker that drives a cell; returns whether there was one."""
        for pid in _descendants(self._owner):
            try:
                if (Path("/proc") / str(pid) / "cmdline").read_bytes().startswith(TASK):
                    os.kill(pid, signal.SIGKILL)
                    return True
            except OSError:  # it has ended
                continue
        return False


@contextmanager
def two_nodes() -> Iterator[TwoNodes]:
    """A cluster of two nodes with one core each."""
    process = subprocess.Popen(
        [sys.executable, "-m", "tests.evaluation.study.ray_nodes"],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True,
        env={**os.environ, **_PATIENT},
        cwd=Path(__file__).parents[3],
    )  # fmt: skip
    with process:  # closes its standard input, and waits
        yield TwoNodes(process)


def _descendants(pid: int) -> list[int]:
    """Processes that a process or one of its descendants has started, and that run."""
    parents: dict[int, int] = {}
    for path in Path("/proc").glob("[0-9]*/stat"):
        try:
            fields = path.read_text().rpartition(")")[2].split()
        except OSError:  # it has ended
            continue
        parents[int(path.parent.name)] = int(fields[1])
    found = [pid]
    for each in found:
        found += [child for child, parent in parents.items() if parent == each]
    return found[1:]


_LEAN = {
    "num_cpus": 1,
    "include_dashboard": False,
    "include_log_monitor": False,
    "no_monitor": True,
}
"""Options of a node without the processes that these tests do not need."""


def _agent_ports() -> dict[str, int]:
    """Free ports for the agents of a node, which does not wait for them then.

    On a busy machine they start too slowly for the time limit of Ray.
    """
    names = ("metrics_agent_port", "dashboard_agent_listen_port", "runtime_env_agent_port")
    with ExitStack() as stack:
        sockets = [stack.enter_context(socket.socket()) for _ in names]
        for each in sockets:
            each.bind(("", 0))
        return {name: s.getsockname()[1] for name, s in zip(names, sockets, strict=True)}


def _main() -> None:
    from ray.cluster_utils import Cluster  # pyright: ignore[reportMissingImports]

    def show(*lines: object) -> None:
        print(*lines, sep="\n", file=sys.__stdout__, flush=True)

    def second() -> int:
        node = cluster.add_node(**_LEAN, **_agent_ports())
        return node.all_processes["raylet"][0].process.pid

    # The nodes have the address of this machine: Ray replaces 127.0.0.1 by it when it connects.
    cluster = Cluster(initialize_head=True, head_node_args={**_LEAN, **_agent_ports()})
    try:
        show(cluster.address, second())
        for _ in sys.stdin:
            show(second())
    finally:
        cluster.shutdown()


if __name__ == "__main__":
    _main()
