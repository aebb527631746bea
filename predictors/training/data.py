"""Training data: snippets drawn on the fly, in the order of an epoch.

MERGED: What a run learns from and is selected on.
"""

import copy
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import final

import numpy as np
from jaxtyping import Bool, Int

from asp_env.data.causal import causal_histories
from asp_env.data.recording import Recording
from asp_env.data.snippets import SnippetIndex, gather_future, gather_present, index_snippets
from asp_env.data.source import Recordings, open_data
from asp_env.data.split import TrainedOn, snippet_parts
from asp_env.dynamics import MAX_ACCELERATION_MPS2, MAX_STEERING_RAD, inverse
from asp_env.errors import AspEnvError
from asp_env.metrics.forecast.errors import moving
from asp_env.views import SceneView
from predictors.training.data_loading import (
    BatchSource,
    BatchWorkers,
    Drawn,
    load_by_thread,
    load_by_workers,
)
from predictors.training.recipes import TrainingConfig

CHUNK = 4096
"""Snippets read at once where a whole set is scanned."""

RANGE_PERCENTILE = 99.9
MIN_ACTION_RANGE = (0.5, 0.05)


@final
class Batches:
    """Batches of snippets, drawn while the network works on the one before.

    The order is given, hence the batches are the same whenever and by whomever they are drawn.
    """

    def __init__(
        self,
        recordings: Sequence[Recording],
        snippets: SnippetIndex,
        *,
        view: SceneView,
        batch_size: int,
        later_ticks: Sequence[int] = (),
        histories: Sequence[Recording] | None = None,
    ) -> None:
        """Of `batch_size` snippets each, the last one possibly smaller.

        Args:
            recordings: what happened, which labels are taken from.
            snippets: of them.
            view: what is drawn of each.
            batch_size: snippets at once.
            later_ticks: how long after now the later scenes lie that labels hold.
            histories: the same recordings with what was known at the time; themselves if None.
        """
        self.snippets = snippets
        self.drawing = BatchSource(
            recordings=recordings,
            histories=recordings if histories is None else histories,
            view=view,
            later_ticks=tuple(later_ticks),
        )
        self._crew: tuple[BatchWorkers, int] | None = None
        self._batch_size = batch_size
        self._rank = 0
        self.ranks = 1

    def drawn_by(self, crew: BatchWorkers, number: int) -> "Batches":
        """The same, drawn by a crew that knows their drawing by this number."""
        other = copy.copy(self)
        other._crew = crew, number
        return other

    def reordered(self, rows: Int[np.ndarray, " m"]) -> "Batches":
        """Batches of the snippets at some rows, in their order."""
        other = copy.copy(self)
        other.snippets = self.snippets.select(rows)
        return other

    def dealt(self, rank: int, ranks: int) -> "Batches":
        """One of `ranks` shares of every batch, dealt like cards.

        A share of nothing, where a batch is smaller than `ranks`, holds one snippet of another's.
        """
        other = copy.copy(self)
        other._rank, other.ranks = rank, ranks
        return other

    def rows(self, number: int) -> int:
        """How many snippets a batch holds in all shares together."""
        return min(self._batch_size, len(self.snippets) - number * self._batch_size)

    def share(self, number: int) -> Int[np.ndarray, " n"]:
        """Which snippets of the order a batch is drawn of here."""
        first = number * self._batch_size
        last = first + self.rows(number)
        return np.arange(min(first + self._rank, last - 1), last, self.ranks)

    def own(self, number: int) -> int:
        """How many of `share` are not another's: all of them, or none."""
        return len(range(self._rank, self.rows(number), self.ranks))

    def __len__(self) -> int:
        """How many batches there are."""
        return -(-len(self.snippets) // self._batch_size)

    def __iter__(self) -> Iterator[Drawn]:
        """All batches in order."""
        chosen = (self.snippets.select(self.share(number)) for number in range(len(self)))
        if self._crew is None:
            return load_by_thread(self.drawing, chosen)
        return load_by_workers(*self._crew, chosen)


def epoch_rows(count: int, *, per_epoch: int, epoch: int, seed: int) -> Int[np.ndarray, " rows"]:
    """Which of `count` snippets an epoch shows, in which order.

    Shuffles of all of them follow each other without end, and an epoch is a stretch of that row of
    `per_epoch`; with `per_epoch = count` each epoch is one shuffle. The same for equal arguments.
    """
    first, last = epoch * per_epoch, (epoch + 1) * per_epoch
    shuffles = range(first // count, (last - 1) // count + 1)
    rows = np.concatenate(
        [np.random.default_rng([seed, number]).permutation(count) for number in shuffles]
    )
    skip = first - shuffles[0] * count
    return rows[skip : skip + per_epoch]


def choose_snippets(
    recordings: Sequence[Recording],
    snippets: SnippetIndex,
    *,
    standing_share: float,
    max_snippets: int | None,
    seed: int,
) -> SnippetIndex:
    """The snippets that are learnt from: standing ones held back, and no more than so many.

    Args:
        recordings: what the snippets are of.
        snippets: those that there are.
        standing_share: standing targets (not in the subset `moving`) are left out at random until
            they are at most this share of what remains; 1 keeps them all.
        max_snippets: how many to keep at most, at random; all of them if None.
        seed: of what is left out.

    Raises:
        AspEnvError: none is left.
    """
    rng = np.random.default_rng(seed)
    keep = np.arange(len(snippets))
    if standing_share < 1:
        is_moving = moving_snippets(recordings, snippets)
        going, standing = np.flatnonzero(is_moving), np.flatnonzero(~is_moving)
        allowed = int(len(going) * standing_share / (1 - standing_share))
        if len(standing) > allowed:
            standing = rng.choice(standing, allowed, replace=False)
        keep = np.sort(np.concatenate([going, standing]))
    if max_snippets is not None and len(keep) > max_snippets:
        keep = np.sort(rng.choice(keep, max_snippets, replace=False))
    if not len(keep):
        raise AspEnvError(
            f"none of the {len(snippets)} snippets to learn from moves, and standing ones may be a "
            f"share of {standing_share:g} at most: give recordings with traffic that moves, or "
            "train with a standing_share of 1, as the preset paper does"
        )
    return snippets.select(keep)


def moving_snippets(
    recordings: Sequence[Recording], snippets: SnippetIndex
) -> Bool[np.ndarray, " n"]:
    """Which snippets are in the subset `moving`, on which predictors are compared."""
    parts = [np.zeros(0, dtype=bool)]
    for chosen in _chunks(snippets):
        now, _ = gather_present(recordings, chosen)
        future = gather_future(recordings, chosen)
        parts.append(moving(now, future.states[..., :2], future.valid))
    return np.concatenate(parts)


def action_range(recordings: Sequence[Recording], snippets: SnippetIndex) -> tuple[float, float]:
    """What a network's outputs in [-1, 1] are multiplied by: (m/s², rad).

    The 99.9th percentiles of the absolute actions of the snippets' futures, since the outliers of
    the inverse model ruin a maximum; within the limits of actions, and never quite zero. The same
    to the last bit as `np.percentile` of all, of which only the highest are held.
    """
    count = len(snippets) * snippets.horizon_ticks
    if not count:
        return MIN_ACTION_RANGE
    place = (count - 1) * (RANGE_PERCENTILE / 100)
    below = int(place)
    highest = np.zeros((0, 2))  # the values from there up: a thousandth of all
    for chosen in _chunks(snippets):
        now, lengths = gather_present(recordings, chosen)
        future = gather_future(recordings, chosen).states
        before = np.concatenate([now[:, None], future[:, :-1]], axis=1)
        actions = inverse(before, future, lengths[:, None], snippets.dt_s)
        highest = np.concatenate([highest, np.abs(actions).reshape(-1, 2)])
        if (spare := len(highest) - (count - below)) > 0:
            highest = np.partition(highest, spare, axis=0)[spare:]
    lower, upper = np.sort(highest, axis=0)[[0, min(1, count - below - 1)]]
    share = place - below
    highest = np.where(
        share < 0.5, lower + (upper - lower) * share, upper - (upper - lower) * (1 - share)
    )
    low, high = np.array(MIN_ACTION_RANGE), np.array([MAX_ACCELERATION_MPS2, MAX_STEERING_RAD])
    acceleration, steering = np.clip(highest, low, high)
    return float(acceleration), float(steering)


def _chunks(snippets: SnippetIndex) -> Iterator[SnippetIndex]:
    for first in range(0, len(snippets), CHUNK):
        yield snippets.select(np.arange(first, min(first + CHUNK, len(snippets))))


VALIDATION_BATCH = 256


@dataclass(frozen=True, slots=True, kw_only=True)
class DatasetSplit:
    """Some snippets of some recordings."""

    recordings: Recordings
    snippets: SnippetIndex

    def batches(
        self, view: SceneView, *, size: int, later_ticks: Sequence[int], config: TrainingConfig
    ) -> Batches:
        """In their order, as a network of `config` sees them."""
        histories: Sequence[Recording] = self.recordings
        if config.history == "causal":
            histories = causal_histories(self.recordings)
        return Batches(
            self.recordings,
            self.snippets,
            view=view,
            batch_size=size,
            later_ticks=later_ticks,
            histories=histories,
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class TrainingData:
    """What there is for a run."""

    training: DatasetSplit
    validation: DatasetSplit
    trained_on: TrainedOn
    data_hash: str
    validation_hash: str | None
    """Of separate validation data, if there are any."""


def open_training_data(config: TrainingConfig, data: str) -> TrainingData:
    """Opens DATA and deals it, or takes all of it where validation data are given.

    Raises:
        AspEnvError: the data are bad, nothing is left for a part, or a recording is in both.
    """
    recordings = open_data(data)
    index = _index(recordings, config)
    if config.validation is None:
        parts, trained_on = snippet_parts(recordings, index, config.split)
        training, validation = (
            DatasetSplit(recordings=recordings, snippets=index.select(parts == part))
            for part in ("train", "validation")
        )
        validation_hash = None
    else:
        others = open_data(config.validation)
        training = DatasetSplit(recordings=recordings, snippets=index)
        validation = DatasetSplit(recordings=others, snippets=_index(others, config))
        trained_on = _dealt_by_hand(recordings, others)
        validation_hash = others.data_hash()
    for part, share in (("training", training), ("validation", validation)):
        if not len(share.snippets):
            raise AspEnvError(
                f"data {data!r}: no snippet is left for {part} after the split by "
                f"{config.split}; give more recordings or longer ones"
            )
    return TrainingData(
        training=_chosen(training, config, config.standing_share, config.max_snippets),
        validation=_chosen(validation, config, 1.0, config.max_validation_snippets),
        trained_on=trained_on,
        data_hash=recordings.data_hash(),
        validation_hash=validation_hash,
    )


def _index(recordings: Recordings, config: TrainingConfig) -> SnippetIndex:
    return index_snippets(recordings, dt_s=config.dt_s, horizon_s=config.horizon_s)


def _dealt_by_hand(training: Recordings, validation: Recordings) -> TrainedOn:
    learned, selected = training.hashes(), validation.hashes()
    if both := set(learned) & set(selected):
        names = dict(zip(selected, validation.names, strict=True))
        raise AspEnvError(
            f"recording {names[min(both)]} of {validation.source!r} is in {training.source!r} too: "
            "select on recordings that are not learned from"
        )
    parts = dict.fromkeys(learned, "train") | dict.fromkeys(selected, "validation")
    return TrainedOn(source=training.source, split="recording", parts=parts)


def _chosen(
    share: DatasetSplit, config: TrainingConfig, standing_share: float, most: int | None
) -> DatasetSplit:
    chosen = choose_snippets(
        share.recordings,
        share.snippets,
        standing_share=standing_share,
        max_snippets=most,
        seed=config.seed,
    )
    return DatasetSplit(recordings=share.recordings, snippets=chosen)
