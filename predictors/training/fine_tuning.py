"""Fine-tuning: a finished run continues on a small data set, at a low learning rate.

View, network, history, horizon, time step and normaliser are those of the run. Nothing else is
needed of it: `--start` gives initial weights to a whole training by a recipe, `--from` changes the
weights of a run as little as the data demand:

- Every step takes half of its snippets from other data, if there are any (`mix`), so that the
  network does not forget what it was trained on.
- After each epoch the weights are validated; the learning rate falls where the error does not, and
  the fine-tuning ends after `PATIENCE` epochs without a lower one.
- The weights of the best epoch are averaged with those of the start (WiSE-FT: Wortsman et al.,
  "Robust fine-tuning of zero-shot models", CVPR 2022), by the share of `SHARES` with the lowest
  validation error.
- The start counts as epoch 0: the result differs from it only if its validation error is lower by
  more than the standard error of the difference, with the vehicles as clusters. A few vehicles say
  little, and the lowest of many errors is low by chance.

The error is the FDE of the most probable mode over moving targets, as in every training.

It runs on one device, for minutes; the folder appears when it is finished.
"""

import copy
import dataclasses
import math
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, final

import numpy as np
import torch
from jaxtyping import Float, Int
from lightning.fabric.utilities import move_data_to_device
from torch import Tensor

from asp_env import registry
from asp_env.data.snippets import SnippetIndex
from asp_env.data.source import join_data
from asp_env.data.split import Split, TrainedOn
from asp_env.errors import AspEnvError, CheckpointError
from asp_env.files import atomic_folder
from asp_env.metrics.forecast.errors import moving, open_loop_errors
from predictors.inference.calibration import forecast_temperature
from predictors.inference.checkpoint import (
    PredictorSpec,
    load_trained,
    read_config,
    save_trained,
    weights_hash,
)
from predictors.inference.trained import TrainedPredictor
from predictors.models.network import AbstractNetwork, TrainingProgress
from predictors.training.augmentation import Augmentation
from predictors.training.data import (
    VALIDATION_BATCH,
    Batches,
    DatasetSplit,
    TrainingData,
    choose_snippets,
    epoch_rows,
    open_all,
    open_training_data,
    snippets_of,
)
from predictors.training.fitting import add_features, versions
from predictors.training.recipes import TrainingConfig
from predictors.training.trainer import threads

FINE_TUNED = "fine-tuned"
"""What follows the name of the recipe, as the name of a variant does."""

EPOCHS = 30
"""Largest number of epochs. Chosen by hand; early stopping ends most runs before."""

LEARNING_RATE_SHARE = 0.1
"""Learning rate as a share of the run's highest one. Chosen by hand: a lower one takes more epochs
than `EPOCHS`, a higher one leaves the start at once."""

RATE_FACTOR, RATE_PATIENCE = 0.2, 3
"""The learning rate is multiplied by the factor after so many epochs without a lower error, as the
paper's schedule does."""

PATIENCE = 6
"""Epochs without a lower error that end the fine-tuning. Chosen by hand: two falls of the rate."""

MIN_EPOCH, MAX_EPOCH = 512, 6000
"""Lowest and highest number of own snippets in an epoch; fewer are repeated. Chosen by hand: an
epoch of a few steps changes less than its validation error varies, and `MAX_EPOCH` is that of the
small recipes."""

SHARES = (0.25, 0.5, 0.75, 1.0)
"""Shares of the fine-tuned weights in the average with those of the start. Chosen by hand."""

