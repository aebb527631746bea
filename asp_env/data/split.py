"""Who is learned from and who is judged on: by recording, or by blocks of time within each.

Both are pure functions of counts and times, so that the same data split the same way everywhere.
"""

from collections.abc import Sequence
from typing import Literal

import numpy as np
from jaxtyping import Bool, Int, Shaped

from asp_env.errors import AspEnvError

Part = Literal["train", "validation", "test", "none"]
"""`none` is left out: without snippets, or too near to what another part uses."""

NUM_BLOCKS = 10
SHARE = 0.1
"""What validation and test get each."""

_TRIES = 1_000


def split_by_recording(
    counts: Int[np.ndarray, " recordings"], locations: Sequence[str], *, seed: int = 42
) -> tuple[Part, ...]:
    """Whole recordings to each part, 8:1:1 by number of snippets within each location.

    Of 1,000 random orders of a location's recordings the one counts whose first recordings come
    nearest to a tenth of the snippets (test), and the next ones too (validation). Recordings
    without snippets are left out, a location with fewer than three others goes to training.

    Args:
        counts: how many snippets each recording holds.
        locations: where each recording was made.
        seed: of the random orders.

    Returns:
        The part of each recording.

    Raises:
        AspEnvError: no recording is left to test on.
    """
    parts: list[Part] = ["none"] * len(counts)
    by_location: list[list[Part]] = []
    for location in sorted(set(locations)):
        here = np.array([place == location for place in locations], dtype=bool)
        members = np.flatnonzero(here & (counts > 0))
        by_location.append(_deal(counts[members], np.random.default_rng(seed)))
        for member, part in zip(members, by_location[-1], strict=True):
            parts[member] = part
    if "test" not in parts:
        most = max((parts_at.count("train") for parts_at in by_location), default=0)
        raise AspEnvError(
            f"no recording is left to test on: at most {most} recordings of one location hold "
            "snippets, a split by recording needs three; use --split blocks"
        )
    return tuple(parts)


def split_blocks(
    recording: Int[np.ndarray, " n"],
    first: Int[np.ndarray, " n"],
    last: Int[np.ndarray, " n"],
    *,
    lengths: Int[np.ndarray, " recordings"],
    seed: int = 42,
) -> Shaped[np.ndarray, " n"]:
    """Blocks of time to each part: ten of equal length in each recording, shuffled, 8:1:1.

    A snippet belongs to a part if all of it lies in that part's blocks and, between it and any
    block of test (or, for training, of validation), at least as many ticks as it spans. So no
    tick is shared between parts, and a whole snippet lies between any two snippets of different
    parts. The blocks of validation and test are never neighbours; every recording has them at the
    same place, whatever others are split with it.

    Args:
        recording: of each snippet, an index into `lengths`.
        first: of each snippet, its first tick.
        last: of each snippet, its last tick.
        lengths: how many ticks each recording lasts.
        seed: of the shuffle.

    Returns:
        The `Part` of each snippet, as strings.
    """
    dealt = _block_parts(seed)
    parts = np.full(len(recording), "none", dtype="<U10")
    for number, length in enumerate(lengths.tolist()):
        block = np.arange(length) * NUM_BLOCKS // max(length, 1)
        of_tick = dealt[block]
        mine = np.flatnonzero(recording == number)
        begin, end = first[mine], last[mine] + 1
        span = end - begin
        wide = (np.maximum(begin - span, 0), np.minimum(end + span, length))
        in_test, in_validation = of_tick == "test", of_tick == "validation"
        clear_of_test = _count(in_test, *wide) == 0
        clear_of_both = clear_of_test & (_count(in_validation, *wide) == 0)
        parts[mine[clear_of_both]] = "train"
        parts[mine[clear_of_test & (_count(in_validation, begin, end) == span)]] = "validation"
        parts[mine[_count(in_test, begin, end) == span]] = "test"
    return parts


def _deal(counts: Int[np.ndarray, " members"], rng: np.random.Generator) -> list[Part]:
    if len(counts) < 3:
        return ["train"] * len(counts)
    orders = rng.permuted(np.tile(np.arange(len(counts)), (_TRIES, 1)), axis=1)
    total = np.cumsum(counts[orders], axis=1) / counts.sum()
    tries, place = np.arange(_TRIES), np.arange(len(counts))
    last_test = np.abs(total[:, :-2] - SHARE).argmin(axis=1)
    test_share = total[tries, last_test]
    validation_share = total - test_share[:, None]
    may_end = (place > last_test[:, None]) & (place < len(counts) - 1)
    off = np.where(may_end, np.abs(validation_share - SHARE), np.inf)
    last_validation = off.argmin(axis=1)
    miss = np.abs(test_share - SHARE) + off[tries, last_validation]
    best = int(miss.round(9).argmin())
    parts: list[Part] = ["train"] * len(counts)
    for member in orders[best, : last_validation[best] + 1]:
        parts[member] = "validation"
    for member in orders[best, : last_test[best] + 1]:
        parts[member] = "test"
    return parts


def _block_parts(seed: int) -> Shaped[np.ndarray, " blocks"]:
    rng = np.random.default_rng(seed)
    while True:
        test, validation = rng.permutation(NUM_BLOCKS)[:2]
        if abs(int(test) - int(validation)) > 1:
            break
    parts = np.full(NUM_BLOCKS, "train", dtype="<U10")
    parts[test], parts[validation] = "test", "validation"
    return parts


def _count(
    of: Bool[np.ndarray, " ticks"], begin: Int[np.ndarray, " n"], end: Int[np.ndarray, " n"]
) -> Int[np.ndarray, " n"]:
    """How many of the ticks [begin, end) are marked."""
    total = np.concatenate([[0], np.cumsum(of)])
    return total[end] - total[begin]
