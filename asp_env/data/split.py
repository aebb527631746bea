"""Splits of data into training, validation and test, by recordings or by blocks of time.

All splits are pure functions of counts and times, so that the same data are split in the same way
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

Split = Literal["recording", "daytime", "blocks"]
"""Whether whole recordings, whole recordings by their time of day, or blocks of time within each
recording are assigned to parts."""

Part = Literal["train", "validation", "test", "none"]
"""`none` is left out: without snippets, or too close in time to another part."""

NUM_BLOCKS = 10
"""Blocks of time per recording: one for validation, one for test, the others for training."""

HELD_OUT_SHARE = 0.1
"""Share of the snippets that validation and test each get."""

SPLIT_HORIZON_S = 3.0
"""Horizon of the snippets by whose number recordings are assigned to parts."""

MIN_RECORDINGS = 3
"""A location with fewer recordings is used for training: each part needs one."""

POOLED_BELOW = 10
"""Locations with fewer recordings are split together. Ten is the smallest number of equal
recordings that can be split 8:1:1; with three, each part would get a third."""

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

    Args:
        recordings: the recordings.
        index: their snippets.
        split: the kind of split.

    Returns:
        The `Part` of each snippet, as strings, and the record for the trained predictor.

    Raises:
        AspEnvError: no recording remains for the test part, or a recording has no start time.
    """
    if split != "blocks":
        counted = index_snippets(recordings, dt_s=index.dt_s, horizon_s=SPLIT_HORIZON_S)
        counts = np.bincount(counted.recording, minlength=len(recordings))
        if split == "recording":
            locations = [recording.location for recording in recordings]
            recording_parts = np.array(split_by_recording(counts, locations))
        else:
            recording_parts = np.array(split_by_daytime(counts, start_hours(recordings)))
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

    Locations with three to nine recordings are split together, 8:1:1 by the number of their
    snippets in total, so that not every one has recordings in every part. In each order one
    recording of every such location comes first, then a second one of each, and so on; at most the
    first two of each are held out, so that every location is trained on. A single such location is
    split as above.

    Args:
        counts: number of snippets of each recording.
        locations: location of each recording.
        seed: of the random orders.

    Returns:
        The part of each recording.

    Raises:
        AspEnvError: no recording remains for the test part.
    """
    place = np.unique(np.array(locations, dtype=str), return_inverse=True)[1].reshape(-1)
    sizes = np.bincount(place[counts > 0], minlength=1)
    pooled = (sizes >= MIN_RECORDINGS) & (sizes < POOLED_BELOW)
    group = np.where(pooled[place], -1, place)  # -1 is that of all pooled locations
    parts: list[Part] = ["none"] * len(counts)
    for number in np.unique(group).tolist():
        members = np.flatnonzero((group == number) & (counts > 0))
        rng = np.random.default_rng(seed)
        for member, part in zip(
            members, _assign_parts(counts[members], place[members], rng), strict=True
        ):
            parts[member] = part
    if "test" not in parts:
        most = int(sizes.max())
        raise AspEnvError(
            f"no recording is left to test on: at most {most} recordings of one location hold "
            "snippets, a split by recording needs three; use --split blocks"
        )
    return tuple(parts)


def split_by_daytime(
    counts: Int[np.ndarray, " recordings"], hours: Sequence[float], *, seed: int = 42
) -> tuple[Part, ...]:
    """Assigns whole recordings to parts by time of day, 8:1:1 by number of snippets.

    All recordings that start within the same hour of the clock belong to the same part, whatever
    their day and location, so that test and validation are of other times of day than training
    (section V-B of Janjoš et al. 2021). Hours take the place of the recordings of one location in
    `split_by_recording`. Recordings without snippets are left out.

    Args:
        counts: number of snippets of each recording.
        hours: hours after midnight at which each recording starts.
        seed: of the random orders of hours.

    Returns:
        The part of each recording.

    Raises:
        AspEnvError: recordings with snippets start within fewer than three hours of the clock.
    """
    hour = np.floor(np.array(hours, dtype=np.float64)).astype(np.int64)
    found = np.unique(hour[counts > 0])
    if len(found) < MIN_RECORDINGS:
        names = ", ".join(f"{each}:00" for each in found.tolist()) or "none"
        raise AspEnvError(
            f"recordings with snippets start within {len(found)} hours of the clock ({names}), a "
            "split by time of day needs three; use --split recording or --split blocks"
        )
    totals = np.array([counts[hour == each].sum() for each in found])
    alone = np.zeros(len(found), dtype=np.int64)
    assigned = _assign_parts(totals, alone, np.random.default_rng(seed))
    part_of = dict(zip(found.tolist(), assigned, strict=True))
    return tuple(
        part_of[each] if count else "none"
        for each, count in zip(hour.tolist(), counts.tolist(), strict=True)
    )


def start_hours(recordings: Recordings) -> list[float]:
    """Hours after midnight at which recordings start.

    Raises:
        AspEnvError: a recording has no start time.
    """
    hours = []
    for recording in recordings:
        if recording.start_hour is None:
            raise AspEnvError(
                f"recording {recording.name}: its files give no start time, which a split by time "
                "of day needs; expected startTime in XX_recordingMeta.csv as in inD, in hours: "
                "use --split recording or --split blocks"
            )
        hours.append(recording.start_hour)
    return hours


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


def _assign_parts(
    counts: Int[np.ndarray, " members"],
    places: Int[np.ndarray, " members"],
    rng: np.random.Generator,
) -> list[Part]:
    """Parts of the recordings of some locations; `split_by_recording` describes the search."""
    if len(counts) < MIN_RECORDINGS:
        return ["train"] * len(counts)
    orders = rng.permuted(np.tile(np.arange(len(counts)), (_NUM_ORDERS, 1)), axis=1)
    may_be_held_out = len(counts) - 1
    if (places != places[0]).any():
        may_be_held_out = 2 * len(np.unique(places))  # so that each location has one to train on
        turn = np.zeros(orders.shape, dtype=np.int64)  # the how-manieth of its location in an order
        for location in np.unique(places):
            own = places[orders] == location
            turn[own] = (np.cumsum(own, axis=1) - 1)[own]
        orders = np.take_along_axis(orders, np.argsort(turn, axis=1, kind="stable"), axis=1)
    total = np.cumsum(counts[orders], axis=1) / counts.sum()
    rows, place = np.arange(_NUM_ORDERS), np.arange(len(counts))
    last_test = np.abs(total[:, : may_be_held_out - 1] - HELD_OUT_SHARE).argmin(axis=1)
    test_share = total[rows, last_test]
    validation_share = total - test_share[:, None]
    may_end = (place > last_test[:, None]) & (place < may_be_held_out)
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