MIN_CALIBRATION_TARGETS = 100
"""Lowest number of validation targets at which probabilities are calibrated anew. Chosen by hand: a
temperature that is fitted on 100 targets has a standard error of about 10 %."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FineTuning:
    """Options of a fine-tuning; everything else is of the run that it starts from."""

    split: Split | None = None
    """None for a split by recording, or by blocks if there are too few recordings."""
    validation: tuple[str, ...] = ()
    """Separate validation data; all of DATA is then trained on."""
    mix: tuple[str, ...] = ()
    """Other data, which half of each batch is taken from."""
    epochs: int = EPOCHS
    """Largest number of epochs."""
    seed: int = 0
    max_snippets: int | None = None
    """Largest number of snippets of DATA to train on, chosen at random; None for all."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ValidationErrors:
    """FDE of the most probable mode (m) of N moving validation targets."""

    fde_m: Float[np.ndarray, " n"]
    vehicle: Int[np.ndarray, " n"]
    """Number of the vehicle that each target is."""

    @property
    def mean_m(self) -> float:
        """Mean over the targets, metres."""
        return float(self.fde_m.mean())


def fine_tune(
    predictor: str,
    start: Path,
    data: str | Sequence[str],
    out: Path,
    options: FineTuning,
) -> Path:
    """Fine-tunes a finished run.

    Args:
        predictor: Name of the predictor.
        start: The folder of the run.
        data: One or several DATA, as `open_data` takes them.
        out: The folder of the result, which must not exist, or be empty.
        options: The options.

    Returns:
        `out`, a finished run.

    Raises:
        CheckpointError: `start` is no finished run of the predictor.
        AspEnvError: The data or an option are bad, or the loss is not finite.
    """
    config = config_from(predictor, start, options)
    config, chosen = _open(config, data, options.split)
    return fine_tune_on(predictor, start, chosen, out, config=config, mix=options.mix)


def fine_tune_on(
    predictor: str,
    start: Path,
    data: TrainingData,
    out: Path,
    *,
    config: TrainingConfig,
    mix: Sequence[str] = (),
) -> Path:
    """Fine-tunes a finished run on data that are open and split.

    Args:
        predictor: Name of the predictor.
        start: The folder of the run.
        data: Training and validation snippets.
        out: The folder of the result.
        config: As `config_from` returns it.
        mix: Other data, which half of each batch is taken from.

    Returns:
        `out`.

    Raises:
        AspEnvError: As `fine_tune`.
    """
    spec: PredictorSpec = registry.find("predictors", predictor)
    with atomic_folder(out) as folder:
        before = load_trained(spec, str(start))
        own = len(data.training.snippets)
        training, mixed = _with_mix(data.training, mix, config)
        network = copy.deepcopy(before.network)
        settings: dict[str, Any] = {"view": before.view, "later_ticks": network.later_ticks}
        as_recorded = dataclasses.replace(config, augmentation=None)
        course = _Course(
            network,
            config,
            training.batches(size=config.batch_size, config=config, **settings),
            data.validation.batches(size=VALIDATION_BATCH, config=as_recorded, **settings),
            own=own,
        )
        with threads(config.threads):
            course.run()
        share, errors = course.average(before.network)
        temperature = read_config(start)["temperature"]
        calibrated = len(data.validation.snippets) >= MIN_CALIBRATION_TARGETS
        if calibrated:
            temperature = forecast_temperature(network, course.validation)
        save_trained(
            folder,
            spec=spec,
            network_config=network.config,
            shape=network.shape,
            view=before.view,
            weights=network.state_dict(),
            temperature=temperature,
            provenance={
                "config": dataclasses.asdict(config),
                "data_hash": data.data_hash,
                "start": weights_hash(start),
                "fine_tuning": {
                    "mix": list(mix),
                    "mix_hash": mixed.data_hash if mixed else None,
                    "validation FDE moving": course.values,
                    "share": share,
                    "calibrated": calibrated,
                },
                "trained_on": dataclasses.asdict(_trained_on(data.trained_on, before, mixed)),
                "snippets": {
                    "training": own,
                    "validation": len(data.validation.snippets),
                    **({"mixed in": len(training.snippets) - own} if mixed else {}),
                },
                "best_epoch": course.best_epoch if share else 0,
                "best_value": errors.mean_m,
                "versions": versions(),
            },
        )
        add_features(spec, folder, data.validation, config)
    return out


