"""How speeds are measured: medians of processor time, beside the machine's memory bandwidth.

MERGED: How long a forecast of a scene takes, by the number of agents that are asked of.
"""

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


@dataclass(frozen=True, slots=True, kw_only=True)
class Rate:
    """One line of the table."""

    what: str
    per_s: float
    unit: str
    bytes_each: int = 0
    """Bytes that one of them writes at least; 0 where that says nothing."""
    beside: float | None = None
    """The rate of the same thing done in another way, of the same unit, in the same run."""
    beside_what: str = ""


def median_s(work: Callable[[], object], prepare: Callable[[], object] = lambda: None) -> float:
    """Median processor time of several calls after one that is not counted.

    Preparing is not timed. It is this process's time, so that others on the machine count less.
    """
    durations = []
    for _ in range(1 + REPEATS):
        prepare()
        start = process_time()
        work()
        durations.append(process_time() - start)
    return float(np.median(durations[1:]))


def copy_bandwidth() -> float:
    """Bytes per second that a large copy writes, on one core."""
    source, target = np.ones(COPY_BYTES, dtype=np.uint8), np.zeros(COPY_BYTES, dtype=np.uint8)
    return COPY_BYTES / median_s(lambda: np.copyto(target, source))


def write_bandwidth() -> float:
    """Bytes per second that filling one full raster after another writes: its floor."""
    target = np.zeros((256, 12, 360, 240), dtype=np.uint8)
    return target.nbytes / median_s(lambda: target.fill(1))


AGENTS = (1, 16, 64)
HORIZON_S = 3.0
REFERENCE = "constant-velocity"
WARM_UP = 3
CALLS = 200
PATIENCE_S = 20.0
"""A predictor that takes long is called less often, but no less than `FEWEST` times."""
FEWEST = 10


@dataclass(frozen=True, slots=True, kw_only=True)
class Latency:
    """Of calls for so many agents."""

    predictor: str
    agents: int
    distinct: int
    """How many of them are not the same one again."""
    calls: int
    median_s: float
    p99_s: float
    """The 99th percentile; of fewer than 100 calls, near the longest."""
    ratio: float
    """The median over that of constant velocity in the same scene."""


def measure_latencies(
    recordings: Recordings, names: Sequence[str], *, dt_s: float
) -> list[Latency]:
    """Latencies of constant velocity and of some predictors, each for 1, 16 and 64 agents.

    The scene is the tick of a recording with the most targets. Where it has fewer than are asked
    of, they are asked of more than once: each is drawn and forecast anew.

    Args:
        recordings: to take the scene from.
        names: of predictors, as `load_predictor` takes them.
        dt_s: the time step.

    Raises:
        AspEnvError: a predictor cannot be loaded or is handed the future, or nothing can be
            forecast.
    """
    all_names = list(dict.fromkeys((REFERENCE, *names)))
    predictors = load_predictors(all_names, horizon=ticks(HORIZON_S, dt_s), dt_s=dt_s)
    if handed := [predictor.name for predictor in predictors if predictor.privileged]:
        raise AspEnvError(f"--predictors: {handed[0]} is handed the future, which takes no time")
    scene, short = busiest_scene(recordings, dt_s=dt_s), short_names(all_names)
    found = []
    for agents in AGENTS:
        asked = scene.with_targets(np.resize(scene.targets, (agents, 2)))
        reference_s = None
        for name, predictor in zip(all_names, predictors, strict=True):
            durations = durations_s(lambda who=predictor, scene=asked: who.predict(scene))
            median_s = float(np.median(durations))
            reference_s = median_s if reference_s is None else reference_s
            found.append(
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
    return found


def latency_table(latencies: Sequence[Latency]) -> Table:
    """For the terminal."""
    table = Table(title=f"one call of predict for all agents of a scene; reference: {REFERENCE}")
    for heading in (
        "predictor",
        "agents",
        "distinct",
        "median",
        "99 % below",
        "calls",
        "x reference",
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


def busiest_scene(recordings: Recordings, *, dt_s: float) -> Scene:
    """The first of the ticks at which the most targets can be forecast, with all of them.

    Raises:
        AspEnvError: there is no target at all.
    """
    index = index_snippets(recordings, dt_s=dt_s, horizon_s=dt_s)
    if not len(index):
        raise no_data_error("snippet")
    keys = np.stack([index.recording, index.tick], axis=-1)
    _, situation, count = np.unique(keys, axis=0, return_inverse=True, return_counts=True)
    return gather_scene(recordings, index.select(situation.reshape(-1) == count.argmax()))


def durations_s(call: Callable[[], object]) -> list[float]:
    """Of many calls after some that are not counted; fewer where they take long."""
    for _ in range(WARM_UP):
        call()
    durations: list[float] = []
    while len(durations) < CALLS:
        start = perf_counter()
        call()
        durations.append(perf_counter() - start)
        if len(durations) >= FEWEST and sum(durations) > PATIENCE_S:
            break
    return durations
