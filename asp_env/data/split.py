"""Who is learned from and who is judged on: by recording, or by blocks of time within each.

Both are pure functions of counts and times, so that the same data split the same way everywhere.

MERGED: Which snippets and scenarios of DATA are learned from, selected on, and judged on.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Bool, Int, Shaped

from asp_env.data.recording import Recording, frames_per_tick
from asp_env.data.snippets import SnippetIndex, index_snippets
from asp_env.data.source import Recordings
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


Split = Literal["recording", "blocks"]

SPLIT_HORIZON_S = 3.0
"""Recordings are dealt by their number of snippets with this horizon, whatever is learned."""


@dataclass(frozen=True, slots=True, kw_only=True)
class TrainedOn:
    """Which recordings a trained predictor has seen, so that it is judged on others."""

    source: str
    """DATA as its user named it."""
    split: Split
    parts: Mapping[str, str]
    """By the content hash of each recording: its part, or `blocks` where its blocks were dealt."""

    def after(self, earlier: "TrainedOn") -> "TrainedOn":
        """What a predictor has seen that goes on from one which had learned from `earlier`.

        Blocks stay blocks where both had them; a recording that either learned from otherwise, or
        was selected on, is not free any more.
        """
        parts = dict(self.parts)
        for content, part in earlier.parts.items():
            mine = parts.get(content, "none")
            if part not in ("train", "validation", "blocks") or part == mine:
                continue
            free = mine in ("test", "none")
            parts[content] = part if free else "train"
        return TrainedOn(source=self.source, split=self.split, parts=parts)


def snippet_parts(
    recordings: Recordings, index: SnippetIndex, split: Split
) -> tuple[Shaped[np.ndarray, " n"], TrainedOn]:
    """The part of each snippet, and what a predictor trained on them is to remember.

    Recordings are dealt by their number of snippets of 3 s, whatever these snippets' horizon, so
    that a run for 6 s that goes on from one for 3 s learns from the same recordings.

    Raises:
        AspEnvError: nothing would be left to test on.
    """
    if split == "recording":
        dealt = index_snippets(recordings, dt_s=index.dt_s, horizon_s=SPLIT_HORIZON_S)
        counts = np.bincount(dealt.recording, minlength=len(recordings))
        locations = [recording.location for recording in recordings]
        of_recording = np.array(split_by_recording(counts, locations))
        remembered, parts = of_recording, of_recording[index.recording]
    else:
        remembered = np.full(len(recordings), "blocks")
        parts = split_blocks(
            index.recording,
            index.tick - index.history,
            index.tick + index.horizon,
            lengths=np.array([num_ticks(recording, index.dt_s) for recording in recordings]),
        )
    by_hash = dict(zip(recordings.hashes(), remembered.tolist(), strict=True))
    return parts, TrainedOn(source=recordings.source, split=split, parts=by_hash)


def num_ticks(recording: Recording, dt_s: float) -> int:
    """How many ticks a recording lasts."""
    return -(-recording.num_frames // frames_per_tick(recording.frame_rate_hz, dt_s))


def unseen_ticks(
    recordings: Recordings, trained_on: Sequence[TrainedOn], dt_s: float
) -> list[Bool[np.ndarray, " _"]]:
    """Of each recording, the ticks that none of some predictors learned from or was selected on."""
    unseen = []
    for recording, content in zip(recordings, recordings.hashes(), strict=True):
        length = num_ticks(recording, dt_s)
        free = np.ones(length, dtype=bool)
        for known in trained_on:
            part = known.parts.get(content, "none")
            if part == "blocks":
                free &= part_of_ticks(length) == "test"
            elif part in ("train", "validation"):
                free[:] = False
        unseen.append(free)
    return unseen


def ticks_of_part(
    recordings: Recordings, trained_on: Sequence[TrainedOn], part: Part, dt_s: float
) -> list[Bool[np.ndarray, " _"]]:
    """Of each recording, the ticks that were this part of what every one of some predictors had."""
    found = []
    for recording, content in zip(recordings, recordings.hashes(), strict=True):
        length = num_ticks(recording, dt_s)
        mine = np.ones(length, dtype=bool)
        for known in trained_on:
            dealt = known.parts.get(content, "none")
            mine &= part_of_ticks(length) == part if dealt == "blocks" else dealt == part
        found.append(mine)
    return found


def part_of_ticks(length: int) -> Shaped[np.ndarray, " ticks"]:
    """The part of every single tick of a recording whose blocks are dealt."""
    at = np.arange(length)
    return split_blocks(np.zeros_like(at), at, at, lengths=np.array([length]))
