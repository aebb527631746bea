"""Whether features are alive: spread, effective rank, and how well they are foreseen.

MERGED: What Lightning runs: one thin module and one callback.
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
from predictors.training.trainer import gathered, share_buffers

STILL = 1e-12
"""Below this share of their mean square, a variance of float32 features is rounding."""


@final
class Diagnosis:
    """Gathers features over a validation set, as sums: it takes no more room for more of them."""

    def __init__(self) -> None:
        """Empty."""
        self._count = 0
        self._total = torch.zeros(())
        self._products = torch.zeros(())
        self._missed = torch.zeros(())

    def add(self, features: Features | None) -> None:
        """Takes in a batch's features, if the network has any to show."""
        if features is not None:
            encoded, predicted = (each.detach().cpu().double() for each in features)
            self._count += len(encoded)
            self._total = self._total + encoded.sum(dim=0)
            self._products = self._products + encoded.T @ encoded
            self._missed = self._missed + ((encoded - predicted) ** 2).sum()

    def join(self, other: "Diagnosis") -> None:
        """Takes in what another one did, of batches that another process saw."""
        self._count += other._count
        self._total = self._total + other._total
        self._products = self._products + other._products
        self._missed = self._missed + other._missed

    def finish(self) -> dict[str, float]:
        """The numbers by name, of all that was added; nothing where nothing was.

        - Standard deviation: of each coordinate, mean over them.
        - Effective rank: see `effective_rank`, of the centred features' singular values.
        - R²: 1 less the squared errors' share of the variance, over all coordinates together. 1 is
          a perfect prediction, 0 no better than the mean; 0 where nothing varies.
        """
        if not self._count:
            return {}
        mean = self._total / self._count
        scatter = self._products - self._count * torch.outer(mean, mean)
        spread, missed = float(scatter.trace()), float(self._missed)
        if spread <= STILL * float(self._products.trace()):
            scatter, spread = torch.zeros_like(scatter), 0.0
        values = torch.linalg.eigvalsh(scatter).clamp(min=0).sqrt()
        deviation = (scatter.diagonal().clamp(min=0) / self._count).sqrt().mean()
        self._count = 0
        self._total = self._products = self._missed = torch.zeros(())
        return {
            "feature standard deviation": float(deviation),
            "feature effective rank": effective_rank(values),
            "feature R2": 1 - missed / spread if spread > 0 else 0.0,
        }


def effective_rank(values: Float[Tensor, " z"]) -> float:
    """The exponential of the entropy of singular values (Roy & Vetterli 2007).

    1 where all but one are 0, their number where all are alike; 0 where all are 0.
    """
    total = values.sum()
    if total <= 0:
        return 0.0
    share = values / total
    share = share[share > 0]
    return float(torch.exp(-(share * share.log()).sum()))


SELECTED_BY = "validation FDE moving"
"""Of the most probable mode, metres: the epoch with the lowest is kept."""

VALIDATION_LOSS = "validation loss"
"""What the schedule `plateau` watches."""

WARM_UP = 0.1
"""Share of all steps in which `one-cycle` raises the learning rate."""


PLATEAU_FACTOR, PLATEAU_PATIENCE, PLATEAU_THRESHOLD = 0.2, 2, 1e-4
"""`plateau`: what the learning rate is multiplied by, after how many epochs more than these in
which the validation loss has not fallen by this share."""


def one_cycle(step: int, steps: int) -> float:
    """The learning rate as a share of the highest: up along a line, down along a cosine."""
    rise = max(1, round(WARM_UP * steps))
    if step < rise:
        return (step + 1) / rise
    return 0.5 * (1 + math.cos(math.pi * min(1.0, (step - rise) / max(1, steps - rise))))


