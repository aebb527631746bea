"""Interrupted runs end as uninterrupted ones; runs for 6 s start from runs for 3 s."""

import dataclasses
import json
from pathlib import Path
from typing import Any

import lightning.pytorch as pl
import pytest
import torch
from lightning.pytorch.core.optimizer import LightningOptimizer
from safetensors.torch import load_file, save_file

from asp_env.errors import AspEnvError
from predictors.training import lightning_parts
from predictors.training.fitting import train, train_stages
from predictors.training.initial_weights import file_hash
from predictors.training.lightning_parts import (
    SELECTED_BY,
    BestCheckpoint,
    EpochLogger,
    TrainingModule,
)
from predictors.training.recipes import TrainingConfig
from tests.predictors.tiny import (
    make_network,
    tiny_config,
    tiny_network,
    tiny_shape,
    write_data,
)


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> str:
    """Three recordings: one for training, one for validation, one for testing."""
    return write_data(tmp_path_factory.mktemp("data"))


class Killed(BaseException):
    """Stands for a kill; nothing catches it."""


def kill_after_epoch_two(
    self: EpochLogger, trainer: pl.Trainer, pl_module: pl.LightningModule
) -> None:
    """Interrupts right after the state of the second epoch is written."""
    del self, pl_module
    if trainer.current_epoch == 1:
        raise Killed


def kill_in_epoch_three(self: TrainingModule, batch: object, batch_idx: int) -> None:
    """Interrupts after one step of the third epoch, which is lost."""
    del batch
    if self.current_epoch == 2 and batch_idx == 1:
        raise Killed


KILLS = {
    "between epochs": (EpochLogger, "on_train_epoch_end", kill_after_epoch_two),
    "within an epoch": (TrainingModule, "on_train_batch_start", kill_in_epoch_three),
}


RUNS: dict[str, dict[str, Any]] = {
    "one-cycle": {"schedule": "one-cycle"},
    "plateau": {"schedule": "plateau"},
    "until converged": {"schedule": "plateau", "patience": 2, "epochs": 50},
    "pre-training and a second encoder": {
        "predictor": "ssp-asp",
        "view": "vectors",
        "schedule": "one-cycle",
        "network": tiny_network(
            "ssp-asp", "vectors", ema=0.9, normalise=True, scheduled=True, annealed=True
        ),
    },
}
CASES = [("one-cycle", "between epochs"), *((run, "within an epoch") for run in RUNS)]


