"""A car that brakes to a stand: replayed traffic drives into it, highway-env's vehicles do not.

The same recordings of highway-env's intersection are driven twice: replayed, and with the vehicles
driving themselves. The ego brakes as hard as it can from the first tick on.
"""

import sys
import tempfile
from pathlib import Path

import numpy as np

from asp_env.envs.replay import ReplayEnv
from scenarios.synthesize import Synthesize

BRAKE = np.array([-1.0, 0.0], dtype=np.float32)


def count_hits(data: str) -> tuple[int, int]:
    """In how many scenarios the stopped car is hit by others, and how many scenarios there are."""
    env = ReplayEnv(data, observations=("state",), scenarios="length>=6")
    hits = 0
    for number in range(len(env.scenarios)):
        env.reset(seed=0, options={"scenario": number})
        over = hit = False
        while not over:
            _, _, terminated, truncated, info = env.step(BRAKE)
            hit |= info["collision"] and not info["at_fault"]
            over = terminated or truncated
        hits += hit
    return hits, len(env.scenarios)


def main(folder: Path, *, minutes: float = 1.0) -> dict[str, tuple[int, int]]:
    """Hits and scenarios by world, on recordings that are made if the folder does not exist."""
    if not folder.exists():
        Synthesize(out=folder, site="highway:intersection", recordings=1, minutes=minutes).run()
    return {
        "replayed": count_hits(str(folder)),
        "reacting": count_hits(f"highway:{folder}"),
    }


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as aside:
        given = Path(sys.argv[1]) if len(sys.argv) > 1 else Path(aside) / "highway"
        for world, (hits, scenarios) in main(given).items():
            sys.stdout.write(f"{world}: hit in {hits} of {scenarios} scenarios\n")
