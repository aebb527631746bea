"""The Lightning trainer: devices and nodes, and the state of an unfinished run as safetensors.

Processes share every batch evenly, so that `batch_size` is that of all of them together and the
weights are those of one process up to rounding. On GPUs batch statistics are those of the whole
batch; between CPUs they are not exchanged, and each process normalises by its own shard of a batch.
"""

import importlib.util
import json
import logging
import os
import shutil
import sys
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, TypeVar, final

import lightning.pytorch as pl
import torch
from lightning.fabric.plugins.environments.lightning import LightningEnvironment
from lightning.fabric.utilities.exceptions import MisconfigurationException
from lightning.fabric.utilities.types import _PATH
from lightning.pytorch.callbacks import TQDMProgressBar
from lightning.pytorch.loggers import CSVLogger, TensorBoardLogger
from lightning.pytorch.plugins.io import CheckpointIO
from lightning.pytorch.strategies import DDPStrategy, ParallelStrategy
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import distributed, nn

from asp_env.errors import AspEnvError, CheckpointError
from asp_env.stored import parse_json
from predictors.inference.checkpoint import write_file
from predictors.training.recipes import TrainingConfig

T = TypeVar("T")

LOGS = "logs"
"""Folder of the logs within a run."""

RENDEZVOUS = ("MASTER_ADDR", "MASTER_PORT", "NODE_RANK")
"""Environment variables by which nodes find each other without a launcher."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Hardware:
    """Where a run is computed; it changes the weights only by rounding and batch statistics."""

    devices: int | Literal["auto"] = 1
    """Processes on each node, with a GPU each if there are GPUs; `auto` is one per GPU."""
    nodes: int = 1
    """Number of machines; the command is started on each of them."""
    strategy: Literal["auto", "ddp"] = "auto"
    """`ddp` forces distributed training even for a single process."""
    compiled: bool = False
    """Whether the encoder is compiled by `torch.compile`."""
    num_workers: int = 0
    """Processes for data loading of each device; with 0, a thread loads."""

    def __post_init__(self) -> None:
        """Checks the numbers.

        Raises:
            AspEnvError: A number is too low, or there is no compiler.
        """
        if self.num_workers < 0:
            raise AspEnvError(f"training: num_workers is {self.num_workers}, expected 0 or more")
        for field in ("devices", "nodes"):
            value = getattr(self, field)
            if value != "auto" and value < 1:
                raise AspEnvError(f"training: {field} is {value}, expected 1 or more")
        if self.compiled:
            _check_compiler()

    @property
    def devices_per_node(self) -> int:
        """`devices` as a number."""
        return max(1, torch.cuda.device_count()) if self.devices == "auto" else self.devices


def make_trainer(
    config: TrainingConfig,
    hardware: Hardware,
    *,
    out: Path,
    started: str,
    callbacks: Sequence[pl.Callback],
    shown: bool = True,
) -> pl.Trainer:
    """Makes the trainer of a run.

    Args:
        config: The configuration.
        hardware: Devices and nodes.
        out: The run's folder.
        started: Folder of the logs within `out/logs`.
        callbacks: Lightning's callbacks.
        shown: Whether there is a progress bar on a terminal, and logs are written.

    Raises:
        AspEnvError: There are too few devices, the nodes cannot find each other, or a batch has
            fewer snippets than there are processes.
    """
    count = hardware.devices_per_node
    processes = count * hardware.nodes
    launched = int(os.environ.get("WORLD_SIZE", processes))
    if "LOCAL_RANK" in os.environ and launched != processes:
        raise AspEnvError(
            f"training: a launcher started {launched} processes for {count} devices of "
            f"{hardware.nodes} nodes: give --devices and --nodes as it has them"
        )
    strategy: DDPStrategy | Literal["auto"] = "auto"
    if processes > 1 or hardware.strategy == "ddp":
        # In pre-training the action predictor gets no gradient.
        strategy = DDPStrategy(find_unused_parameters=config.pretraining_epochs > 0)
    has_bar = shown and sys.stderr.isatty()
    loggers = (CSVLogger, TensorBoardLogger) if shown else ()
    try:
        with quiet():
            trainer = pl.Trainer(
                accelerator="auto",
                devices=count,
                num_nodes=hardware.nodes,
                strategy=strategy,
                sync_batchnorm=processes > 1 and torch.cuda.is_available(),
                use_distributed_sampler=False,
                precision=config.precision,
                max_epochs=config.all_epochs,
                callbacks=[*callbacks, *([StageProgressBar(config)] if has_bar else [])],
                logger=[each(out, name=LOGS, version=started) for each in loggers],
                plugins=[SafetensorsIO()],
                enable_checkpointing=False,
                enable_model_summary=False,
                enable_progress_bar=has_bar,
                num_sanity_val_steps=0,
                reload_dataloaders_every_n_epochs=1,
                log_every_n_steps=50,
            )
    except (MisconfigurationException, RuntimeError, ValueError) as error:
        raise AspEnvError(
            f"training on {count} devices of {hardware.nodes} nodes: {' '.join(str(error).split())}"
        ) from error
    if config.batch_size < processes:
        raise AspEnvError(
            f"training: batches of {config.batch_size} cannot be shared by {processes} processes: "
            "take fewer devices or nodes"
        )
    if hardware.nodes > 1 and _launches(trainer):
        missing = [name for name in RENDEZVOUS if name not in os.environ]
        if missing:
            raise AspEnvError(
                f"training on {hardware.nodes} nodes: {', '.join(missing)} not set; give the "
                "first node's address, a free port there and this node's number, or use torchrun"
            )
    return trainer


def stage_of(config: TrainingConfig, epoch: int) -> str:
    """The name of an epoch for messages, such as `pre-training 1/3` or `epoch 1/10`.

    Args:
        config: The configuration of the run.
        epoch: Index of the epoch, pre-training included.
    """
    if epoch < config.pretraining_epochs:
        return f"pre-training {epoch + 1}/{config.pretraining_epochs}"
    most = "at most " if config.patience is not None else ""
    return f"epoch {epoch + 1 - config.pretraining_epochs}/{most}{config.epochs}"


@final
class StageProgressBar(TQDMProgressBar):
    """Lightning's progress bar with the name of the epoch by `stage_of`."""

    def __init__(self, config: TrainingConfig) -> None:
        """Stores the configuration of the run."""
        super().__init__()
        self._config = config

    def on_train_epoch_start(self, trainer: pl.Trainer, *args: Any) -> None:
        """Names the epoch."""
        super().on_train_epoch_start(trainer, *args)
        self.train_progress_bar.set_description(stage_of(self._config, trainer.current_epoch))


