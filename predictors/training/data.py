"""Training data: the snippets of a run, their split, their order in an epoch, and their batches."""

import copy
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import final

import numpy as np
from jaxtyping import Bool, Int, Shaped

from asp_env.data.histories import histories
from asp_env.data.recording import Recording
from asp_env.data.snippets import SnippetIndex, gather_future, gather_present, index_snippets
from asp_env.data.source import Recordings, join_data, open_readable
from asp_env.data.split import TrainedOn, snippet_parts
from asp_env.dynamics import MAX_ACCELERATION_MPS2, MAX_STEERING_RAD, inverse
from asp_env.errors import AspEnvError
from asp_env.metrics.forecast.errors import moving
from asp_env.views import SceneView
from predictors.training.augmentation import Augmentation
from predictors.training.data_loading import (
    BatchRequest,
    BatchSource,
    BatchWorkers,
    Sample,
    load_by_thread,
    load_by_workers,
)
from predictors.training.recipes import TrainingConfig

VALIDATION_BATCH = 256
"""Snippets of a validation batch. Chosen by hand."""

CHUNK = 4096
"""Snippets that are read at once where a whole set is scanned. Chosen by hand: it bounds memory."""

RANGE_PERCENTILE = 99.9
"""Percentile of absolute actions that outputs are scaled by. The paper scales by the range in the
training data; outliers of the inverse bicycle model would dominate it."""

MIN_ACTION_RANGE = (0.5, 0.05)
"""Lowest scale of actions, m/s² and rad. Chosen by hand, for data in which nothing moves."""


