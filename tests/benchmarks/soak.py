"""Memory, open files, threads and processes over a long run: `make soak`.

    python -m tests.benchmarks.soak [--minutes 60] [--out soak]

One process does in rounds what users do: it makes, resets, steps, renders and closes single, vector
and parallel environments in replayed and in highway-env's traffic, loads predictors, evaluates,
drives and writes reports, also with worker processes, and reads a folder of data that no earlier
round has read. After each part it writes a line to `soak.csv`. At the end it draws `soak.png` and
compares the rounds after the first fifth: the median of the last quarter of them may exceed that of
the first quarter by no more than `MOST_GROWTH`, else the exit status is 1.
"""

import argparse
import contextlib
import csv
import io
import os
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, fields
from pathlib import Path

import gymnasium
import numpy as np

from asp_env.cli import main as asp_env_command
from asp_env.data.predictor import load_predictor
from asp_env.envs.parallel import ParallelReplayEnv
from asp_env.envs.replay import ReplayEnv
from asp_env.envs.vector import ReplayVectorEnv
from tests.benchmarks.memory import resident_mib
from tests.crossing_files import ON_ROAD, write_crossing

STEPS = 60
"""Steps of each environment in a round."""

WORKERS_EVERY = 5
"""Rounds between those that start worker processes."""

WARM_UP = 0.2
"""Share of the rounds that are not compared: imports, compilation and caches that fill."""

MOST_GROWTH = {"rss_mib": 20.0, "open_files": 0.0, "threads": 0.0, "children": 0.0}
"""Largest growth between the medians of the first and the last quarter of the rounds compared.
20 MiB per hour is about what the allocator's arenas vary by."""

PREDICTORS = ("constant-velocity", "ffw-asp:pretrained")


@dataclass(frozen=True, slots=True, kw_only=True)
class Sample:
    """Use of resources after a part of a round."""

    seconds: float
    round: int
    part: str
    rss_mib: float
    open_files: int
    threads: int
    children: int


def single(number: int, folder: Path) -> None:
    """Environments with rasters, vectors, forecasts, other traffic, rendering and snapshots."""
    del folder
    for options in (
        {"observations": ("raster", "state"), "raster_px": (90, 60), "render_mode": "rgb_array"},
        {"observations": ("vectors", "actions", "state", "route"), "traffic": "idm"},
        {"observations": ("vectors",), "predictor": "constant-velocity"},
    ):
        env = ReplayEnv("sample:intersection", **options)
        _drive_one(env, number)
        env.restore(env.snapshot())
        if env.render_mode is not None:
            env.render()
        env.close()


def vector(number: int, folder: Path) -> None:
    """A batch of 16 environments."""
    del folder
    envs = ReplayVectorEnv(16, "sample:roundabout", observations=("vectors", "state"))
    _drive_batch(envs, number)
    envs.close()


def parallel(number: int, folder: Path) -> None:
    """All vehicles of a recording, each by its own actions."""
    del folder
    env = ParallelReplayEnv("sample:intersection", observations=("vectors", "state"), max_agents=8)
    env.reset(seed=number)
    rng = np.random.default_rng(number)
    for _ in range(STEPS):
        env.step({name: rng.uniform(-0.1, 0.1, 2) for name in env.agents})
        if not env.agents:
            env.reset()
    env.close()


def highway(number: int, folder: Path) -> None:
    """Highway-env's traffic, single and as a batch."""
    del folder
    env = gymnasium.make("asp_env/HighwayRoundabout-v0", observations=("vectors", "state"))
    _drive_one(env, number)
    env.close()
    envs = gymnasium.make_vec(
        "asp_env/HighwayIntersection-v0",
        num_envs=4,
        vectorization_mode="vector_entry_point",
        observations=("state",),
    )
    _drive_batch(envs, number)
    envs.close()


def predictors(number: int, folder: Path) -> None:
    """Predictors, loaded anew, at the scenes of an environment."""
    del folder
    env = ReplayEnv("sample:roundabout", observations=("state",))
    env.reset(seed=number)
    for name in PREDICTORS:
        predictor = load_predictor(name, horizon=15, dt_s=env.dt_s)
        for _ in range(3):
            predictor.predict(env.scene())
    env.close()


def evaluate(number: int, folder: Path) -> None:
    """Open loop, with its report."""
    del number
    _command("evaluate", "sample:intersection", "--max-states", "20", "--out", folder / "evaluated")


def drive(number: int, folder: Path) -> None:
    """Closed loop, with its report; in some rounds in two processes."""
    jobs = 2 if number % WORKERS_EVERY == 0 else 1
    for planner in ("contingency", "sampling"):
        _command(
            "drive", "sample:roundabout", "--max-scenarios", "2", "--planner", planner,
            "--jobs", jobs, "--out", folder / planner,
        )  # fmt: skip


def other_data(number: int, folder: Path) -> None:
    """A folder that no earlier round has read, with a cache of its own."""
    data = write_crossing(folder / "data", drives=(ON_ROAD,), seconds=12.0 + number % 100 / 25)
    with _environment("ASP_ENV_CACHE", str(folder / "cache")):
        _command("inspect", data)
        envs = ReplayVectorEnv(4, str(data), observations=("vectors", "raster"), raster_px=(90, 60))
        _drive_batch(envs, number)
        envs.close()


