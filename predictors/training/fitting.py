"""A training run from data to checkpoint, with Lightning; it resumes where it was interrupted."""

import ctypes
import dataclasses
import json
import platform
import shutil
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from importlib.metadata import version
from pathlib import Path
from typing import Any

import lightning.pytorch as pl
import torch
from safetensors.torch import load_file

from asp_env import registry
from asp_env.data.recording import ticks
from asp_env.data.source import join_data
from asp_env.errors import AspEnvError
from asp_env.files import is_temporary
from asp_env.stored import parse_json
from asp_env.views import make_view, with_history
from predictors.inference.calibration import calibrate
from predictors.inference.checkpoint import (
    CONFIG,
    PredictorSpec,
    load_trained,
    read_config,
    save_trained,
    shape_for,
    write_json,
)
from predictors.inference.fit_features import feature_distance_of
from predictors.training.budgets import COSTS
from predictors.training.data import (
    VALIDATION_BATCH,
    DatasetSplit,
    TrainingData,
    action_range,
    open_all,
    open_training_data,
)
from predictors.training.data_loading import batch_workers
from predictors.training.initial_weights import InitialWeights, file_hash
from predictors.training.lightning_parts import BestCheckpoint, EpochLogger, TrainingModule
from predictors.training.recipes import TrainingConfig
from predictors.training.trainer import LOGS, Hardware, SafetensorsIO, make_trainer, quiet, threads

RUN = "run.json"
"""File of an unfinished run's configuration and data hash."""

STATE = "unfinished"
"""Folder of an unfinished run's state."""

FINISHED = "finished"
"""Folder within that of the state, for the files of the result until all of them are written."""

ONE_PROCESS = Hardware()


def train(
    config: TrainingConfig,
    data: str | Sequence[str],
    out: Path,
    *,
    start: Path | None = None,
    hardware: Hardware = ONE_PROCESS,
) -> Path:
    """Trains a predictor, or continues an unfinished run.

    With several devices the running program is started again for each of them, with the arguments
    of its command line, and must call this function again; all nodes must see the same `out` and
    data. Only the first process writes. A run may be continued on other hardware.

    Args:
        config: Everything that decides the weights, besides the data and the start.
        data: One or several DATA, as `open_data` takes them.
        out: The run's folder. It holds `logs` and, until the run is finished, `unfinished`; then
            `config.json`, `weights.safetensors`, `README.md` and `features.safetensors` (statistics
            of the features), of the epoch with the lowest `validation FDE moving`.
        start: The folder of a finished run, or a file of ResNet18 weights, to start from.
        hardware: Devices and nodes.

    Returns:
        `out`.

    Raises:
        AspEnvError: The folder holds a finished run, a run of another configuration, or other
            files; the data or the start are bad; the hardware is not available; or the loss is not
            finite.
    """
    return train_on(config, open_training_data(config, data), out, start=start, hardware=hardware)


