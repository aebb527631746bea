"""Cells per minute of a study with one process, and with one and two workers of a Ray cluster.

    python -m tests.benchmarks.study_on_ray --data suite:intersection-v1 --max-scenarios 48

Rates are from the first to the last stored cell. Without two idle cores they state how the machine
is shared, not what Ray costs.
"""

import argparse
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

from rich.console import Console
from rich.table import Table

from tests.evaluation.study.ray_nodes import two_nodes

POLL_S = 0.05
LOST_S = 30.0
"""Time after which Ray has noticed that a node is lost."""


def cells_per_minute(out: Path, options: Sequence[str]) -> tuple[int, float]:
    """Runs a study.

    Args:
        out: a new folder.
        options: options of `asp-env study`.

    Returns:
        The number of cells and their rate after the first.

    Raises:
        RuntimeError: the study failed.
    """
    command = [sys.executable, "-m", "asp_env.cli", "study", "--out", str(out), *options]
    process = subprocess.Popen(
        command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True
    )
    times: list[float] = []
    while process.poll() is None:
        count = sum(1 for _ in out.glob("cells/*/*.npz"))
        times += [time.monotonic()] * (count - len(times))
        time.sleep(POLL_S)
    _, stderr = process.communicate()
    if process.returncode != 0:
        raise RuntimeError(stderr)
    return len(times), 60 * (len(times) - 1) / (times[-1] - times[0])


def main(argv: Sequence[str] | None = None) -> None:
    """Measures and prints a table.

    Args:
        argv: arguments, by default those of the process.
    """
    parser = argparse.ArgumentParser(description="Measure cells per minute.")
    parser.add_argument("--data", default="suite:intersection-v1")
    parser.add_argument("--max-scenarios", default="48")
    given = parser.parse_args(argv)
    options = ["--data", given.data, "--max-scenarios", given.max_scenarios, "--no-controls"]
    options += ["--methods", "constant-turn-rate", "pdm+constant-turn-rate"]
    rates: dict[str, float] = {}
    table = Table("", "cells", "per minute", box=None)
    with tempfile.TemporaryDirectory() as folder, two_nodes() as cluster:
        on_ray = [*options, "--ray", cluster.address]
        for name, each in (
            ("one process", options),
            ("two Ray workers", on_ray),
            ("one Ray worker", on_ray),
        ):
            if name == "one Ray worker":
                cluster.kill_second_node()
                time.sleep(LOST_S)
            count, rates[name] = cells_per_minute(Path(folder) / name.replace(" ", "-"), each)
            table.add_row(name, str(count), f"{rates[name]:.1f}")
    Console().print(table)
    efficiency = rates["two Ray workers"] / (2 * rates["one Ray worker"])
    Console().print(f"efficiency at two workers: {efficiency:.0%}")


if __name__ == "__main__":
    main()