@pytest.mark.parametrize(("run", "kill"), CASES)
def test_interrupted_run_ends_with_the_same_weights(
    run: str, kill: str, data: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A run with an interruption after two epochs has the weights of one without, bit for bit.

    With `plateau` no epoch counts as an improvement: from the second on, each divides the rate by
    5.
    """
    monkeypatch.setattr(lightning_parts, "PLATEAU_PATIENCE", 0)
    monkeypatch.setattr(lightning_parts, "PLATEAU_THRESHOLD", 0.99)
    rates: list[float] = []
    last: list[dict[str, torch.Tensor]] = []
    monkeypatch.setattr(
        TrainingModule, "on_train_epoch_start", lambda self: rates.append(rate_of(self))
    )
    monkeypatch.setattr(TrainingModule, "on_train_end", lambda self: last.append(weights_of(self)))
    config = tiny_config(**{**RUNS[run], "learning_rate": 0.01})
    with monkeypatch.context() as patched:
        patched.setattr(*KILLS[kill])
        with pytest.raises(Killed):
            train(config, data, tmp_path / "killed")
    assert not (tmp_path / "killed" / "config.json").exists()
    del rates[2:]
    train(config, data, tmp_path / "killed")
    resumed_rates = rates.copy()
    rates.clear()
    train(config, data, tmp_path / "whole")
    if run == "plateau":
        assert rates == pytest.approx([0.01, 0.01, 0.002, 0.0004])
    assert resumed_rates == rates
    of_run = [load_file(tmp_path / each / "weights.safetensors") for each in ("killed", "whole")]
    for resumed, whole in (last, of_run):
        assert resumed.keys() == whole.keys()
        for name, tensor in whole.items():
            assert torch.equal(resumed[name], tensor), name
    configs = [
        json.loads((tmp_path / each / "config.json").read_text()) for each in ("killed", "whole")
    ]
    assert configs[0] == configs[1]


def weights_of(module: TrainingModule) -> dict[str, torch.Tensor]:
    """A copy of the current weights, which those of the best epoch replace later."""
    return {name: value.clone() for name, value in module.network.state_dict().items()}


def rate_of(module: TrainingModule) -> float:
    """The current learning rate."""
    optimizer = module.optimizers()
    assert isinstance(optimizer, LightningOptimizer)
    return float(optimizer.param_groups[0]["lr"])


def test_run_for_6_s_starts_from_3_s(data: str, tmp_path: Path) -> None:
    """A run for 6 s first trains a run for 3 s in its folder, and loads all its weights."""

    def config_for(horizon_s: float) -> TrainingConfig:
        config = tiny_config("ssp-asp", "vectors", epochs=1, pretraining_epochs=0)
        return dataclasses.replace(config, horizon_s=horizon_s, snippets_per_epoch=8)

    out = train_stages(config_for, 6.0, data, tmp_path / "run")
    first, second = (json.loads((f / "config.json").read_text()) for f in (out / "3s", out))
    assert (first["horizon"], second["horizon"]) == (15, 30)
    assert first["normaliser"] == second["normaliser"]
    assert second["provenance"]["start"]
    assert second["provenance"]["not_started"] == []
    assert first["provenance"]["trained_on"] == second["provenance"]["trained_on"]


def test_first_stage_of_another_run_is_refused(data: str, tmp_path: Path) -> None:
    """An existing run for 3 s must have the same configuration and data."""

    def config_for(horizon_s: float, **changes: Any) -> TrainingConfig:
        config = tiny_config("dkm", "vectors", epochs=1)
        return dataclasses.replace(config, horizon_s=horizon_s, snippets_per_epoch=8, **changes)

    out = tmp_path / "run"
    train(config_for(3.0), data, out / "3s")
    with pytest.raises(AspEnvError, match="3s holds a finished run of another config: delete it"):
        train_stages(lambda horizon_s: config_for(horizon_s, seed=1), 6.0, data, out)
    path = out / "3s" / "config.json"
    original = path.read_text()
    changed = json.loads(original)
    changed["provenance"]["data_hash"] = "another"
    path.write_text(json.dumps(changed))
    with pytest.raises(AspEnvError, match="3s holds a finished run of another data_hash"):
        train_stages(config_for, 6.0, data, out)
    path.write_text(original)
    assert train_stages(config_for, 6.0, data, out) == out


def test_training_data_of_the_start_are_included(data: str, tmp_path: Path) -> None:
    """A run that starts from a run on one more recording names that recording, too."""
    config = tiny_config("dkm", "vectors", epochs=1, snippets_per_epoch=8)
    start = train(config, data, tmp_path / "start")
    path = start / "config.json"
    content = json.loads(path.read_text())
    content["provenance"]["trained_on"]["parts"]["elsewhere"] = "train"
    path.write_text(json.dumps(content))
    run = train(config, data, tmp_path / "run", start=start)
    parts = json.loads((run / "config.json").read_text())["provenance"]["trained_on"]["parts"]
    assert parts == content["provenance"]["trained_on"]["parts"]


def test_converged_run_ends_after_its_patience(
    data: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two epochs after the best one, also if it is interrupted when its last epoch is stored."""
    config = tiny_config(
        "dkm", "vectors", schedule="plateau", patience=2, epochs=50, snippets_per_epoch=8
    )
    errors = iter([5.0, 4.0, 4.0, 3.0, 3.5, 3.0, 1.0])
    ended = BestCheckpoint.on_train_epoch_end

    def with_errors(
        self: BestCheckpoint, trainer: pl.Trainer, pl_module: pl.LightningModule
    ) -> None:
        trainer.callback_metrics[SELECTED_BY] = torch.tensor(next(errors))
        ended(self, trainer, pl_module)

    def killed_at_the_end(
        self: EpochLogger, trainer: pl.Trainer, pl_module: pl.LightningModule
    ) -> None:
        del self, pl_module
        if trainer.current_epoch == 5:
            raise Killed

    monkeypatch.setattr(BestCheckpoint, "on_train_epoch_end", with_errors)
    with monkeypatch.context() as patched:
        patched.setattr(EpochLogger, "on_train_epoch_end", killed_at_the_end)
        with pytest.raises(Killed):
            train(config, data, tmp_path / "run")
    train(config, data, tmp_path / "run")
    provenance = json.loads((tmp_path / "run" / "config.json").read_text())["provenance"]
    assert (provenance["best_epoch"], provenance["best_value"]) == (3, 3.0)
    assert provenance["trained_epochs"] == 6
    assert next(errors) == 1.0


def test_resnet_weights_start_the_first_stage(data: str, tmp_path: Path) -> None:
    """The run for 3 s starts from the file and has its pre-training; that for 6 s starts from 3 s.

    Another file is refused for a finished first stage.
    """
    network = tiny_network("ssp-asp", encoder="resnet18")
    source = make_network("ssp-asp", network, tiny_shape(), seed=1)
    paths = [tmp_path / f"{name}.safetensors" for name in ("one", "other")]
    for path, scale in zip(paths, (1.0, 2.0), strict=True):
        body = source.get_submodule("encoder.body").state_dict()
        save_file({name: scale * value for name, value in body.items()}, path)

    def config_for(horizon_s: float) -> TrainingConfig:
        config = tiny_config("ssp-asp", network=network, epochs=1, snippets_per_epoch=8)
        first = horizon_s == 3.0
        return dataclasses.replace(config, horizon_s=horizon_s, pretraining_epochs=int(first))

    out = train_stages(config_for, 6.0, data, tmp_path / "run", start=paths[0])
    first, second = (
        json.loads((f / "config.json").read_text())["provenance"] for f in (out / "3s", out)
    )
    assert first["start"] == file_hash(paths[0])
    assert first["config"]["pretraining_epochs"] == 1
    assert second["start"] == file_hash(out / "3s" / "weights.safetensors")
    (out / "config.json").unlink()
    with pytest.raises(AspEnvError, match="3s holds a finished run of another start"):
        train_stages(config_for, 6.0, data, out, start=paths[1])