def train_on(
    config: TrainingConfig,
    chosen: TrainingData,
    out: Path,
    *,
    start: Path | None = None,
    hardware: Hardware = ONE_PROCESS,
) -> Path:
    """Trains a predictor as `train` does, on data that are open and split.

    Args:
        config: As for `train`.
        chosen: Training and validation snippets.
        out: As for `train`.
        start: As for `train`.
        hardware: As for `train`.

    Returns:
        `out`.

    Raises:
        AspEnvError: As `train`.
    """
    run = {"config": dataclasses.asdict(config), "data_hash": chosen.data_hash}
    if chosen.validation_hash is not None:
        run["validation_hash"] = chosen.validation_hash
    if chosen.resampled:
        run["resampled"] = chosen.resampled
    spec: PredictorSpec = registry.find("predictors", config.predictor)
    history = ticks(config.history_s, config.dt_s)
    view = with_history(make_view(config.view, pixels=config.pixels), history)
    initial = None
    if start is not None:
        initial = InitialWeights.read(start, spec, view=view, dt_s=config.dt_s)
        run["start"] = initial.weights_hash
    first_stage = first_stage_folder(config, out)
    resumed = _resumes(out, run, first_stage=first_stage if start == first_stage else None)

    training = chosen.training
    if initial is None or initial.action_range is None:
        scale = action_range(training.recordings, training.snippets)
    else:
        scale = initial.action_range
    shape = shape_for(
        view,
        history=history,
        horizon=training.snippets.horizon_ticks,
        dt_s=config.dt_s,
        action_range=scale,
    )
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(config.seed)
        network = spec.network(config.network, shape)
    not_loaded = [] if initial is None else initial.apply(network)
    trained_on = chosen.trained_on
    if initial is not None and initial.trained_on is not None:
        trained_on = trained_on.continued_from(initial.trained_on)
    batches = [
        split.batches(view, size=size, later_ticks=network.later_ticks, config=config)
        for split, size in (
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
    with batch_workers([each.source for each in batches], hardware.num_workers) as workers:
        if workers is not None:
            batches = [each.with_workers(workers, index) for index, each in enumerate(batches)]
        module = TrainingModule(network, config=config, training=batches[0], validation=batches[1])
        _fit(trainer, module, best.state_path, hardware)
        if not trainer.is_global_zero:
            trainer.strategy.barrier()
            return out

        network.load_state_dict(load_file(best.best_path))
        with torch.compiler.set_stance("force_eager") if hardware.compiled else nullcontext():
            temperature = calibrate(network, batches[1])
    finished = state / FINISHED
    finished.mkdir(exist_ok=True)
    save_trained(
        finished,
        spec=spec,
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
            "not_started": not_loaded,
            "trained_epochs": best.last_epoch + 1 - config.pretraining_epochs,
            "best_epoch": best.best_epoch,
            "best_value": best.best_value,
            "processes": trainer.world_size,
            "compiled": hardware.compiled,
            "versions": versions(),
        },
    )
    add_features(spec, finished, chosen.validation, config)
    _move_finished(finished, out)
    remove_state(out)
    trainer.strategy.barrier()
    return out


def _move_finished(finished: Path, out: Path) -> None:
    """Moves the files of a result into the run's folder; the configuration, which ends it, last."""
    for path in sorted(finished.iterdir(), key=lambda each: each.name == CONFIG):
        path.replace(out / path.name)


def remove_state(out: Path) -> None:
    """Removes the state of a finished run; one that was killed after its last file still has it."""
    shutil.rmtree(out / STATE, ignore_errors=True)


def add_features(
    spec: PredictorSpec, run: Path, validation: DatasetSplit, config: TrainingConfig
) -> None:
    """Adds the statistics of features on validation data to a finished run.

    With too few validation snippets there are none.
    """
    found = feature_distance_of(
        load_trained(spec, str(run)), validation.histories(config), validation.snippets
    )
    if found is not None:
        found.save(run)


def train_stages(
    config_for: Callable[[float], TrainingConfig],
    horizon_s: float,
    data: str | Sequence[str],
    out: Path,
    *,
    start: Path | None = None,
    hardware: Hardware = ONE_PROCESS,
) -> Path:
    """Trains in stages: a long run starts from a run for one segment, or for 3 s, within `out`.

    The first stage, such as `out/3s`, is trained if it is missing and the horizon is longer.

    Args:
        config_for: Maps a horizon in seconds to the configuration.
        horizon_s: The horizon of the predictor.
        data: One or several DATA, as `open_data` takes them.
        out: The run's folder.
        start: The folder of a finished run to start from instead of a first stage, or a file of
            ResNet18 weights, which the first stage starts from.
        hardware: Devices and nodes.

    Returns:
        `out`.

    Raises:
        AspEnvError: As `train`, or the first stage is of another configuration or other data.
    """
    config = config_for(horizon_s)
    if horizon_s > config.first_stage_s and (start is None or start.is_file()):
        stage, first = first_stage_folder(config, out), config_for(config.first_stage_s)
        if (stage / CONFIG).exists():
            _check_first_stage(stage, first, data, start)
        else:
            open_training_data(config, data)  # too short for the horizon: before the first stage
            train(first, data, stage, start=start, hardware=hardware)
        start = stage
    return train(config, data, out, start=start, hardware=hardware)


def first_stage_folder(config: TrainingConfig, out: Path) -> Path:
    """Folder of the run that a run in two stages starts from."""
    return out / f"{config.first_stage_s:g}s"


def _check_first_stage(
    stage: Path, config: TrainingConfig, data: str | Sequence[str], start: Path | None
) -> None:
    """Refuses a first stage of other data, possibly the test recordings, recipe or start."""
    provenance = read_config(stage).get("provenance", {})
    expected = {
        "config": json.loads(json.dumps(dataclasses.asdict(config))),
        "data_hash": join_data(open_all(data, dt_s=config.dt_s)).data_hash(),
        "start": None if start is None else file_hash(start),
    }
    if other := [name for name, value in expected.items() if provenance.get(name) != value]:
        raise AspEnvError(
            f"{stage} holds a finished run of another {' and '.join(other)}: delete it to train it "
            "again, or name it by --start"
        )


def check_folder(out: Path, *, first_stage: Path | None) -> None:
    """Refuses a folder that no run can begin or continue in.

    Args:
        out: The folder, which may be missing.
        first_stage: The folder of a first stage that it may hold.

    Raises:
        AspEnvError: It holds a finished run, or something that is no run.
    """
    if (out / CONFIG).exists():
        remove_state(out)
        raise AspEnvError(f"{out} holds a finished run: give another --out, or delete it")
    if (out / STATE / RUN).exists():
        return
    # An interruption right after the folder was made leaves it without `run.json`.
    allowed = {out / COSTS, out / STATE, first_stage}
    if out.exists() and (
        not out.is_dir()
        or any(each not in allowed and not is_temporary(each) for each in out.iterdir())
    ):
        raise AspEnvError(f"{out} holds something that is no run: give another --out")


def _resumes(out: Path, run: dict[str, Any], *, first_stage: Path | None) -> bool:
    """Whether the folder holds this run unfinished; False if it is new or empty."""
    check_folder(out, first_stage=first_stage)
    if (out / STATE / RUN).exists():
        try:
            stored = parse_json((out / STATE / RUN).read_bytes())
        except ValueError:
            stored = None
        if stored != json.loads(json.dumps(run)):
            raise AspEnvError(
                f"{out} holds an unfinished run of another configuration or other data: "
                "give another --out, or delete it"
            )
        return True
    return False


def _fit(trainer: pl.Trainer, module: TrainingModule, state: Path, hardware: Hardware) -> None:
    _retain_freed_memory()
    if hardware.compiled:
        module.network.get_submodule("encoder").compile()
    with quiet(), threads(module.config.threads):
        trainer.fit(module, ckpt_path=str(state) if state.exists() else None)


def _epochs_done(state: Path) -> int:
    if not state.exists():
        return 0
    return int(SafetensorsIO().load_checkpoint(state)["epoch"]) + 1


def _retain_freed_memory() -> None:
    """Makes glibc retain freed memory: large arrays otherwise fault every page in every step."""
    if platform.libc_ver()[0] == "glibc":
        libc = ctypes.CDLL(None)
        trim_threshold, mmap_threshold = -1, -3
        libc.mallopt(mmap_threshold, 1 << 30)
        libc.mallopt(trim_threshold, 2**31 - 1)


def versions() -> dict[str, str]:
    """Versions of the packages that decide the weights, for the provenance of a run."""
    return {name: version(name) for name in ("asp-env", "lightning", "numpy", "torch")}
