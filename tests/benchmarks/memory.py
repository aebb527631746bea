"""Does memory grow? 2,000 resets and 200,000 steps of one environment, and of 64 side by side.

    python -m tests.benchmarks.memory [--data DATA] [--resets 2000] [--steps 200000]

Prints the resident memory in MiB as it goes; growth counts from after the first tenth.
"""

import argparse
import gc
import resource
import sys
from pathlib import Path

import numpy as np

from asp_env.envs.replay import ReplayEnv
from asp_env.envs.vector import ReplayVectorEnv

PARTS = ("vectors", "actions", "state", "route")


def resident_mib() -> float:
    """Memory that the process holds now."""
    gc.collect()
    pages = Path("/proc/self/statm")
    if pages.exists():
        return int(pages.read_text().split()[1]) * resource.getpagesize() / 2**20
    most = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return most / (2**20 if sys.platform == "darwin" else 2**10)


def drive_one(data: str, *, resets: int, steps: int) -> list[float]:
    """Memory after each tenth of the resets, each with its share of the steps."""
    env = ReplayEnv(data, observations=PARTS)
    rng = np.random.default_rng(0)
    env.reset(seed=0)
    seen = []
    for number in range(resets):
        env.reset()
        for _ in range(steps // resets):
            told = env.step(rng.uniform(-0.1, 0.1, size=2))
            if told[2] or told[3]:
                env.reset()
        if (number + 1) % max(resets // 10, 1) == 0:
            seen.append(resident_mib())
    return seen


def drive_many(data: str, *, count: int, steps: int) -> list[float]:
    """Memory after each tenth of the steps of all together."""
    envs = ReplayVectorEnv(count, data, observations=PARTS)
    rng = np.random.default_rng(0)
    envs.reset(seed=0)
    rounds, seen = steps // count, []
    for number in range(rounds):
        envs.step(rng.uniform(-0.1, 0.1, size=(count, 2)))
        if (number + 1) % max(rounds // 10, 1) == 0:
            seen.append(resident_mib())
    return seen


def main() -> None:
    """Measures and prints."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", default="sample:intersection")
    parser.add_argument("--resets", type=int, default=2000)
    parser.add_argument("--steps", type=int, default=200_000)
    args = parser.parse_args()
    alone = drive_one(args.data, resets=args.resets, steps=args.steps)
    many = drive_many(args.data, count=64, steps=args.steps)
    for name, seen in (("one environment", alone), ("64 side by side", many)):
        row = ", ".join(f"{each:.1f}" for each in seen)
        sys.stdout.write(f"{name}: {row} MiB; grows by {seen[-1] - seen[0]:.1f} MiB\n")


if __name__ == "__main__":
    main()
