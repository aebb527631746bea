"""How speeds are measured: medians of processor time, beside the machine's memory bandwidth."""

from collections.abc import Callable
from dataclasses import dataclass
from time import process_time

import numpy as np

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
