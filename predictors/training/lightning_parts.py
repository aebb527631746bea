"""What Lightning runs: the training module, its callbacks, and the statistics of features.

The learning-rate schedules are `plateau`, which is the paper's, and `one-cycle`. In pre-training
the validation loss is that of the features alone, and there is no validation error, since the
forecast does not learn.
"""

import math
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import Any, final

import lightning.pytorch as pl
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.optim.lr_scheduler import LambdaLR, ReduceLROnPlateau

from asp_env.errors import AspEnvError
from asp_env.metrics.forecast.errors import moving, open_loop_errors
from predictors.inference.checkpoint import save_weights
from predictors.models.batch import Batch, Labels
from predictors.models.losses import ANNEAL_UNTIL
from predictors.models.network import AbstractNetwork, Features, TrainingProgress
from predictors.training.data import Batches, epoch_rows
from predictors.training.recipes import TrainingConfig
from predictors.training.trainer import gathered, share_buffers, stage_of

SELECTED_BY = "validation FDE moving"
"""FDE of the most probable mode over moving targets, metres: the epoch with the lowest is the
result of a run."""

VALIDATION_LOSS = "validation loss"
"""What the schedule `plateau` monitors."""

WARM_UP = 0.1
"""Share of all steps in which `one-cycle` raises the learning rate. Chosen by hand."""

PLATEAU_FACTOR = 0.2
"""What `plateau` multiplies the learning rate by: the paper divides it by 5."""

PLATEAU_PATIENCE = 2
"""Epochs without improvement that `plateau` tolerates: the paper lowers the rate after 3 of
them."""

PLATEAU_THRESHOLD = 1e-4
"""Relative decrease of the validation loss that counts as an improvement; PyTorch's default."""

MIN_VARIANCE_SHARE = 1e-12
"""A variance of float32 features below this share of their mean square is rounding."""


def one_cycle(step: int, steps: int) -> float:
    """The learning rate as a share of the highest: linear rise, then a half cosine to zero.

    Args:
        step: Index of the step.
        steps: Number of all steps.
    """
    rise = max(1, round(WARM_UP * steps))
    if step < rise:
        return (step + 1) / rise
    return 0.5 * (1 + math.cos(math.pi * min(1.0, (step - rise) / max(1, steps - rise))))