@final
class Batches:
    """Batches of snippets in a given order, made while the network processes the ones before.

    Each process of a distributed training iterates its own shard of every batch.
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
        augmentation: Augmentation | None = None,
        seed: int = 0,
    ) -> None:
        """Makes an unsharded sequence that loads in a thread.

        Args:
            recordings: The recordings that labels are taken from.
            snippets: Snippets of them, in order.
            view: The view that renders the observations.
            batch_size: Snippets of a batch; the last one may be smaller.
            later_ticks: Ticks ahead at which labels hold future inputs.
            histories: The same recordings as the inputs show them; None for the recordings.
            augmentation: Ranges of the augmentation; None for none.
            seed: Seed of the augmentation.
        """
        self.snippets = snippets
        self._visited = 0
        self.source = BatchSource(
            recordings=recordings,
            histories=recordings if histories is None else histories,
            view=view,
            later_ticks=tuple(later_ticks),
            augmentation=augmentation,
            seed=seed,
        )
        self._workers: tuple[BatchWorkers, int] | None = None
        self._batch_size = batch_size
        self._rank = 0
        self.num_shards = 1

    def with_workers(self, workers: BatchWorkers, source: int) -> "Batches":
        """The same batches, loaded by processes that have `self.source` at an index."""
        other = copy.copy(self)
        other._workers = workers, source
        return other

    def reordered(self, rows: Int[np.ndarray, " m"], *, visited: int = 0) -> "Batches":
        """Batches of the snippets at some rows, in their order.

        Args:
            rows: Rows of the snippets.
            visited: Number of snippets that the run visits before.
        """
        other = copy.copy(self)
        other.snippets, other._visited = self.snippets.select(rows), visited
        return other

    def shard(self, rank: int, num_shards: int) -> "Batches":
        """One of several shards: every `num_shards`-th snippet of each batch, from `rank` on.

        A batch with fewer snippets than shards leaves some shards without one of their own; these
        repeat the batch's last snippet.
        """
        other = copy.copy(self)
        other._rank, other.num_shards = rank, num_shards
        return other

    def num_snippets(self, batch: int) -> int:
        """Number of snippets of a batch, all shards together."""
        return min(self._batch_size, len(self.snippets) - batch * self._batch_size)

    def shard_rows(self, batch: int) -> Int[np.ndarray, " n"]:
        """Rows of the snippets of this shard in a batch, at least one."""
        first = batch * self._batch_size
        last = first + self.num_snippets(batch)
        return np.arange(min(first + self._rank, last - 1), last, self.num_shards)

    def num_own(self, batch: int) -> int:
        """Number of `shard_rows` that no other shard has: all of them, or none."""
        return len(range(self._rank, self.num_snippets(batch), self.num_shards))

    def __len__(self) -> int:
        return -(-len(self.snippets) // self._batch_size)

    def __iter__(self) -> Iterator[Sample]:
        every = (self.shard_rows(batch) for batch in range(len(self)))
        batches = (BatchRequest(self.snippets.select(rows), self._visited + rows) for rows in every)
        if self._workers is None:
            return load_by_thread(self.source, batches)
        return load_by_workers(*self._workers, batches)


@dataclass(frozen=True, slots=True, kw_only=True)
class DatasetSplit:
    """The snippets of one part of the data."""

    recordings: Recordings
    snippets: SnippetIndex

    def batches(
        self, view: SceneView, *, size: int, later_ticks: Sequence[int], config: TrainingConfig
    ) -> Batches:
        """Batches in the order of the snippets.

        Args:
            view: The view that renders the observations.
            size: Snippets of a batch.
            later_ticks: Ticks ahead at which labels hold future inputs.
            config: The configuration; its `history` decides what the inputs show.
        """
        return Batches(
            self.recordings,
            self.snippets,
            view=view,
            batch_size=size,
            later_ticks=later_ticks,
            histories=self.histories(config),
            augmentation=config.augmentation,
            seed=config.seed,
        )

    def histories(self, config: TrainingConfig) -> Sequence[Recording]:
        """The recordings as inputs show them, as `history` of the configuration says."""
        return histories(self.recordings, config.history)


@dataclass(frozen=True, slots=True, kw_only=True)
class TrainingData:
    """The data of a run."""

    training: DatasetSplit
    validation: DatasetSplit
    trained_on: TrainedOn
    data_hash: str
    validation_hash: str | None
    """Hash of separate validation data, if there are any."""
    resampled: dict[str, dict[str, float]]
    """Frame rates of resampled recordings, as of `Recordings.resampled`."""


def open_all(data: str | Sequence[str], *, dt_s: float) -> list[Recordings]:
    """Opens the recordings of one or several DATA that can be read, for ticks of `dt_s` seconds."""
    return [open_readable(each, dt_s=dt_s) for each in ([data] if isinstance(data, str) else data)]


def open_training_data(config: TrainingConfig, data: str | Sequence[str]) -> TrainingData:
    """Opens the data and splits them, or takes all of them if validation data are given.

    Args:
        config: The configuration.
        data: One or several DATA, as `open_data` takes them. Each is split on its own.

    Raises:
        AspEnvError: The data are bad, a part is empty, or a recording is in two data sets.
    """
    opened = open_all(data, dt_s=config.dt_s)
    recordings = join_data(opened)
    index = snippets_of(recordings, config)
    if not config.validation:
        parts, trained_on = _split(opened, recordings.source, config)
        training, validation = (
            DatasetSplit(recordings=recordings, snippets=index.select(parts == part))
            for part in ("train", "validation")
        )
        validation_hash = None
    else:
        separate = join_data(open_all(config.validation, dt_s=config.dt_s))
        training = DatasetSplit(recordings=recordings, snippets=index)
        validation = DatasetSplit(recordings=separate, snippets=snippets_of(separate, config))
        trained_on = _separate_parts(recordings, separate)
        validation_hash = separate.data_hash()
    for part, split in (("training", training), ("validation", validation)):
        if not len(split.snippets):
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
        resampled=recordings.resampled(),
    )


def epoch_rows(count: int, *, per_epoch: int, epoch: int, seed: int) -> Int[np.ndarray, " rows"]:
    """Rows of the snippets of an epoch, in order.

    The epochs are consecutive stretches of an endless sequence of shuffles of all snippets; with
    `per_epoch = count` each epoch is one shuffle. Equal arguments give equal rows.

    Args:
        count: Number of snippets.
        per_epoch: Snippets of an epoch.
        epoch: Index of the epoch.
        seed: Seed of the shuffles.
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
    """Limits the share of standing targets and the number of snippets.

    Args:
        recordings: The recordings of the snippets.
        snippets: All snippets.
        standing_share: Standing targets (not in the subset `moving`) are omitted at random until
            they are at most this share of the rest; 1 omits none.
        max_snippets: Largest number of snippets, chosen at random; None for all.
        seed: Seed of the random choices.

    Returns:
        The chosen snippets in their order.

    Raises:
        AspEnvError: None is left.
    """
    rng = np.random.default_rng(seed)
    rows = np.arange(len(snippets))
    if standing_share < 1:
        is_moving = moving_snippets(recordings, snippets)
        in_motion, standing = np.flatnonzero(is_moving), np.flatnonzero(~is_moving)
        allowed = int(len(in_motion) * standing_share / (1 - standing_share))
        if len(standing) > allowed:
            standing = rng.choice(standing, allowed, replace=False)
        rows = np.sort(np.concatenate([in_motion, standing]))
    if max_snippets is not None and len(rows) > max_snippets:
        rows = np.sort(rng.choice(rows, max_snippets, replace=False))
    if not len(rows):
        raise AspEnvError(
            f"none of the {len(snippets)} training snippets moves, and standing targets may be a "
            f"share of at most {standing_share:g}: give recordings with moving traffic, or "
            "train with a standing_share of 1, as the recipe paper does"
        )
    return snippets.select(rows)


