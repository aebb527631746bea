"""Splits of data into training, validation and test, by whole recordings or by blocks of time.

Both splits are pure functions of counts and times, so that the same data are split in the same way
everywhere. `TrainedOn` records the split with a predictor, so that it is evaluated on other data.
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

Split = Literal["recording", "blocks"]
"""Whether whole recordings or blocks of time within each recording are assigned to parts."""

Part = Literal["train", "validation", "test", "none"]
"""`none` is left out: without snippets, or too close in time to another part."""

NUM_BLOCKS = 10
"""Blocks of time per recording: one for validation, one for test, the others for training."""

HELD_OUT_SHARE = 0.1
"""Share of the snippets that validation and test each get."""

SPLIT_HORIZON_S = 3.0
"""Horizon of the snippets by whose number recordings are assigned to parts."""

_NUM_ORDERS = 1_000


@dataclass(frozen=True, slots=True, kw_only=True)
class TrainedOn:
    """The recordings on which a predictor was trained and selected."""

    source: str
    """The data as the user named them."""
    split: Split
    parts: Mapping[str, str]
    """By content hash of a recording: its `Part`, or `blocks` if it was split by blocks."""

    def continued_from(self, earlier: "TrainedOn") -> "TrainedOn":
        """The data of a predictor that continues training from one trained on `earlier`.

        A recording that was split by blocks in both runs stays so. A recording that either run used
        for training or validation in any other way is not available for evaluation.
        """
        parts = dict(self.parts)
        for content, part in earlier.parts.items():
            own_part = parts.get(content, "none")
            if part not in ("train", "validation", "blocks") or part == own_part:
                continue
            parts[content] = part if own_part in ("test", "none") else "train"
        return TrainedOn(source=self.source, split=self.split, parts=parts)


def snippet_parts(
    recordings: Recordings, index: SnippetIndex, split: Split
) -> tuple[Shaped[np.ndarray, " n"], TrainedOn]:
    """Assigns snippets to parts.

    Recordings are assigned by their number of snippets with a horizon of 3 s, for every horizon
    of `index`, so that a run for 6 s that continues from one for 3 s uses the same recordings.

    Returns:
        The `Part` of each snippet, as strings, and the record for the trained predictor.

    Raises:
        AspEnvError: no recording remains for the test part.
    """
    if split == "recording":
        counted = index_snippets(recordings, dt_s=index.dt_s, horizon_s=SPLIT_HORIZON_S)
        counts = np.bincount(counted.recording, minlength=len(recordings))
        locations = [recording.location for recording in recordings]
        recording_parts = np.array(split_by_recording(counts, locations))
        parts = recording_parts[index.recording]
    else:
        recording_parts = np.full(len(recordings), "blocks")
        parts = split_blocks(
            index.recording,
            index.tick - index.history,
            index.tick + index.horizon_ticks,
            lengths=np.array([num_ticks(recording, index.dt_s) for recording in recordings]),
        )
    by_hash = dict(zip(recordings.hashes(), recording_parts.tolist(), strict=True))
    return parts, TrainedOn(source=recordings.source, split=split, parts=by_hash)


def split_by_recording(
    counts: Int[np.ndarray, " recordings"], locations: Sequence[str], *, seed: int = 42
) -> tuple[Part, ...]:
    """Assigns whole recordings to parts, 8:1:1 by number of snippets within each location.

    Of 1,000 random orders of a location's recordings, the one is used whose first recordings come
    closest to a tenth of the snippets (test), and the following ones too (validation). Recordings
    without snippets are left out. A location with fewer than three others is used for training.

    Args:
        counts: number of snippets of each recording.
        locations: location of each recording.
        seed: of the random orders.

    Returns:
        The part of each recording.

    Raises:
        AspEnvError: no recording remains for the test part.
    """
    parts: list[Part] = ["none"] * len(counts)
    by_location: list[list[Part]] = []
    for location in sorted(set(locations)):
        at_location = np.array([place == location for place in locations], dtype=bool)
        members = np.flatnonzero(at_location & (counts > 0))
        by_location.append(_assign_parts(counts[members], np.random.default_rng(seed)))
        for member, part in zip(members, by_location[-1], strict=True):
            parts[member] = part
    if "test" not in parts:
        most = max((location_parts.count("train") for location_parts in by_location), default=0)
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
    """Assigns snippets to parts by ten equal blocks of time per recording, shuffled, 8:1:1.

    A snippet belongs to a part if all of it lies in that part's blocks and it is at least its own
    length away from any test block and, for training, from any validation block. Thus parts share
    no tick, and snippets of different parts are at least one snippet apart. Validation and test
    blocks are never neighbours. The blocks depend on the seed alone, not on the recordings.

    Args:
        recording: index into `lengths` of each snippet.
        first: first tick of each snippet.
        last: last tick of each snippet.
        lengths: number of ticks of each recording.
        seed: of the shuffle.

    Returns:
        The `Part` of each snippet, as strings.
    """
    block_parts = _block_parts(seed)
    parts = np.full(len(recording), "none", dtype="<U10")
    for number, length in enumerate(lengths.tolist()):
        block = np.arange(length) * NUM_BLOCKS // max(length, 1)
        tick_parts = block_parts[block]
        rows = np.flatnonzero(recording == number)
        begin, end = first[rows], last[rows] + 1
        span = end - begin
        wide = (np.maximum(begin - span, 0), np.minimum(end + span, length))
        in_test, in_validation = tick_parts == "test", tick_parts == "validation"
        clear_of_test = _count(in_test, *wide) == 0
        clear_of_both = clear_of_test & (_count(in_validation, *wide) == 0)
        parts[rows[clear_of_both]] = "train"
        parts[rows[clear_of_test & (_count(in_validation, begin, end) == span)]] = "validation"
        parts[rows[_count(in_test, begin, end) == span]] = "test"
    return parts


def num_ticks(recording: Recording, dt_s: float) -> int:
    """Number of ticks of a recording."""
    return -(-recording.num_frames // frames_per_tick(recording.frame_rate_hz, dt_s))


def unseen_ticks(
    recordings: Recordings, trained_on: Sequence[TrainedOn], dt_s: float
) -> list[Bool[np.ndarray, " _"]]:
    """Masks of the ticks that no predictor used for training or validation.

    Args:
        recordings: the recordings.
        trained_on: the data of each predictor.
        dt_s: seconds per tick.

    Returns:
        A mask of the ticks of each recording.
    """
    masks = []
    for recording, content in zip(recordings, recordings.hashes(), strict=True):
        length = num_ticks(recording, dt_s)
        unseen = np.ones(length, dtype=bool)
        for trained in trained_on:
            part = trained.parts.get(content, "none")
            if part == "blocks":
                unseen &= part_of_ticks(length) == "test"
            elif part in ("train", "validation"):
                unseen[:] = False
        masks.append(unseen)
    return masks


def ticks_of_part(
    recordings: Recordings, trained_on: Sequence[TrainedOn], part: Part, dt_s: float
) -> list[Bool[np.ndarray, " _"]]:
    """Masks of the ticks that belonged to one part of the data of every predictor.

    Args:
        recordings: the recordings.
        trained_on: the data of each predictor.
        part: the part.
        dt_s: seconds per tick.

    Returns:
        A mask of the ticks of each recording.
    """
    masks = []
    for recording, content in zip(recordings, recordings.hashes(), strict=True):
        length = num_ticks(recording, dt_s)
        in_part = np.ones(length, dtype=bool)
        for trained in trained_on:
            assigned = trained.parts.get(content, "none")
            in_part &= part_of_ticks(length) == part if assigned == "blocks" else assigned == part
        masks.append(in_part)
    return masks


def part_of_ticks(length: int) -> Shaped[np.ndarray, " ticks"]:
    """The `Part` of every tick of a recording that is split by blocks, as strings."""
    tick = np.arange(length)
    return split_blocks(np.zeros_like(tick), tick, tick, lengths=np.array([length]))


def _assign_parts(counts: Int[np.ndarray, " members"], rng: np.random.Generator) -> list[Part]:
    """Parts of the recordings of one location; `split_by_recording` describes the search."""
    if len(counts) < 3:
        return ["train"] * len(counts)
    orders = rng.permuted(np.tile(np.arange(len(counts)), (_NUM_ORDERS, 1)), axis=1)
    total = np.cumsum(counts[orders], axis=1) / counts.sum()
    rows, place = np.arange(_NUM_ORDERS), np.arange(len(counts))
    last_test = np.abs(total[:, :-2] - HELD_OUT_SHARE).argmin(axis=1)
    test_share = total[rows, last_test]
    validation_share = total - test_share[:, None]
    may_end = (place > last_test[:, None]) & (place < len(counts) - 1)
    error = np.where(may_end, np.abs(validation_share - HELD_OUT_SHARE), np.inf)
    last_validation = error.argmin(axis=1)
    total_error = np.abs(test_share - HELD_OUT_SHARE) + error[rows, last_validation]
    best = int(total_error.round(9).argmin())
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
    mask: Bool[np.ndarray, " ticks"], begin: Int[np.ndarray, " n"], end: Int[np.ndarray, " n"]
) -> Int[np.ndarray, " n"]:
    """Number of True values among the ticks [begin, end)."""
    total = np.concatenate([[0], np.cumsum(mask)])
    return total[end] - total[begin]