def config_from(predictor: str, start: Path, options: FineTuning) -> TrainingConfig:
    """The configuration of a fine-tuning: that of the run, with another schedule.

    Args:
        predictor: Name of the predictor.
        start: The folder of the run.
        options: The options.

    Raises:
        CheckpointError: The folder holds no finished run of the predictor, or does not state how it
            was trained.
    """
    spec: PredictorSpec = registry.find("predictors", predictor)
    network = load_trained(spec, str(start)).network
    stored = read_config(start)["provenance"].get("config", {})
    known = {field.name for field in dataclasses.fields(TrainingConfig)}
    fields = {name: value for name, value in _with_tuples(stored).items() if name in known}
    fields["network"] = network.config
    try:
        if fields.get("augmentation") is not None:
            fields["augmentation"] = Augmentation(**fields["augmentation"])
        config = TrainingConfig(**fields)
    except TypeError as error:
        raise CheckpointError(
            f"{start} does not state how it was trained: fine-tune a run of asp-env train"
        ) from error
    base = config.preset.removesuffix(f"+{FINE_TUNED}")
    return dataclasses.replace(
        config,
        preset=f"{base}+{FINE_TUNED}",
        split=options.split or "recording",
        validation=options.validation,
        seed=options.seed,
        max_snippets=options.max_snippets,
        epochs=options.epochs,
        pretraining_epochs=0,
        budget="epochs",
        patience=None,
        progress_epochs=None,
        learning_rate=LEARNING_RATE_SHARE * config.learning_rate,
    )


def _with_tuples(fields: dict[str, Any]) -> dict[str, Any]:
    """Fields of a stored configuration; JSON has lists for tuples."""
    return {
        name: tuple(value)
        if isinstance(value, list)
        else _with_tuples(value)
        if isinstance(value, dict)
        else value
        for name, value in fields.items()
    }


def _open(
    config: TrainingConfig, data: str | Sequence[str], split: Split | None
) -> tuple[TrainingConfig, TrainingData]:
    """Opens the data; split by blocks if no split is given and there are too few recordings."""
    if split is not None or config.validation:
        return config, open_training_data(config, data)
    try:
        return config, open_training_data(config, data)
    except AspEnvError as error:
        blocks = dataclasses.replace(config, split="blocks")
        try:
            found = open_training_data(blocks, data)
        except AspEnvError:
            raise error from None
    sys.stderr.write(
        "too few recordings for a split by recording: split by blocks of time within each "
        "(--split blocks), or give --validation\n"
    )
    return blocks, found


@dataclass(frozen=True, slots=True, kw_only=True)
class _Mixed:
    """Other data that are mixed in."""

    source: str
    hashes: tuple[str, ...]
    data_hash: str


def _with_mix(
    training: DatasetSplit, mix: Sequence[str], config: TrainingConfig
) -> tuple[DatasetSplit, _Mixed | None]:
    """The training snippets followed by those of other data, if there are any."""
    if not mix:
        return training, None
    other = join_data(open_all(mix, config.dt_s))
    chosen = choose_snippets(
        other,
        snippets_of(other, config),
        standing_share=config.standing_share,
        max_snippets=None,
        seed=config.seed,
    )
    own = training.snippets
    joined = SnippetIndex(
        recording=np.concatenate([own.recording, len(training.recordings) + chosen.recording]),
        track=np.concatenate([own.track, chosen.track]),
        tick=np.concatenate([own.tick, chosen.tick]),
        dt_s=own.dt_s,
        history=own.history,
        horizon_ticks=own.horizon_ticks,
    )
    recordings = join_data([training.recordings, other])
    mixed = _Mixed(source=other.source, hashes=other.hashes(), data_hash=other.data_hash())
    return DatasetSplit(recordings=recordings, snippets=joined), mixed


