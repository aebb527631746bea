"""The state of an unfinished run, written without pickles: tensors and JSON in one file.

MERGED: Training with Lightning: data, network, optimisation, checkpoint. Resumes where it was killed.
"""

import ctypes
import dataclasses
import json
import platform
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from importlib.metadata import version
from pathlib import Path
from typing import Any

import lightning.pytorch as pl
import torch
from safetensors.torch import load_file

from asp_env import registry
from asp_env.data.source import open_data
from asp_env.errors import AspEnvError
from asp_env.views import make_view
from predictors.inference.calibration import calibrate
from predictors.inference.checkpoint import CONFIG, read_config, save_learned, shape_for, write_json
from predictors.models.network import LearnedPlug
from predictors.training.data import VALIDATION_BATCH, action_range, open_training_data
from predictors.training.data_loading import batch_workers
from predictors.training.lightning_parts import BestCheckpoint, EpochLogger, Fit
from predictors.training.pretrained import PretrainedWeights
from predictors.training.recipes import SEGMENT_S, TrainingConfig
from predictors.training.trainer import LOGS, Hardware, SafetensorsIO, make_trainer, quiet

RUN = "run.json"
STATE = "unfinished"
BEFORE = "3s"


ONE_PROCESS = Hardware()


def train(
    config: TrainingConfig,
    data: str,
    out: Path,
    *,
    start: Path | None = None,
    hardware: Hardware = ONE_PROCESS,
) -> Path:
    """Trains a predictor, or goes on with a run that was killed.

    With several devices the running program is started again for each of them, with the arguments
    of its command line, and has to arrive here; nodes see the same `out` and data. The first
    process alone writes. A run may go on on other hardware than it began on.

    Args:
        config: everything that decides the weights, besides the data and the start.
        data: DATA, as `open_data` takes it.
        out: the run's folder. It holds `logs` and, until the run is finished, `unfinished`; then
            `config.json`, `weights.safetensors` and `README.md`, of the epoch with the lowest
            `validation FDE moving`.
        start: the folder of a finished run, or a file of ResNet18 weights, to start from.
        hardware: what to work on.

    Returns:
        `out`.

    Raises:
        AspEnvError: the folder holds a finished run, or one of another configuration, or something
            else; the data or the start are bad; the hardware is not there; or the loss is not
            finite.
    """
    chosen = open_training_data(config, data)
    run = {"config": dataclasses.asdict(config), "data_hash": chosen.data_hash}
    if chosen.validation_hash is not None:
        run["validation_hash"] = chosen.validation_hash
    plug: LearnedPlug = registry.find("predictors", config.predictor)
    view = make_view(config.view, pixels=config.pixels)
    begin = None
    if start is not None:
        begin = PretrainedWeights.read(start, plug, view=view, dt_s=config.dt_s)
    if begin is not None:
        run["start"] = begin.weights_hash
    resumed = _resumes(out, run, staged=start == out / BEFORE)

    training = chosen.training
    if begin is None or begin.action_range is None:
        scale = action_range(training.recordings, training.snippets)
    else:
        scale = begin.action_range
    shape = shape_for(
        view,
        history=training.snippets.history,
        horizon=training.snippets.horizon_ticks,
        dt_s=config.dt_s,
        action_range=scale,
    )
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(config.seed)
        network = plug.network(config.network, shape)
    new = [] if begin is None else begin.apply(network)
    trained_on = chosen.trained_on
    if begin is not None and begin.trained_on is not None:
        trained_on = trained_on.continued_from(begin.trained_on)
    later = network.later_ticks
    batches = [
        share.batches(view, size=size, later_ticks=later, config=config)
        for share, size in (
            (training, config.batch_size),
            (chosen.validation, VALIDATION_BATCH),
        )
    ]
    state = out / STATE
    best = BestCheckpoint(best=state / "best.safetensors", state=state / "state.safetensors")
    started = f"from-epoch-{_epochs_done(best.state_path):02d}"
    trainer = make_trainer(
        config, hardware, out=out, started=started, callbacks=[best, EpochLogger()]
    )
    if trainer.is_global_zero:
        state.mkdir(parents=True, exist_ok=True)
        if not resumed:
            write_json(run, state / RUN)
        shutil.rmtree(out / LOGS / started, ignore_errors=True)
    with batch_workers([each.drawing for each in batches], hardware.num_workers) as crew:
        if crew is not None:
            batches = [each.drawn_by(crew, number) for number, each in enumerate(batches)]
        module = Fit(network, config=config, training=batches[0], validation=batches[1])
        _fit(trainer, module, best.state_path, hardware)
        if not trainer.is_global_zero:
            trainer.strategy.barrier()
            return out

        network.load_state_dict(load_file(best.best_path))
        with torch.compiler.set_stance("force_eager") if hardware.compiled else nullcontext():
            temperature = calibrate(network, batches[1])
    save_learned(
        out,
        plug=plug,
        network_config=config.network,
        shape=shape,
        view=view,
        weights=network.state_dict(),
        temperature=temperature,
        provenance={
            **run,
            "trained_on": dataclasses.asdict(trained_on),
            "snippets": {
                "training": len(training.snippets),
                "validation": len(chosen.validation.snippets),
            },
            "not_started": new,
            "best_epoch": best.best_epoch,
            "best_value": best.best_value,
            "processes": trainer.world_size,
            "compiled": hardware.compiled,
            "versions": _versions(),
        },
    )
    shutil.rmtree(state)
    trainer.strategy.barrier()
    return out