@contextmanager
def threads(count: int | None) -> Iterator[None]:
    """Sets torch's threads within one operation; None leaves them."""
    before = torch.get_num_threads()
    torch.set_num_threads(before if count is None else count)
    try:
        yield
    finally:
        torch.set_num_threads(before)


@contextmanager
def quiet() -> Iterator[None]:
    """Hides Lightning's advice on loaders, loggers and folders; faults still raise."""
    for name in ("lightning.pytorch", "lightning.fabric"):
        logging.getLogger(name).setLevel(logging.WARNING)
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", module="lightning|torch")
        yield


def gathered(value: T) -> list[T]:
    """The values of all processes in the order of their ranks."""
    if not (distributed.is_available() and distributed.is_initialized()):
        return [value]
    values: list[T] = [value] * distributed.get_world_size()
    distributed.all_gather_object(values, value)
    return values


def share_buffers(module: nn.Module) -> None:
    """Copies the running statistics of the first process to all others."""
    if distributed.is_available() and distributed.is_initialized():
        for buffer in module.buffers():
            distributed.broadcast(buffer, 0)


def is_first_process() -> bool:
    """Whether this process has rank 0, which writes the files; true outside of training."""
    initialized = distributed.is_available() and distributed.is_initialized()
    return not initialized or distributed.get_rank() == 0


@final
class SafetensorsIO(CheckpointIO):
    """Stores Lightning's checkpoints as safetensors with JSON in the header; no pickles."""

    def save_checkpoint(
        self, checkpoint: dict[str, Any], path: _PATH, storage_options: Any | None = None
    ) -> None:
        """Writes a checkpoint.

        Raises:
            TypeError: It holds an object that is neither a tensor nor JSON.
        """
        del storage_options
        tensors: dict[str, torch.Tensor] = {}
        tree = _encode(checkpoint, tensors)
        write_file(save(tensors, metadata={"tree": json.dumps(tree)}), Path(path))

    def load_checkpoint(
        self, path: _PATH, map_location: Any | None = None, weights_only: bool | None = None
    ) -> dict[str, Any]:
        """Reads a checkpoint.

        Raises:
            CheckpointError: The file is damaged.
        """
        del map_location, weights_only
        try:
            with safe_open(str(path), framework="pt") as file:
                names = file.keys()
                tensors = {name: file.get_tensor(name) for name in names}
                return _decode(parse_json(file.metadata()["tree"]), tensors)
        except (OSError, KeyError, TypeError, ValueError, SafetensorError) as error:
            raise CheckpointError(
                f"{path} cannot be read: delete its folder to start the run again"
            ) from error

    def remove_checkpoint(self, path: _PATH) -> None:
        """Deletes the file if it exists."""
        Path(path).unlink(missing_ok=True)


def _encode(value: Any, tensors: dict[str, torch.Tensor]) -> Any:
    if isinstance(value, torch.Tensor):
        name = str(len(tensors))
        tensors[name] = value.detach().clone().contiguous()
        return {"tensor": name}
    if isinstance(value, dict):
        return {"dict": [[_encode(k, tensors), _encode(v, tensors)] for k, v in value.items()]}
    if isinstance(value, tuple):
        return {"tuple": [_encode(item, tensors) for item in value]}
    if isinstance(value, list):
        return [_encode(item, tensors) for item in value]
    if value is None or isinstance(value, str | bool | int | float):
        return value
    raise TypeError(f"the state of a run holds a {type(value).__name__}, which is not stored")


def _decode(tree: Any, tensors: dict[str, torch.Tensor]) -> Any:
    if isinstance(tree, list):
        return [_decode(item, tensors) for item in tree]
    if not isinstance(tree, dict):
        return tree
    ((kind, content),) = tree.items()
    if kind == "tensor":
        return tensors[content]
    if kind == "tuple":
        return tuple(_decode(item, tensors) for item in content)
    return {_decode(key, tensors): _decode(value, tensors) for key, value in content}


def _launches(trainer: pl.Trainer) -> bool:
    """Whether this program starts the other processes itself."""
    strategy = trainer.strategy
    return isinstance(strategy, ParallelStrategy) and isinstance(
        strategy.cluster_environment, LightningEnvironment
    )


def _check_compiler() -> None:
    if torch.cuda.is_available():
        if importlib.util.find_spec("triton") is None:
            raise AspEnvError("training: --compile needs triton for GPUs: install it, or leave it")
        return
    compiler = os.environ.get("CXX", "clang++" if sys.platform == "darwin" else "g++")
    if shutil.which(compiler) is None:
        raise AspEnvError(
            f"training: --compile needs a C++ compiler and there is no {compiler}: install it, "
            "name another one in CXX, or leave --compile out"
        )