def _trained_on(own: TrainedOn, before: TrainedPredictor, mixed: _Mixed | None) -> TrainedOn:
    """The recordings of the start, of the other data and of the fine-tuning itself."""
    parts, sources = dict(own.parts), [own.source]
    if mixed is not None:
        parts |= dict.fromkeys(mixed.hashes, "train")
        sources.append(mixed.source)
    if before.trained_on is None:
        return TrainedOn(source=own.source, split=own.split, parts=parts)
    sources.insert(0, before.trained_on.source)
    source = ", ".join(dict.fromkeys(sources))
    return TrainedOn(source=source, split=own.split, parts=parts).continued_from(before.trained_on)


def mixed_rows(
    own: int, mixed: int, *, per_epoch: int, epoch: int, seed: int
) -> Int[np.ndarray, " rows"]:
    """Rows of the snippets of an epoch: own and mixed ones in turn, or own ones alone.

    Args:
        own: Number of own snippets, which come first.
        mixed: Number of the others.
        per_epoch: Own snippets of an epoch.
        epoch: Index of the epoch.
        seed: Seed of the order.
    """
    rows = epoch_rows(own, per_epoch=per_epoch, epoch=epoch, seed=seed)
    if not mixed:
        return rows
    others = epoch_rows(mixed, per_epoch=per_epoch, epoch=epoch, seed=seed)
    return np.stack([rows, own + others], axis=1).reshape(-1)


@final
class _Course:
    """The epochs of a fine-tuning; `network` holds the best weights at the end."""

    def __init__(
        self,
        network: AbstractNetwork,
        config: TrainingConfig,
        training: Batches,
        validation: Batches,
        *,
        own: int,
    ) -> None:
        self._network = network
        self._config = config
        self._training = training
        self._own = own
        self._device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
        self.validation = validation
        self.values: list[float] = []
        """Validation error of each epoch, metres; the first is that of the start."""
        self.best_epoch = 0

    def run(self) -> None:
        """Trains until the error has not fallen for `PATIENCE` epochs."""
        network, config = self._network.to(self._device), self._config
        optimizer = torch.optim.AdamW(
            network.parameters(), lr=config.learning_rate, weight_decay=config.weight_decay
        )
        best = _weights_of(network)
        self.values = [validation_errors(network, self.validation, self._device).mean_m]
        for epoch in range(config.epochs):
            loss = self._train(epoch, optimizer)
            self.values.append(validation_errors(network, self.validation, self._device).mean_m)
            sys.stderr.write(
                f"epoch {epoch + 1}/{config.epochs}: training loss {loss:.3f}, validation FDE "
                f"moving {self.values[-1]:.2f} m (start {self.values[0]:.2f} m)\n"
            )
            if self.values[-1] < self.values[self.best_epoch]:
                self.best_epoch, best = epoch + 1, _weights_of(network)
            waited = epoch + 1 - self.best_epoch
            if waited >= PATIENCE:
                break
            if waited and waited % RATE_PATIENCE == 0:
                for group in optimizer.param_groups:
                    group["lr"] *= RATE_FACTOR
        network.load_state_dict(best)

    def _train(self, epoch: int, optimizer: torch.optim.Optimizer) -> float:
        """One epoch; returns the mean loss."""
        network, config = self._network.train(), self._config
        rows = mixed_rows(
            self._own,
            len(self._training.snippets) - self._own,
            per_epoch=min(max(self._own, MIN_EPOCH), MAX_EPOCH),
            epoch=epoch,
            seed=config.seed,
        )
        total, count = 0.0, 0
        mixed_precision = config.precision == "bf16-mixed"
        for sample in self._training.reordered(rows):
            batch, labels = move_data_to_device(sample, self._device)
            with torch.autocast(self._device.type, torch.bfloat16, enabled=mixed_precision):
                loss = network.training_loss(batch, labels, TrainingProgress())["loss"]
            if not bool(torch.isfinite(loss)):
                raise AspEnvError(
                    f"the loss is not finite in epoch {epoch + 1}: look for faults in the data "
                    "with asp-env inspect"
                )
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            network.after_step()
            total += float(loss.detach()) * len(labels.states)
            count += len(labels.states)
        return total / count

    def average(self, start: AbstractNetwork) -> tuple[float, ValidationErrors]:
        """Averages the best weights with those of the start, and loads the result on the CPU.

        Returns:
            The share of the fine-tuned weights, and the validation errors of the result.
        """
        network, device = self._network, self._device
        first, tuned = _weights_of(start.to(device)), _weights_of(network)
        of_start = validation_errors(start, self.validation, device)
        found: list[tuple[float, float, ValidationErrors]] = []
        for share in SHARES:
            network.load_state_dict(interpolated(first, tuned, share))
            errors = validation_errors(network, self.validation, device)
            found.append((errors.mean_m, share, errors))
        _, share, errors = min(found, key=lambda each: each[:2])
        if not is_improved(of_start, errors):
            share, errors = 0.0, of_start
            sys.stderr.write(
                "the weights of the start remain: the validation error is not lower by more than "
                "its standard error; give more data\n"
            )
        network.load_state_dict(interpolated(first, tuned, share))
        network.eval().cpu()
        start.cpu()
        return share, errors