@final
class Fit(pl.LightningModule):
    """A network, its data in the order of epochs, and how it is optimised."""

    def __init__(
        self,
        network: AbstractNetwork,
        *,
        config: TrainingConfig,
        training: Batches,
        validation: Batches,
    ) -> None:
        """`training` holds all snippets in their order; each epoch takes its own stretch."""
        super().__init__()
        self.network = network
        self.config = config
        self._training = training
        self._validation = validation
        self._of_epoch = training
        self._sums: dict[str, Tensor] = {}
        self._found: list[dict[str, np.ndarray]] = []
        self._diagnosis = Diagnosis()
        count = len(training.snippets)
        self._per_epoch = min(config.snippets_per_epoch or count, count)
        self._steps = config.all_epochs * -(-self._per_epoch // config.batch_size)

    def train_dataloader(self) -> Iterable[tuple[Batch, Labels]]:
        """This process's share of the batches of the present epoch; asked for anew before each."""
        rows = epoch_rows(
            len(self._training.snippets),
            per_epoch=self._per_epoch,
            epoch=self.current_epoch,
            seed=self.config.seed,
        )
        self._of_epoch = self._training.reordered(rows).dealt(
            self.trainer.global_rank, self.trainer.world_size
        )
        self._sums.clear()
        return self._of_epoch

    def val_dataloader(self) -> Iterable[tuple[Batch, Labels]]:
        """This process's share of all validation batches."""
        self._validation = self._validation.dealt(self.trainer.global_rank, self.trainer.world_size)
        return self._validation

    def transfer_batch_to_device(
        self, batch: Any, device: torch.device, dataloader_idx: int
    ) -> Any:
        """As Lightning does, but for what is there already, which it takes milliseconds to see."""
        if device.type == "cpu":
            return batch
        return super().transfer_batch_to_device(batch, device, dataloader_idx)

    def configure_optimizers(self) -> Any:
        """Adam (with decoupled weight decay, if any) and the schedule of the configuration."""
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
        """Steps the schedule where Lightning does; `plateau` has its step before, in `BestCheckpoint`."""
        del metric
        if not isinstance(scheduler, ReduceLROnPlateau):
            scheduler.step()

    @property
    def is_learning_modes(self) -> bool:
        """Whether this epoch's modes are what training is after, so that it may be selected.

        Not before pre-training is over, nor while annealing still lets modes share their labels.
        """
        if self.config.network.annealed:
            ended = (self.current_epoch + 1) / self.config.all_epochs
            if ended <= ANNEAL_UNTIL and ended < 1:
                return False
        return self.current_epoch >= self.config.pretraining_epochs

    def step_plateau(self, loss: float) -> None:
        """Tells the schedule `plateau` an epoch's validation loss; other schedules do not care."""
        scheduler = self.lr_schedulers()
        if isinstance(scheduler, ReduceLROnPlateau):
            scheduler.step(loss)

    def training_step(self, sample: tuple[Batch, Labels], batch_idx: int) -> Tensor:
        """The loss of one batch, weighted so that the mean over processes is that of all targets.

        Raises:
            AspEnvError: it is not finite, in whatever process.
        """
        batch, labels = sample
        pretraining = self.current_epoch < self.config.pretraining_epochs
        moment = TrainingProgress(share=self.global_step / self._steps, pretraining=pretraining)
        terms: dict[str, Tensor] = self.network.training_loss(batch, labels, moment)
        finite = bool(torch.isfinite(terms["loss"]))
        if not self.trainer.strategy.reduce_boolean_decision(finite):
            raise AspEnvError(
                f"the loss is not finite in epoch {self.current_epoch}: lower the learning rate, "
                "or look for faults in the data with asp-env inspect"
            )
        own = self._of_epoch.own(batch_idx)
        for name, value in terms.items():
            self._sums[name] = self._sums.get(name, 0.0) + own * value.detach().double()
        if batch_idx + 1 == len(self._of_epoch):
            sums = torch.stack(list(self._sums.values()))
            means = self.trainer.strategy.reduce(sums, reduce_op="sum") / self._per_epoch
            for name, mean in zip(self._sums, means.float(), strict=True):
                self.log(f"training {name}", mean, on_step=False, on_epoch=True, batch_size=1)
        return terms["loss"] * (own * self._of_epoch.ranks / self._of_epoch.rows(batch_idx))

    def on_validation_epoch_start(self) -> None:
        """All processes evaluate the same network."""
        share_buffers(self.network)

    def validation_step(self, sample: tuple[Batch, Labels], batch_idx: int) -> None:
        """Keeps the loss and every target's errors."""
        batch, labels = sample
        modes = self.network(batch)
        own = self._validation.own(batch_idx)
        terms: dict[str, Tensor] = self.network.loss(modes, labels, TrainingProgress())
        features = self.network.features(batch, labels)
        self._diagnosis.add(features and Features(*(each[:own] for each in features)))
        truth = labels.states[..., :2].cpu().numpy()
        valid = np.ones(truth.shape[:2], dtype=bool)
        now = np.zeros((len(truth), 4), dtype=np.float32)
        now[:, 3] = batch.motion[:, 0].cpu().numpy()
        positions = modes.states[..., :2].float().cpu().numpy()
        log_probs = modes.logits.float().log_softmax(dim=-1).cpu().numpy()
        found = {
            "loss": np.full(len(truth), float(terms["loss"])),
            "moving": moving(now, truth, valid),
        }
        for selection in ("most-probable", "best-of-3"):
            errors = open_loop_errors(positions, log_probs, truth, valid, selection)
            found[selection] = errors["FDE"].value
        self._found.append({name: values[:own] for name, values in found.items()})

    def on_validation_epoch_end(self) -> None:
        """Logs the loss, and the mean errors over the subset `moving`; over all if none moves."""
        mine = {key: np.concatenate([each[key] for each in self._found]) for key in self._found[0]}
        shares = gathered((mine, self._diagnosis))
        joined = {key: np.concatenate([share[key] for share, _ in shares]) for key in mine}
        self._diagnosis = Diagnosis()
        for _, diagnosis in shares:
            self._diagnosis.join(diagnosis)
        values = self._diagnosis.finish()
        self._found.clear()
        of = joined["moving"] if joined["moving"].any() else np.ones_like(joined["moving"])
        values[VALIDATION_LOSS] = float(joined["loss"].mean())
        values[SELECTED_BY] = float(joined["most-probable"][of].mean())
        values[f"{SELECTED_BY} best of 3"] = float(joined["best-of-3"][of].mean())
        # What decides must be the same to the last bit everywhere, on whatever machines.
        values = self.trainer.strategy.broadcast(values)
        for name, value in values.items():
            self.log(name, value, prog_bar=name == SELECTED_BY)

    def optimizer_step(self, *args: Any, **kwargs: Any) -> None:
        """Takes the step, and tells the network of it."""
        super().optimizer_step(*args, **kwargs)
        self.network.after_step()


@final
class BestCheckpoint(pl.Callback):
    """After every epoch: keeps the best weights, and all that is needed to go on from there."""

    def __init__(self, *, best: Path, state: Path) -> None:
        """Where the best weights and the state of the run are written."""
        self.best_path = best
        self.state_path = state
        self.best_value = math.inf
        self.best_epoch = -1

    def state_dict(self) -> dict[str, Any]:
        """Which epoch was best so far."""
        return {"best_value": self.best_value, "best_epoch": self.best_epoch}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Takes up what `state_dict` gave."""
        self.best_value = state_dict["best_value"]
        self.best_epoch = state_dict["best_epoch"]

    def on_train_epoch_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Writes the weights first, so that the state never speaks of some that are not there."""
        value = float(trainer.callback_metrics[SELECTED_BY])
        fit = pl_module if isinstance(pl_module, Fit) else None
        learned = fit is None or fit.is_learning_modes
        if learned and value < self.best_value:
            self.best_value, self.best_epoch = value, trainer.current_epoch
            network: nn.Module = pl_module.get_submodule("network")
            if trainer.is_global_zero:
                save_weights(network.state_dict(), self.best_path)
        # Lightning would take this step after the state is saved, and a resumed run would lack it.
        if learned and fit is not None:
            fit.step_plateau(float(trainer.callback_metrics[VALIDATION_LOSS]))
        trainer.save_checkpoint(self.state_path)


@final
class EpochLogger(pl.Callback):
    """One line per epoch where there is no terminal for a progress bar."""

    def on_train_epoch_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Writes it to standard error."""
        del pl_module
        if trainer.progress_bar_callback is not None or not trainer.is_global_zero:
            return
        found = trainer.callback_metrics
        sys.stderr.write(
            f"epoch {trainer.current_epoch + 1}/{trainer.max_epochs}: training loss "
            f"{float(found['training loss']):.3f}, validation loss "
            f"{float(found[VALIDATION_LOSS]):.3f}, {SELECTED_BY} "
            f"{float(found[SELECTED_BY]):.2f} m\n"
        )
