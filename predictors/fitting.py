"""Training with Lightning: data, network, optimisation, checkpoint. Resumes where it was killed."""

import ctypes
import dataclasses
import json
import logging
import platform
import shutil
import sys
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib.metadata import version
from pathlib import Path
from typing import Any

import lightning.pytorch as pl
import torch
from lightning.pytorch.loggers import CSVLogger, TensorBoardLogger
from safetensors.torch import load_file

from asp_env import registry
from asp_env.errors import AspEnvError
from asp_env.views import make_view
from predictors.calibration import temperature_on
from predictors.checkpoint import CONFIG, save_learned, shape_for, write_json
from predictors.lightning_parts import Fit, KeepBest, TellEpochs
from predictors.network import LearnedPlug
from predictors.recipes import SEGMENT_S, TrainingConfig
from predictors.resume import SafetensorsIO
from predictors.samples import action_range
from predictors.start import Start
from predictors.training_data import VALIDATION_BATCH, open_training_data

RUN = "run.json"
STATE = "unfinished"
LOGS = "logs"
BEFORE = "3s"


def train(config: TrainingConfig, data: str, out: Path, *, start: Path | None = None) -> Path:
    """Trains a predictor, or goes on with a run that was killed.

    Args:
        config: everything that decides the weights, besides the data and the start.
        data: DATA, as `open_data` takes it.
        out: the run's folder. It holds `logs` and, until the run is finished, `unfinished`; then
            `config.json`, `weights.safetensors` and `README.md`, of the epoch with the lowest
            `validation FDE moving`.
        start: the folder of a finished run, or a file of ResNet18 weights, to start from.

    Returns:
        `out`.

    Raises:
        AspEnvError: the folder holds a finished run, or one of another configuration, or something
            else; the data or the start are bad; or the loss is not finite.
    """
    chosen = open_training_data(config, data)
    run = {"config": dataclasses.asdict(config), "data_hash": chosen.data_hash}
    if chosen.validation_hash is not None:
        run["validation_hash"] = chosen.validation_hash
    plug: LearnedPlug = registry.find("predictors", config.predictor)
    view = make_view(config.view, pixels=config.pixels)
    begin = Start.read(start, plug) if start is not None else None
    if begin is not None:
        run["start"] = begin.weights_hash
    resumed = _resumes(out, run)

    training = chosen.training
    if begin is None or begin.action_range is None:
        scale = action_range(training.recordings, training.snippets)
    else:
        scale = begin.action_range
    shape = shape_for(
        view,
        history=training.snippets.history,
        horizon=training.snippets.horizon,
        dt_s=config.dt_s,
        action_range=scale,
    )
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(config.seed)
        network = plug.network(config.network, shape)
    new = [] if begin is None else begin.apply(network)
    later = network.later_ticks
    batches = [
        share.batches(view, size=size, later_ticks=later, config=config)
        for share, size in (
            (training, config.batch_size),
            (chosen.validation, VALIDATION_BATCH),
        )
    ]
    if not resumed:
        (out / STATE).mkdir(parents=True)
        write_json(run, out / STATE / RUN)
    best = _fit(
        Fit(network, config=config, training=batches[0], validation=batches[1]), config, out
    )

    weights = load_file(out / STATE / "best.safetensors")
    network.load_state_dict(weights)
    save_learned(
        out,
        plug=plug,
        network_config=config.network,
        shape=shape,
        view=view,
        weights=weights,
        temperature=temperature_on(network, batches[1]),
        provenance={
            **run,
            "trained_on": dataclasses.asdict(chosen.trained_on),
            "snippets": {
                "training": len(training.snippets),
                "validation": len(chosen.validation.snippets),
            },
            "not_started": new,
            "best_epoch": best.best_epoch,
            "best_value": best.best_value,
            "versions": _versions(),
        },
    )
    shutil.rmtree(out / STATE)
    return out


def train_stages(
    config_for: Callable[[float], TrainingConfig],
    horizon_s: float,
    data: str,
    out: Path,
    *,
    start: Path | None = None,
) -> Path:
    """Trains for a horizon; one above 3 s goes on from a run for 3 s in `out/3s`, made if need be.

    Args:
        config_for: the configuration of a horizon in seconds.
        horizon_s: that is asked for.
        data: DATA.
        out: the run's folder.
        start: where to start from instead.

    Raises:
        AspEnvError: as `train`.
    """
    config = config_for(horizon_s)
    if start is None and horizon_s > SEGMENT_S:
        start = out / BEFORE
        if not (start / CONFIG).exists():
            train(config_for(SEGMENT_S), data, start)
    return train(config, data, out, start=start)


def _resumes(out: Path, run: dict[str, Any]) -> bool:
    """Whether the folder holds this run unfinished; False where there is nothing yet."""
    if (out / CONFIG).exists():
        raise AspEnvError(f"{out} holds a finished run: give another --out, or delete it")
    if (out / STATE / RUN).exists():
        try:
            found = json.loads((out / STATE / RUN).read_text())
        except ValueError:
            found = None
        if found != json.loads(json.dumps(run)):
            raise AspEnvError(
                f"{out} holds an unfinished run of another configuration or other data: "
                "give another --out, or delete it"
            )
        return True
    if out.exists() and (not out.is_dir() or any(each.name != BEFORE for each in out.iterdir())):
        raise AspEnvError(f"{out} holds something that is no run: give another --out")
    return False


def _fit(module: Fit, config: TrainingConfig, out: Path) -> KeepBest:
    state = out / STATE / "state.safetensors"
    best = KeepBest(best=out / STATE / "best.safetensors", state=state)
    started = f"from-epoch-{_epochs_done(state):02d}"
    shutil.rmtree(out / LOGS / started, ignore_errors=True)
    _keep_freed_memory()
    for name in ("lightning.pytorch", "lightning.fabric"):
        logging.getLogger(name).setLevel(logging.WARNING)
    with warnings.catch_warnings():
        # Lightning advises on loaders, loggers and folders; what matters here raises.
        warnings.filterwarnings("ignore", module="lightning|torch")
        trainer = pl.Trainer(
            accelerator="auto",
            devices=1,
            precision=config.precision,
            max_epochs=config.all_epochs,
            callbacks=[best, TellEpochs()],
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
        with _threads(config.threads):
            trainer.fit(module, ckpt_path=str(state) if state.exists() else None)
    return best


@contextmanager
def _threads(count: int | None) -> Iterator[None]:
    before = torch.get_num_threads()
    torch.set_num_threads(before if count is None else count)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def _epochs_done(state: Path) -> int:
    if not state.exists():
        return 0
    return int(SafetensorsIO().load_checkpoint(state)["epoch"]) + 1


def _keep_freed_memory() -> None:
    """Lets glibc keep what is freed: large arrays otherwise fault every page in every step."""
    if platform.libc_ver()[0] == "glibc":
        libc = ctypes.CDLL(None)
        trim_threshold, mmap_threshold = -1, -3
        libc.mallopt(mmap_threshold, 1 << 30)
        libc.mallopt(trim_threshold, 2**31 - 1)


def _versions() -> dict[str, str]:
    return {name: version(name) for name in ("asp-env", "lightning", "numpy", "torch")}
