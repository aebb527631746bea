"""Collisions with a braking car: replayed traffic does not react, highway-env's vehicles do.

The same recordings of highway-env's intersection are driven twice: replayed, and with vehicles that
drive themselves. The ego brakes as hard as possible from the first tick.
"""

import sys
import tempfile
from pathlib import Path

import numpy as np

from asp_env import ReplayEnv
from scenarios.synthesize import Synthesize

BRAKE = np.array([-1.0, 0.0], dtype=np.float32)


def count_hits(data: str) -> tuple[int, int]:
    """Returns the number of scenarios in which the ego is hit without fault, and of all."""
    env = ReplayEnv(data, observations=("state",), scenarios="length>=6")
    hits = 0
    for number in range(len(env.scenarios)):
        env.reset(seed=0, options={"scenario": number})
        done = hit = False
        while not done:
            _, _, terminated, truncated, info = env.step(BRAKE)
            hit |= info["collision"] and not info["at_fault"]
            done = terminated or truncated
        hits += hit
    return hits, len(env.scenarios)


def main(folder: Path, *, minutes: float = 1.0) -> dict[str, tuple[int, int]]:
    """Returns hits and scenarios by world; makes the recordings if the folder does not exist."""
    if not folder.exists():
        Synthesize(out=folder, site="highway:intersection", recordings=1, minutes=minutes).run()
    return {
        "replayed": count_hits(str(folder)),
        "reacting": count_hits(f"highway:{folder}"),
    }


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(sys.argv[1]) if len(sys.argv) > 1 else Path(temporary) / "highway"
        for world, (hits, scenarios) in main(folder).items():
            sys.stdout.write(f"{world}: hit in {hits} of {scenarios} scenarios\n")