def train_stages(
    config_for: Callable[[float], TrainingConfig],
    horizon_s: float,
    data: str,
    out: Path,
    *,
    start: Path | None = None,
    hardware: Hardware = ONE_PROCESS,
) -> Path:
    """Trains in stages: above 3 s it goes on from a run for 3 s in `out/3s`, made if need be.

    Args:
        config_for: the configuration of a horizon in seconds.
        horizon_s: that is asked for.
        data: DATA.
        out: the run's folder.
        start: where to start from instead.
        hardware: what to work on.

    Raises:
        AspEnvError: as `train`.
    """
    config = config_for(horizon_s)
    if start is None and horizon_s > SEGMENT_S:
        start, before = out / BEFORE, config_for(SEGMENT_S)
        if (start / CONFIG).exists():
            _check_before(start, before, data)
        else:
            train(before, data, start, hardware=hardware)
    return train(config, data, out, start=start, hardware=hardware)


def _check_before(start: Path, config: TrainingConfig, data: str) -> None:
    """A finished run for 3 s may be of other data: of the test recordings, in the worst case."""
    found = read_config(start).get("provenance", {})
    expected = {
        "config": json.loads(json.dumps(dataclasses.asdict(config))),
        "data_hash": open_data(data).data_hash(),
    }
    if other := [name for name, value in expected.items() if found.get(name) != value]:
        raise AspEnvError(
            f"{start} holds a finished run of another {' and '.join(other)}: delete it to train it "
            "again, or name it by --start to go on from it"
        )


def _resumes(out: Path, run: dict[str, Any], *, staged: bool) -> bool:
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
    # A kill right after the folder was made left it without a word of what it is.
    known = (BEFORE, STATE) if staged else (STATE,)
    if out.exists() and (not out.is_dir() or any(each.name not in known for each in out.iterdir())):
        raise AspEnvError(f"{out} holds something that is no run: give another --out")
    return False


def _fit(trainer: pl.Trainer, module: Fit, state: Path, hardware: Hardware) -> None:
    _keep_freed_memory()
    if hardware.compiled:
        module.network.get_submodule("encoder").compile()
    with quiet(), _threads(module.config.threads):
        trainer.fit(module, ckpt_path=str(state) if state.exists() else None)


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