@final
class TrainingModule(pl.LightningModule):
    """A network, its batches in the order of epochs, and its optimisation."""

    def __init__(
        self,
        network: AbstractNetwork,
        *,
        config: TrainingConfig,
        training: Batches,
        validation: Batches,
    ) -> None:
        """Stores the arguments.

        Args:
            network: The network to train.
            config: The configuration of the run.
            training: All training snippets; each epoch takes its own stretch of them.
            validation: All validation snippets.
        """
        super().__init__()
        self.network = network
        self.config = config
        self._training = training
        self._validation = validation
        self._epoch_batches = training
        self._sums: dict[str, Tensor] = {}
        self._target_errors: list[dict[str, np.ndarray]] = []
        self._feature_statistics = FeatureStatistics()
        count = len(training.snippets)
        self._per_epoch = min(config.snippets_per_epoch or count, count)
        self._steps_per_epoch = -(-self._per_epoch // config.batch_size)
        self._steps = config.all_epochs * self._steps_per_epoch

    def train_dataloader(self) -> Iterable[tuple[Batch, Labels]]:
        """This process's shard of the current epoch's batches; called before each epoch."""
        rows = epoch_rows(
            len(self._training.snippets),
            per_epoch=self._per_epoch,
            epoch=self.current_epoch,
            seed=self.config.seed,
        )
        visited = self.current_epoch * self._per_epoch
        self._epoch_batches = self._training.reordered(rows, visited=visited).shard(
            self.trainer.global_rank, self.trainer.world_size
        )
        self._sums.clear()
        return self._epoch_batches

    def val_dataloader(self) -> Iterable[tuple[Batch, Labels]]:
        """This process's shard of all validation batches."""
        self._validation = self._validation.shard(self.trainer.global_rank, self.trainer.world_size)
        return self._validation

    def transfer_batch_to_device(
        self, batch: Any, device: torch.device, dataloader_idx: int
    ) -> Any:
        """Moves a batch, but not to the CPU, where it is already: the check takes milliseconds."""
        if device.type == "cpu":
            return batch
        return super().transfer_batch_to_device(batch, device, dataloader_idx)

    def configure_optimizers(self) -> Any:
        """AdamW (Adam if there is no weight decay) and the schedule of the configuration."""
        optimizer = torch.optim.AdamW(
            self.network.parameters(),
            lr=self.config.learning_rate,
            weight_decay=self.config.weight_decay,
            fused=True,
        )
        if self.config.schedule == "plateau":
            plateau = ReduceLROnPlateau(
                optimizer,
                factor=PLATEAU_FACTOR,
                patience=PLATEAU_PATIENCE,
                threshold=PLATEAU_THRESHOLD,
            )
            return {
                "optimizer": optimizer,
                "lr_scheduler": {"scheduler": plateau, "monitor": VALIDATION_LOSS},
            }
        cycle = LambdaLR(optimizer, lambda step: one_cycle(step, self._steps))
        return {
            "optimizer": optimizer,
            "lr_scheduler": {"scheduler": cycle, "interval": "step"},
        }

    def lr_scheduler_step(self, scheduler: Any, metric: Any) -> None:
        """Steps the schedule; `plateau` is stepped earlier, by `BestCheckpoint`."""
        del metric
        if not isinstance(scheduler, ReduceLROnPlateau):
            scheduler.step()

    @property
    def is_pretraining(self) -> bool:
        """Whether the current epoch is one of pre-training."""
        return self.current_epoch < self.config.pretraining_epochs

    @property
    def is_selectable(self) -> bool:
        """Whether the current epoch may be the result of the run.

        It may not in pre-training, nor while annealing lets several modes learn from a label.
        """
        if self.config.network.annealed:
            ended = self._progress((self.current_epoch + 1) * self._steps_per_epoch)
            if ended <= ANNEAL_UNTIL and ended < 1:
                return False
        return not self.is_pretraining

    def _progress(self, steps: int) -> float:
        """Share of the steps of the progress epochs that is over after some steps of the run."""
        epochs = self.config.progress_epochs or self.config.epochs
        before = self.config.pretraining_epochs * self._steps_per_epoch
        return min(1.0, max(0, steps - before) / (epochs * self._steps_per_epoch))

    def step_plateau(self, loss: float) -> None:
        """Steps the schedule `plateau` with an epoch's validation loss; ignores other schedules."""
        scheduler = self.lr_schedulers()
        if isinstance(scheduler, ReduceLROnPlateau):
            scheduler.step(loss)

    def training_step(self, sample: tuple[Batch, Labels], batch_idx: int) -> Tensor:
        """The loss of one batch, weighted so that the mean over processes is that of all targets.

        Raises:
            AspEnvError: It is not finite in one of the processes.
        """
        batch, labels = sample
        progress = TrainingProgress(
            share=self._progress(self.global_step),
            pretraining=self.is_pretraining,
        )
        terms: dict[str, Tensor] = self.network.training_loss(batch, labels, progress)
        finite = bool(torch.isfinite(terms["loss"]))
        if not self.trainer.strategy.reduce_boolean_decision(finite):
            raise AspEnvError(
                f"the loss is not finite in epoch {self.current_epoch}: lower the learning rate, "
                "or look for faults in the data with asp-env inspect"
            )
        batches = self._epoch_batches
        own = batches.num_own(batch_idx)
        for name, value in terms.items():
            self._sums[name] = self._sums.get(name, 0.0) + own * value.detach().double()
        if batch_idx + 1 == len(batches):
            sums = torch.stack(list(self._sums.values()))
            means = self.trainer.strategy.reduce(sums, reduce_op="sum") / self._per_epoch
            for name, mean in zip(self._sums, means.float(), strict=True):
                self.log(f"training {name}", mean, on_step=False, on_epoch=True, batch_size=1)
        return terms["loss"] * (own * batches.num_shards / batches.num_snippets(batch_idx))

    def on_validation_epoch_start(self) -> None:
        """Gives all processes the same running statistics."""
        share_buffers(self.network)

    def validation_step(self, sample: tuple[Batch, Labels], batch_idx: int) -> None:
        """Stores the loss and every target's errors."""
        batch, labels = sample
        modes = self.network(batch)
        own = self._validation.num_own(batch_idx)
        progress = TrainingProgress(pretraining=self.is_pretraining)
        terms, features = self.network.validate(modes, batch, labels, progress)
        self._feature_statistics.add(features and Features(*(each[:own] for each in features)))
        truth = labels.states[..., :2].cpu().numpy()
        valid = np.ones(truth.shape[:2], dtype=bool)
        now = np.zeros((len(truth), 4), dtype=np.float32)
        now[:, 3] = batch.motion[:, 0].cpu().numpy()
        modes = modes._replace(logits=modes.logits.float().log_softmax(dim=-1))
        modes = self.network.with_standing(batch, modes)
        positions = modes.states[..., :2].float().cpu().numpy()
        log_probs = modes.logits.cpu().numpy()
        values = {
            "loss": np.full(len(truth), float(terms["loss"])),
            "moving": moving(now, truth, valid),
        }
        for selection in ("most-probable", "best-of-3"):
            errors = open_loop_errors(positions, log_probs, truth, valid, selection)
            values[selection] = errors["FDE"].value
        self._target_errors.append({name: array[:own] for name, array in values.items()})

    def on_validation_epoch_end(self) -> None:
        """Logs the loss, and the mean errors over the subset `moving`; over all if none moves.

        There are no errors in pre-training.
        """
        own = {
            name: np.concatenate([each[name] for each in self._target_errors])
            for name in self._target_errors[0]
        }
        of_processes = gathered((own, self._feature_statistics))
        joined = {name: np.concatenate([each[name] for each, _ in of_processes]) for name in own}
        self._feature_statistics = FeatureStatistics()
        for _, statistics in of_processes:
            self._feature_statistics.join(statistics)
        values = self._feature_statistics.finish()
        self._target_errors.clear()
        rows = joined["moving"] if joined["moving"].any() else np.ones_like(joined["moving"])
        values[VALIDATION_LOSS] = float(joined["loss"].mean())
        if not self.is_pretraining:
            values[SELECTED_BY] = float(joined["most-probable"][rows].mean())
            values[f"{SELECTED_BY} best of 3"] = float(joined["best-of-3"][rows].mean())
        # What decides must be equal bit for bit in all processes, on any machines.
        values = self.trainer.strategy.broadcast(values)
        for name, value in values.items():
            self.log(name, value, prog_bar=name == SELECTED_BY)

    def optimizer_step(self, *args: Any, **kwargs: Any) -> None:
        """Takes the step, then calls the network's `after_step`."""
        super().optimizer_step(*args, **kwargs)
        self.network.after_step()


@final
class BestCheckpoint(pl.Callback):
    """Writes the best weights and the state of the run after every epoch.

    A run with `patience` ends after that many selectable epochs without a better one; the count is
    part of the state, so that a resumed run ends after the same epoch.
    """

    def __init__(self, *, best: Path, state: Path) -> None:
        """Stores the paths of the best weights and of the state."""
        self.best_path = best
        self.state_path = state
        self.best_value = math.inf
        self.best_epoch = -1
        self.last_epoch = -1
        self.waited = 0
        """Selectable epochs since the best one."""

    @property
    def state_key(self) -> str:
        """Key of this callback in the state of a run; an earlier name of the class."""
        return "KeepBest"

    def state_dict(self) -> dict[str, Any]:
        """The best epoch, its error, the last epoch, and the epochs without improvement."""
        return {
            "best_value": self.best_value,
            "best_epoch": self.best_epoch,
            "last_epoch": self.last_epoch,
            "waited": self.waited,
        }

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restores what `state_dict` returned."""
        self.best_value = state_dict["best_value"]
        self.best_epoch = state_dict["best_epoch"]
        self.last_epoch = state_dict["last_epoch"]
        self.waited = state_dict["waited"]

    def on_train_start(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Ends a run that was interrupted after its last epoch."""
        self._stop_if_converged(trainer, pl_module)

    def on_train_epoch_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Writes the weights before the state, so that the state never refers to missing ones."""
        module = pl_module if isinstance(pl_module, TrainingModule) else None
        self.last_epoch = trainer.current_epoch
        if module is None or module.is_selectable:
            value = float(trainer.callback_metrics[SELECTED_BY])
            self.waited += 1
            if value < self.best_value:
                self.best_value, self.best_epoch, self.waited = value, trainer.current_epoch, 0
                network: nn.Module = pl_module.get_submodule("network")
                if trainer.is_global_zero:
                    save_weights(network.state_dict(), self.best_path)
            # Lightning would step after the state is saved, and a resumed run would lack the step.
            if module is not None:
                module.step_plateau(float(trainer.callback_metrics[VALIDATION_LOSS]))
        trainer.save_checkpoint(self.state_path)
        self._stop_if_converged(trainer, pl_module)

    def _stop_if_converged(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        if isinstance(pl_module, TrainingModule):
            patience = pl_module.config.patience
            trainer.should_stop = patience is not None and self.waited >= patience


@final
class EpochLogger(pl.Callback):
    """Writes one line per epoch where there is no terminal for a progress bar."""

    def on_train_epoch_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Writes the line to standard error."""
        if trainer.progress_bar_callback is not None or not trainer.is_global_zero:
            return
        assert isinstance(pl_module, TrainingModule)
        metrics = trainer.callback_metrics
        error = "n/a" if pl_module.is_pretraining else f"{float(metrics[SELECTED_BY]):.2f} m"
        sys.stderr.write(
            f"{stage_of(pl_module.config, trainer.current_epoch)}: training loss "
            f"{float(metrics['training loss']):.3f}, validation loss "
            f"{float(metrics[VALIDATION_LOSS]):.3f}, {SELECTED_BY} {error}\n"
        )


@final
class FeatureStatistics:
    """Spread, effective rank and predictability of features over a validation set.

    Only sums are stored, so the memory does not grow with the number of targets.
    """

    def __init__(self) -> None:
        self._count = 0
        self._total = torch.zeros(())
        self._products = torch.zeros(())
        self._squared_error = torch.zeros(())

    def add(self, features: Features | None) -> None:
        """Adds a batch; None for a network without features."""
        if features is not None:
            encoded, predicted = (each.detach().cpu().double() for each in features)
            self._count += len(encoded)
            self._total = self._total + encoded.sum(dim=0)
            self._products = self._products + encoded.T @ encoded
            self._squared_error = self._squared_error + ((encoded - predicted) ** 2).sum()

    def join(self, other: "FeatureStatistics") -> None:
        """Adds the batches of another process."""
        self._count += other._count
        self._total = self._total + other._total
        self._products = self._products + other._products
        self._squared_error = self._squared_error + other._squared_error

    def finish(self) -> dict[str, float]:
        """Computes the statistics of all batches and starts anew.

        Returns:
            Nothing if nothing was added, else

            - `feature standard deviation`: mean over the coordinates.
            - `feature effective rank`: `effective_rank` of the centred features' singular values.
            - `feature R2`: 1 minus the share of the squared errors in the variance, over all
              coordinates together. 1 is a perfect prediction, 0 no better than the mean; 0 if the
              features do not vary.
        """
        if not self._count:
            return {}
        mean = self._total / self._count
        scatter = self._products - self._count * torch.outer(mean, mean)
        variation, error = float(scatter.trace()), float(self._squared_error)
        if variation <= MIN_VARIANCE_SHARE * float(self._products.trace()):
            scatter, variation = torch.zeros_like(scatter), 0.0
        values = torch.linalg.eigvalsh(scatter).clamp(min=0).sqrt()
        deviation = (scatter.diagonal().clamp(min=0) / self._count).sqrt().mean()
        self._count = 0
        self._total = self._products = self._squared_error = torch.zeros(())
        return {
            "feature standard deviation": float(deviation),
            "feature effective rank": effective_rank(values),
            "feature R2": 1 - error / variation if variation > 0 else 0.0,
        }


def effective_rank(values: Float[Tensor, " z"]) -> float:
    """The exponential of the entropy of singular values (Roy & Vetterli 2007).

    Returns:
        1 if all values but one are 0, their number if all are equal; 0 if all are 0.
    """
    total = values.sum()
    if total <= 0:
        return 0.0
    share = values / total
    share = share[share > 0]
    return float(torch.exp(-(share * share.log()).sum()))
