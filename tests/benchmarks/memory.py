"""Memory use over 2,000 resets and 200,000 steps of one environment, and of a batch of 64.

    python -m tests.benchmarks.memory [--data DATA] [--resets 2000] [--steps 200000]

Prints the resident memory after each tenth of the run; growth is relative to the first tenth.
"""

import argparse
import gc
import resource
import sys
from pathlib import Path

import numpy as np

from asp_env.envs.replay import ReplayEnv
from asp_env.envs.vector import ReplayVectorEnv

OBSERVATIONS = ("vectors", "actions", "state", "route")


def resident_mib() -> float:
    """Resident memory of this process, MiB."""
    gc.collect()
    pages = Path("/proc/self/statm")
    if pages.exists():
        return int(pages.read_text().split()[1]) * resource.getpagesize() / 2**20
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / (2**20 if sys.platform == "darwin" else 2**10)


def drive_one(data: str, *, resets: int, steps: int) -> list[float]:
    """Memory after each tenth of the resets of one environment, MiB; the resets share the steps."""
    env = ReplayEnv(data, observations=OBSERVATIONS)
    rng = np.random.default_rng(0)
    env.reset(seed=0)
    memory = []
    for number in range(resets):
        env.reset()
        for _ in range(steps // resets):
            *_, terminated, truncated, _ = env.step(rng.uniform(-0.1, 0.1, size=2))
            if terminated or truncated:
                env.reset()
        if (number + 1) % max(resets // 10, 1) == 0:
            memory.append(resident_mib())
    return memory


def drive_many(data: str, *, count: int, steps: int) -> list[float]:
    """Memory after each tenth of the steps of a batch, MiB; its environments share the steps."""
    envs = ReplayVectorEnv(count, data, observations=OBSERVATIONS)
    rng = np.random.default_rng(0)
    envs.reset(seed=0)
    rounds, memory = steps // count, []
    for number in range(rounds):
        envs.step(rng.uniform(-0.1, 0.1, size=(count, 2)))
        if (number + 1) % max(rounds // 10, 1) == 0:
            memory.append(resident_mib())
    return memory


def main() -> None:
    """Runs both measurements and prints them."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", default="sample:intersection")
    parser.add_argument("--resets", type=int, default=2000)
    parser.add_argument("--steps", type=int, default=200_000)
    args = parser.parse_args()
    single = drive_one(args.data, resets=args.resets, steps=args.steps)
    batch = drive_many(args.data, count=64, steps=args.steps)
    for name, memory in (("one environment", single), ("batch of 64", batch)):
        row = ", ".join(f"{each:.1f}" for each in memory)
        sys.stdout.write(f"{name}: {row} MiB; growth {memory[-1] - memory[0]:.1f} MiB\n")


if __name__ == "__main__":
    main()
