"""Measurements: medians of processor time, memory bandwidth, and latencies of predictors."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from time import perf_counter, process_time

import numpy as np
from rich.table import Table

from asp_env.data.recording import ticks
from asp_env.data.scene import Scene
from asp_env.data.snippets import gather_scene, index_snippets
from asp_env.data.source import Recordings
from asp_env.errors import AspEnvError
from asp_env.evaluation.selection import load_predictors, no_data_error, short_names

REPEATS = 5
COPY_BYTES = 256 * 2**20
"""Size of a copy that exceeds all caches."""

AGENTS = (1, 16, 64)
"""Numbers of agents for which latencies are measured."""
HORIZON_S = 3.0
REFERENCE = "constant-velocity"
WARM_UP = 3
"""Calls that are not timed."""
CALLS = 200
MAX_DURATION_S = 20.0
"""Calls end after this time, but not before `MIN_CALLS`. Chosen by hand."""
MIN_CALLS = 10


@dataclass(frozen=True, slots=True, kw_only=True)
class Rate:
    """A measured rate: a row of a table."""

    name: str
    per_s: float
    unit: str
    bytes_each: int = 0
    """Bytes that each item writes at least; 0 if this is not meaningful."""
    reference_per_s: float | None = None
    """Rate of a reference implementation in the same run, in the same unit."""
    reference: str = ""


def median_s(work: Callable[[], object], prepare: Callable[[], object] = lambda: None) -> float:
    """Median processor time of `REPEATS` calls after an untimed one.

    The time of this process alone is measured, which reduces the influence of other processes.

    Args:
        work: The function to time.
        prepare: A function that is called before each call of `work` and is not timed.

    Returns:
        The time of a call, s.
    """
    durations = []
    for _ in range(1 + REPEATS):
        prepare()
        start = process_time()
        work()
        durations.append(process_time() - start)
    return float(np.median(durations[1:]))


def copy_bandwidth() -> float:
    """Bytes per second that a large copy writes on one core."""
    source, target = np.ones(COPY_BYTES, dtype=np.uint8), np.zeros(COPY_BYTES, dtype=np.uint8)
    return COPY_BYTES / median_s(lambda: np.copyto(target, source))


def write_bandwidth() -> float:
    """Bytes per second that filling full-size rasters one after the other writes."""
    target = np.zeros((256, 12, 360, 240), dtype=np.uint8)
    return target.nbytes / median_s(lambda: target.fill(1))


@dataclass(frozen=True, slots=True, kw_only=True)
class Latency:
    """Time that a predictor takes to forecast the agents of a scene."""

    predictor: str
    agents: int
    distinct: int
    """Number of different agents; the others are repetitions."""
    calls: int
    median_s: float
    p99_s: float
    """The 99th percentile; near the maximum if there are fewer than 100 calls."""
    ratio: float
    """The median relative to that of constant velocity for the same scene."""


def measure_latencies(
    recordings: Recordings, names: Sequence[str], *, dt_s: float
) -> list[Latency]:
    """Measures constant velocity and other predictors for 1, 16 and 64 agents.

    The scene is the tick with the most targets. If it has fewer targets than agents are required,
    targets are repeated; each repetition is rasterized and forecast separately.

    Args:
        recordings: The recordings that the scene is taken from.
        names: Names of predictors, as `load_predictor` takes them.
        dt_s: Length of a tick.

    Raises:
        AspEnvError: A predictor cannot be loaded or is privileged, or there is no target.
    """
    all_names = list(dict.fromkeys((REFERENCE, *names)))
    predictors = load_predictors(all_names, horizon=ticks(HORIZON_S, dt_s), dt_s=dt_s)
    if privileged := [predictor.name for predictor in predictors if predictor.privileged]:
        raise AspEnvError(f"--predictors: {privileged[0]} is privileged and computes no forecast")
    scene, short = busiest_scene(recordings, dt_s=dt_s), short_names(all_names)
    latencies = []
    for agents in AGENTS:
        repeated = scene.with_targets(np.resize(scene.targets, (agents, 2)))
        reference_s = None
        for name, predictor in zip(all_names, predictors, strict=True):
            durations = durations_s(lambda p=predictor, scene=repeated: p.predict(scene))
            median_s = float(np.median(durations))
            reference_s = median_s if reference_s is None else reference_s
            latencies.append(
                Latency(
                    predictor=short[name],
                    agents=agents,
                    distinct=min(agents, len(scene.targets)),
                    calls=len(durations),
                    median_s=median_s,
                    p99_s=float(np.quantile(durations, 0.99)),
                    ratio=median_s / reference_s,
                )
            )
    return latencies


def busiest_scene(recordings: Recordings, *, dt_s: float) -> Scene:
    """The first of the ticks with the most targets, with all its targets.

    Raises:
        AspEnvError: There is no target.
    """
    index = index_snippets(recordings, dt_s=dt_s, horizon_s=dt_s)
    if not len(index):
        raise no_data_error("snippet")
    keys = np.stack([index.recording, index.tick], axis=-1)
    _, situation, count = np.unique(keys, axis=0, return_inverse=True, return_counts=True)
    return gather_scene(recordings, index.select(situation.reshape(-1) == count.argmax()))


def durations_s(call: Callable[[], object]) -> list[float]:
    """Wall-clock times of up to `CALLS` calls after some untimed ones; fewer if they are slow."""
    for _ in range(WARM_UP):
        call()
    durations: list[float] = []
    while len(durations) < CALLS:
        start = perf_counter()
        call()
        durations.append(perf_counter() - start)
        if len(durations) >= MIN_CALLS and sum(durations) > MAX_DURATION_S:
            break
    return durations


def latency_table(latencies: Sequence[Latency]) -> Table:
    """Latencies as a table for the terminal."""
    table = Table(title=f"one call of predict for all agents of a scene; reference: {REFERENCE}")
    for heading in (
        *("predictor", "agents", "distinct", "median", "99th percentile"),
        *("calls", "x reference"),
    ):
        table.add_column(heading, justify="left" if heading == "predictor" else "right")
    for each in latencies:
        table.add_row(
            each.predictor,
            str(each.agents),
            str(each.distinct),
            f"{each.median_s * 1e3:.2f} ms",
            f"{each.p99_s * 1e3:.2f} ms",
            str(each.calls),
            f"{each.ratio:.1f}",
        )
    return table