def interpolated(
    start: Mapping[str, Tensor], tuned: Mapping[str, Tensor], share: float
) -> dict[str, Tensor]:
    """Weights between two: `start + share (tuned - start)`; integers are those of `tuned`.

    A share of 0 or 1 returns the bits of one of them.
    """
    if share in (0.0, 1.0):
        return dict(tuned if share else start)
    return {
        name: torch.lerp(value, tuned[name], share) if value.is_floating_point() else tuned[name]
        for name, value in start.items()
    }


def is_improved(start: ValidationErrors, tuned: ValidationErrors) -> bool:
    """Whether the mean error is lower by more than the standard error of the difference.

    The targets of a vehicle are not independent, so the standard error is that of a mean over
    clusters, with the vehicles as clusters: the root of the sum over vehicles of the squared sums
    of deviations, over the number of targets. With one vehicle it is not defined, and nothing is an
    improvement.
    """
    gain = start.fde_m.astype(np.float64) - tuned.fde_m
    mean = gain.mean()
    sums = np.bincount(start.vehicle, weights=gain - mean)
    vehicles = len(np.unique(start.vehicle))
    if vehicles < 2:
        return False
    error = math.sqrt(float((sums**2).sum()) * vehicles / (vehicles - 1)) / len(gain)
    return bool(mean > error)


@torch.inference_mode()
def validation_errors(
    network: AbstractNetwork, batches: Batches, device: torch.device
) -> ValidationErrors:
    """Errors over the subset `moving`, or over all targets if none moves; sets evaluation mode.

    Args:
        network: The network, on `device`.
        batches: Validation batches.
        device: The device.
    """
    network.eval()
    errors, in_motion = [], []
    for sample in batches:
        batch, labels = move_data_to_device(sample, device)
        modes = network(batch)
        modes = modes._replace(logits=modes.logits.float().log_softmax(dim=-1))
        modes = network.with_standing(batch, modes)
        truth = labels.states[..., :2].cpu().numpy()
        valid = np.ones(truth.shape[:2], dtype=bool)
        now = np.zeros((len(truth), 4), dtype=np.float32)
        now[:, 3] = batch.motion[:, 0].cpu().numpy()
        found = open_loop_errors(
            modes.states[..., :2].float().cpu().numpy(),
            modes.logits.cpu().numpy(),
            truth,
            valid,
            "most-probable",
        )
        errors.append(found["FDE"].value)
        in_motion.append(moving(now, truth, valid))
    mask = np.concatenate(in_motion)
    rows = np.flatnonzero(mask) if mask.any() else np.arange(len(mask))
    index = batches.snippets
    _, vehicle = np.unique(
        np.stack([index.recording, index.track], axis=-1), axis=0, return_inverse=True
    )
    return ValidationErrors(fde_m=np.concatenate(errors)[rows], vehicle=vehicle.reshape(-1)[rows])


def _weights_of(network: AbstractNetwork) -> dict[str, Tensor]:
    return {name: value.detach().clone() for name, value in network.state_dict().items()}