def moving_snippets(
    recordings: Sequence[Recording], snippets: SnippetIndex
) -> Bool[np.ndarray, " n"]:
    """Mask of the snippets in the subset `moving`, on which predictors are compared."""
    parts = [np.zeros(0, dtype=bool)]
    for chunk in _chunks(snippets):
        now, _ = gather_present(recordings, chunk)
        future = gather_future(recordings, chunk)
        parts.append(moving(now, future.states[..., :2], future.valid))
    return np.concatenate(parts)


def action_range(recordings: Sequence[Recording], snippets: SnippetIndex) -> tuple[float, float]:
    """The scale of actions: the 99.9th percentiles of the absolute actions of all futures.

    The result is equal bit for bit to `np.percentile` of all actions, of which only the highest are
    stored.

    Returns:
        Acceleration (m/s²) and steering (rad), within `MIN_ACTION_RANGE` and the limits of actions.
    """
    count = len(snippets) * snippets.horizon_ticks
    if not count:
        return MIN_ACTION_RANGE
    place = (count - 1) * (RANGE_PERCENTILE / 100)
    below = int(place)
    highest = np.zeros((0, 2))  # the values from that place up: a thousandth of all
    for chunk in _chunks(snippets):
        now, lengths = gather_present(recordings, chunk)
        future = gather_future(recordings, chunk).states
        before = np.concatenate([now[:, None], future[:, :-1]], axis=1)
        actions = inverse(before, future, lengths[:, None], snippets.dt_s)
        highest = np.concatenate([highest, np.abs(actions).reshape(-1, 2)])
        if (surplus := len(highest) - (count - below)) > 0:
            highest = np.partition(highest, surplus, axis=0)[surplus:]
    lower, upper = np.sort(highest, axis=0)[[0, min(1, count - below - 1)]]
    share = place - below
    # Interpolates from the nearer end, as np.percentile does.
    percentiles = np.where(
        share < 0.5, lower + (upper - lower) * share, upper - (upper - lower) * (1 - share)
    )
    low, high = np.array(MIN_ACTION_RANGE), np.array([MAX_ACCELERATION_MPS2, MAX_STEERING_RAD])
    acceleration, steering = np.clip(percentiles, low, high)
    return float(acceleration), float(steering)


def _chunks(snippets: SnippetIndex) -> Iterator[SnippetIndex]:
    for first in range(0, len(snippets), CHUNK):
        yield snippets.select(np.arange(first, min(first + CHUNK, len(snippets))))


def snippets_of(recordings: Recordings, config: TrainingConfig) -> SnippetIndex:
    """All snippets of recordings, as the configuration needs them."""
    return index_snippets(
        recordings,
        dt_s=config.dt_s,
        horizon_s=config.horizon_s,
        history_s=config.history_s,
        parked=config.parked,
    )


def _split(
    opened: Sequence[Recordings], source: str, config: TrainingConfig
) -> tuple[Shaped[np.ndarray, " n"], TrainedOn]:
    """The parts of the snippets of several data sets, in the order of their joined recordings."""
    splits = [snippet_parts(each, snippets_of(each, config), config.split) for each in opened]
    by_hash = {key: part for _, trained_on in splits for key, part in trained_on.parts.items()}
    parts = np.concatenate([of_data for of_data, _ in splits])
    return parts, TrainedOn(source=source, split=config.split, parts=by_hash)


def _separate_parts(training: Recordings, validation: Recordings) -> TrainedOn:
    train, select = training.hashes(), validation.hashes()
    if both := set(train) & set(select):
        names = dict(zip(select, validation.names, strict=True))
        raise AspEnvError(
            f"recording {names[min(both)]} of {validation.source!r} is in {training.source!r} too: "
            "validate on recordings that are not trained on"
        )
    parts = dict.fromkeys(train, "train") | dict.fromkeys(select, "validation")
    return TrainedOn(source=training.source, split="recording", parts=parts)


def _chosen(
    split: DatasetSplit, config: TrainingConfig, standing_share: float, max_snippets: int | None
) -> DatasetSplit:
    chosen = choose_snippets(
        split.recordings,
        split.snippets,
        standing_share=standing_share,
        max_snippets=max_snippets,
        seed=config.seed,
    )
    return DatasetSplit(recordings=split.recordings, snippets=chosen)
