"""What a run is worked out on: devices, nodes and whether the encoder is compiled.

Processes share every batch evenly, so that `batch_size` is that of all of them together and the
weights are those of one process up to rounding. Batch statistics are those of the whole batch on
GPUs; between CPUs they are not exchanged, and each process normalises by its own share of a batch.
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
from lightning.pytorch.loggers import CSVLogger, TensorBoardLogger
from lightning.pytorch.plugins.io import CheckpointIO
from lightning.pytorch.strategies import DDPStrategy, ParallelStrategy
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import distributed, nn

from asp_env.errors import AspEnvError, CheckpointError
from asp_env.files import atomic_file, remove_stale
from predictors.training.recipes import TrainingConfig


@final
class SafetensorsIO(CheckpointIO):
    """Lightning's checkpoints as safetensors, with everything that is no tensor in the header."""

    def save_checkpoint(
        self, checkpoint: dict[str, Any], path: _PATH, storage_options: Any | None = None
    ) -> None:
        """Writes a checkpoint atomically."""
        del storage_options
        tensors: dict[str, torch.Tensor] = {}
        tree = _encode(checkpoint, tensors)
        with atomic_file(Path(path)) as partial:
            partial.write_bytes(save(tensors, metadata={"tree": json.dumps(tree)}))
        remove_stale(Path(path))

    def load_checkpoint(
        self, path: _PATH, map_location: Any | None = None, weights_only: bool | None = None
    ) -> dict[str, Any]:
        """What was saved.

        Raises:
            CheckpointError: the file is damaged.
        """
        del map_location, weights_only
        try:
            with safe_open(str(path), framework="pt") as file:
                names = file.keys()
                tensors = {name: file.get_tensor(name) for name in names}
                return _decode(json.loads(file.metadata()["tree"]), tensors)
        except (OSError, KeyError, TypeError, ValueError, SafetensorError) as error:
            raise CheckpointError(
                f"{path} cannot be read: delete its folder to start the run again"
            ) from error

    def remove_checkpoint(self, path: _PATH) -> None:
        """Deletes the file if it is there."""
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


T = TypeVar("T")

LOGS = "logs"

RENDEZVOUS = ("MASTER_ADDR", "MASTER_PORT", "NODE_RANK")
"""Variables that tell the nodes of one another, where no launcher does."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Hardware:
    """It changes no weights but by rounding (and batch statistics, see above)."""

    devices: int | Literal["auto"] = 1
    """Processes on each node, with a GPU each if there are GPUs; `auto` is one per GPU."""
    nodes: int = 1
    """How many machines take part; the command is started on each of them."""
    strategy: Literal["auto", "ddp"] = "auto"
    """`ddp` also where there is but one process."""
    compiled: bool = False
    """Whether the encoder is compiled by `torch.compile`."""
    num_workers: int = 0
    """Processes that draw batches ahead for each device; with none, a thread does."""

    def __post_init__(self) -> None:
        """Checks the numbers.

        Raises:
            AspEnvError: one is too low, or there is nothing to compile with.
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
) -> pl.Trainer:
    """What runs the epochs of a configuration; logs go to `out/logs/started`.

    Raises:
        AspEnvError: there are not so many devices, the nodes do not know of one another, or a batch
            is too small to be shared.
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
        # In pre-training no gradient reaches what predicts actions.
        strategy = DDPStrategy(find_unused_parameters=config.pretraining_epochs > 0)
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
                callbacks=list(callbacks),
                logger=[
                    CSVLogger(out, name=LOGS, version=started),
                    TensorBoardLogger(out, name=LOGS, version=started),
                ],
                plugins=[SafetensorsIO()],
                enable_checkpointing=False,
                enable_model_summary=False,
                enable_progress_bar=sys.stderr.isatty(),
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


@contextmanager
def quiet() -> Iterator[None]:
    """Lightning advises on loaders, loggers and folders; what matters here raises."""
    for name in ("lightning.pytorch", "lightning.fabric"):
        logging.getLogger(name).setLevel(logging.WARNING)
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", module="lightning|torch")
        yield


def gathered(value: T) -> list[T]:
    """What every process gives, in their order."""
    if not (distributed.is_available() and distributed.is_initialized()):
        return [value]
    found: list[T] = [value] * distributed.get_world_size()
    distributed.all_gather_object(found, value)
    return found


def share_buffers(module: nn.Module) -> None:
    """Gives every process the first one's running statistics."""
    if distributed.is_available() and distributed.is_initialized():
        for buffer in module.buffers():
            distributed.broadcast(buffer, 0)


def is_first_process() -> bool:
    """Whether this process is the one that writes; true outside of training."""
    there = distributed.is_available() and distributed.is_initialized()
    return not there or distributed.get_rank() == 0


def _launches(trainer: pl.Trainer) -> bool:
    """Whether nothing but this program starts its processes."""
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
