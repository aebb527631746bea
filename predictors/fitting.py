"""Training with Lightning: data, network, optimisation, checkpoint. Resumes where it was killed."""

import ctypes
import dataclasses
import json
import logging
import platform
import shutil
import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.metadata import version
from pathlib import Path
from typing import Any

import lightning.pytorch as pl
import torch
from lightning.pytorch.loggers import CSVLogger, TensorBoardLogger
from safetensors.torch import load_file

from asp_env import registry
from asp_env.data.parts import TrainedOn, snippet_parts
from asp_env.data.snippets import SnippetIndex, index_snippets
from asp_env.data.source import Recordings, open_data
from asp_env.errors import AspEnvError
from asp_env.views import make_view
from predictors.checkpoint import CONFIG, save_learned, write_json
from predictors.learned import LearnedPlug, NetworkShape
from predictors.lightning_parts import Fit, KeepBest, TellEpochs
from predictors.recipes import TrainingConfig
from predictors.resume import SafetensorsIO
from predictors.samples import Batches, action_range, choose_snippets

RUN = "run.json"
STATE = "unfinished"
LOGS = "logs"


def train(config: TrainingConfig, data: str, out: Path) -> Path:
    """Trains a predictor, or goes on with a run that was killed.

    Args:
        config: everything that decides the weights.
        data: DATA, as `open_data` takes it.
        out: the run's folder. It holds `logs` and, until the run is finished, `unfinished`; then
            `config.json` and `weights.safetensors`, of the epoch with the lowest
            `validation FDE moving`.

    Returns:
        `out`.

    Raises:
        AspEnvError: the folder holds a finished run, or one of another configuration, or something
            else; the data are bad; or the loss is not finite.
    """
    recordings = open_data(data)
    run = {"config": dataclasses.asdict(config), "data_hash": recordings.data_hash()}
    resumed = _resumes(out, run)

    snippets = index_snippets(recordings, dt_s=config.dt_s, horizon_s=config.horizon_s)
    training, validation, trained_on = _choose(recordings, snippets, config)
    view = make_view(config.view, height_px=config.height_px, width_px=config.width_px)
    shape = NetworkShape(
        raster=view.shape,
        history=snippets.history,
        horizon=snippets.horizon,
        dt_s=config.dt_s,
        action_range=action_range(recordings, training),
    )

    plug: LearnedPlug = registry.find("predictors", config.predictor)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(config.seed)
        network = plug.network(config.network, shape)
    batches = [
        Batches(recordings, chosen, view=view, batch_size=size)
        for chosen, size in ((training, config.batch_size), (validation, 256))
    ]
    if not resumed:
        (out / STATE).mkdir(parents=True)
        write_json(run, out / STATE / RUN)
    best = _fit(
        Fit(network, config=config, training=batches[0], validation=batches[1]), config, out
    )

    save_learned(
        out,
        plug=plug,
        network_config=config.network,
        shape=shape,
        view=view,
        weights=load_file(out / STATE / "best.safetensors"),
        provenance={
            **run,
            "trained_on": dataclasses.asdict(trained_on),
            "snippets": {"training": len(training), "validation": len(validation)},
            "best_epoch": best.best_epoch,
            "best_value": best.best_value,
            "versions": _versions(),
        },
    )
    shutil.rmtree(out / STATE)
    return out


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
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
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
            max_epochs=config.epochs,
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


def _choose(
    recordings: Recordings, snippets: SnippetIndex, config: TrainingConfig
) -> tuple[SnippetIndex, SnippetIndex, TrainedOn]:
    """Training and validation snippets, and which recordings they are from."""
    parts, trained_on = snippet_parts(recordings, snippets, config.split)
    found = {part: snippets.select(parts == part) for part in ("train", "validation")}
    for part, chosen in found.items():
        if not len(chosen):
            raise AspEnvError(
                f"data {recordings.source!r}: no snippet is left for {part} after the split by "
                f"{config.split}; give more recordings or longer ones"
            )
    training = choose_snippets(
        recordings,
        found["train"],
        standing_share=config.standing_share,
        max_snippets=config.max_snippets,
        seed=config.seed,
    )
    validation = choose_snippets(
        recordings,
        found["validation"],
        standing_share=1.0,
        max_snippets=config.max_validation_snippets,
        seed=config.seed,
    )
    return training, validation, trained_on