PARTS: tuple[Callable[[int, Path], None], ...] = (
    single, vector, parallel, highway, predictors, evaluate, drive, other_data,
)  # fmt: skip


def _drive_one(env: gymnasium.Env, number: int) -> None:
    env.reset(seed=number)
    rng = np.random.default_rng(number)
    for _ in range(STEPS):
        *_, terminated, truncated, _ = env.step(rng.uniform(-0.1, 0.1, 2))
        if terminated or truncated:
            env.reset()


def _drive_batch(envs: gymnasium.vector.VectorEnv, number: int) -> None:
    envs.reset(seed=number)
    rng = np.random.default_rng(number)
    for _ in range(STEPS):
        envs.step(rng.uniform(-0.1, 0.1, (envs.num_envs, 2)))


def _command(*words: object) -> None:
    """Runs a command of `asp-env` in this process, without its output."""
    with contextlib.redirect_stdout(io.StringIO()) as printed:
        status = asp_env_command([str(word) for word in words])
    if status:
        raise RuntimeError(f"asp-env {words}: exit status {status}\n{printed.getvalue()}")


@contextmanager
def _environment(name: str, value: str) -> Iterator[None]:
    before = os.environ.get(name)
    os.environ[name] = value
    try:
        yield
    finally:
        os.environ.pop(name)
        if before is not None:
            os.environ[name] = before


def take(seconds: float, number: int, part: str) -> Sample:
    """The present use of resources."""
    resident = resident_mib()  # collects garbage
    task = Path("/proc/self/task")
    children = [(each / "children").read_text().split() for each in task.iterdir()]
    return Sample(
        seconds=round(seconds, 1),
        round=number,
        part=part,
        rss_mib=round(resident, 1),
        open_files=len(list(Path("/proc/self/fd").iterdir())),
        threads=max(threading.active_count(), len(list(task.iterdir()))),
        children=sum(len(each) for each in children),
    )


def soak(out: Path, minutes: float) -> list[Sample]:
    """Runs rounds for a time and writes `soak.csv` as they go."""
    begin, number, samples = time.monotonic(), 0, []
    out.mkdir(parents=True, exist_ok=True)
    with (out / "soak.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, [each.name for each in fields(Sample)])
        writer.writeheader()
        while time.monotonic() - begin < 60 * minutes:
            with tempfile.TemporaryDirectory(prefix="soak-") as folder:
                for part in PARTS:
                    part(number, Path(folder))
                    samples.append(take(time.monotonic() - begin, number, part.__name__))
                    writer.writerow(asdict(samples[-1]))
                    file.flush()
            number += 1
    return samples


def growth(samples: list[Sample]) -> dict[str, float]:
    """How much each resource grew from the first to the last quarter of the rounds compared.

    Only the samples at the end of a round are used, since parts differ in what they hold.
    """
    ends = [sample for sample in samples if sample.part == PARTS[-1].__name__]
    after = ends[int(WARM_UP * len(ends)) :]
    quarter = max(len(after) // 4, 1)
    return {
        name: float(
            np.median([getattr(sample, name) for sample in after[-quarter:]])
            - np.median([getattr(sample, name) for sample in after[:quarter]])
        )
        for name in MOST_GROWTH
    }


def draw(samples: list[Sample], path: Path) -> None:
    """Draws the resources over time."""
    from matplotlib.figure import Figure  # installed with stable-baselines3

    labels = {"rss_mib": "resident memory, MiB", "open_files": "open files"}
    labels |= {"threads": "threads", "children": "child processes"}
    figure = Figure(figsize=(8, 6), layout="constrained")
    axes = figure.subplots(4, 1, sharex=True)
    for axis, (name, label) in zip(axes, labels.items(), strict=True):
        minutes = [sample.seconds / 60 for sample in samples]
        axis.plot(minutes, [getattr(sample, name) for sample in samples], linewidth=0.8)
        most = max(getattr(sample, name) for sample in samples)
        axis.set_ylim(0, 1.2 * most + 1)
        axis.set_ylabel(label, fontsize=8)
        axis.grid(alpha=0.3)
    axes[-1].set_xlabel("minutes")
    figure.savefig(path, dpi=100)


def main() -> int:
    """Runs the soak, writes its figures, and prints what grew."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--minutes", type=float, default=60.0)
    parser.add_argument("--out", type=Path, default=Path("soak"))
    args = parser.parse_args()
    samples = soak(args.out, args.minutes)
    draw(samples, args.out / "soak.png")
    grown = growth(samples)
    rounds = samples[-1].round + 1
    sys.stdout.write(f"{rounds} rounds in {samples[-1].seconds / 60:.0f} minutes\n")
    for name, value in grown.items():
        sys.stdout.write(f"{name}: grew by {value:.1f}, {MOST_GROWTH[name]:.0f} are allowed\n")
    return int(any(value > MOST_GROWTH[name] for name, value in grown.items()))


if __name__ == "__main__":
    sys.exit(main())
