"""Training: what it writes, what it refuses, and that a killed run goes on as if nothing was."""

import json
from pathlib import Path

import lightning.pytorch as pl
import numpy as np
import pytest
import torch
from lightning.pytorch.core.optimizer import LightningOptimizer
from safetensors.torch import load_file

from asp_env.data.parts import Split, snippet_parts
from asp_env.data.predictor import load_predictor
from asp_env.data.snippets import SnippetIndex, gather_scene, index_snippets
from asp_env.data.source import Recordings, open_data
from asp_env.errors import AspEnvError
from predictors import fitting, lightning_parts
from predictors.fitting import train
from predictors.lightning_parts import Fit, TellEpochs, one_cycle
from predictors.recipes import TrainingConfig, recipe
from tests.predictors.tiny import tiny_config, write_data


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> str:
    """Three recordings: one to learn from, one to select on, one to test."""
    return write_data(tmp_path_factory.mktemp("data"))


@pytest.fixture(scope="module")
def finished(data: str, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of four epochs that nothing interrupted."""
    return train(tiny_config(), data, tmp_path_factory.mktemp("runs") / "finished")


class Killed(BaseException):
    """What a kill looks like from inside: nothing catches it."""


def kill_after_epoch_two(
    self: TellEpochs, trainer: pl.Trainer, pl_module: pl.LightningModule
) -> None:
    """Right after the state of the second epoch is on the disk."""
    del self, pl_module
    if trainer.current_epoch == 1:
        raise Killed


def kill_in_epoch_three(self: Fit, batch: object, batch_idx: int) -> None:
    """After one step of the third epoch, which is lost."""
    del batch
    if self.current_epoch == 2 and batch_idx == 1:
        raise Killed


KILLS = {
    "between epochs": (TellEpochs, "on_train_epoch_end", kill_after_epoch_two),
    "within an epoch": (Fit, "on_train_batch_start", kill_in_epoch_three),
}


@pytest.mark.parametrize("schedule", ["one-cycle", "plateau"])
@pytest.mark.parametrize("kill", KILLS, ids=list(KILLS))
def test_killed_run_ends_with_the_same_weights(
    kill: str, schedule: str, data: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two epochs, a kill, and two more give the weights of four in a row, bit for bit.

    On the plateau no epoch counts as better: the second and every later one divides the rate by 5.
    """
    monkeypatch.setattr(lightning_parts, "PLATEAU_PATIENCE", 0)
    monkeypatch.setattr(lightning_parts, "PLATEAU_THRESHOLD", 0.99)
    rates: list[float] = []
    last: list[dict[str, torch.Tensor]] = []
    monkeypatch.setattr(Fit, "on_train_epoch_start", lambda self: rates.append(rate_of(self)))
    monkeypatch.setattr(Fit, "on_train_end", lambda self: last.append(self.network.state_dict()))
    config = tiny_config(schedule=schedule, learning_rate=0.01)
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
    if schedule == "plateau":
        assert rates == pytest.approx([0.01, 0.01, 0.002, 0.0004])
    assert resumed_rates == rates
    of_run = [load_file(tmp_path / run / "weights.safetensors") for run in ("killed", "whole")]
    for resumed, whole in (last, of_run):
        assert resumed.keys() == whole.keys()
        for name, tensor in whole.items():
            assert torch.equal(resumed[name], tensor), name
    known = [
        json.loads((tmp_path / run / "config.json").read_text()) for run in ("killed", "whole")
    ]
    assert known[0] == known[1]


def rate_of(module: Fit) -> float:
    """The learning rate at this moment."""
    optimizer = module.optimizers()
    assert isinstance(optimizer, LightningOptimizer)
    return float(optimizer.param_groups[0]["lr"])


def test_other_seed_gives_other_weights(data: str, finished: Path, tmp_path: Path) -> None:
    """The seed decides the weights: another one gives others."""
    other = train(tiny_config(seed=1), data, tmp_path / "run")
    name = "head.0.weight"
    weights = [load_file(run / "weights.safetensors")[name] for run in (finished, other)]
    assert not torch.equal(*weights)


def test_run_folder_holds_no_pickles(finished: Path) -> None:
    """Configuration, weights and logs, and nothing else."""
    files = {str(path.relative_to(finished)) for path in finished.rglob("*") if path.is_file()}
    assert {"config.json", "weights.safetensors"} <= files
    assert "logs/from-epoch-00/metrics.csv" in files
    logs = {name for name in files if name.startswith("logs/")}
    assert len(files - logs) == 2
    assert all("events" in n or n.endswith(("metrics.csv", "hparams.yaml")) for n in logs)


def test_checkpoint_says_what_it_learned_from(data: str, finished: Path) -> None:
    """Part and content hash of every recording, seed, normaliser, and versions."""
    config = json.loads((finished / "config.json").read_text())
    known = config["provenance"]["trained_on"]
    assert set(known["parts"]) == set(open_data(data).hashes())
    assert sorted(known["parts"].values()) == ["test", "train", "validation"]
    assert config["provenance"]["data_hash"] == open_data(data).data_hash()
    assert config["provenance"]["config"]["seed"] == 0
    assert config["normaliser"]["action_range"][0] >= 0.5
    assert "torch" in config["provenance"]["versions"]
    predictor = load_predictor(f"ffw-asp:{finished}", horizon=15, dt_s=0.2)
    assert predictor.about["trained_on"] == data
    assert predictor.about["preset"] == "cpu"
    assert predictor.trained_on is not None
    assert predictor.trained_on.split == "recording"
    assert dict(predictor.trained_on.parts) == known["parts"]


def test_finished_run_is_refused(data: str, finished: Path) -> None:
    """Training into a finished run is one line that says so."""
    with pytest.raises(AspEnvError, match="holds a finished run"):
        train(tiny_config(), data, finished)


def test_other_configuration_is_refused(data: str, tmp_path: Path) -> None:
    """An unfinished run is gone on with only by its own configuration."""
    out = tmp_path / "run"
    (out / "unfinished").mkdir(parents=True)
    (out / "unfinished" / "run.json").write_text("{}")
    with pytest.raises(AspEnvError, match="unfinished run of another configuration"):
        train(tiny_config(), data, out)


def test_foreign_folder_is_refused(data: str, tmp_path: Path) -> None:
    """A folder with other things in it is left alone."""
    (tmp_path / "letter.txt").write_text("dear")
    with pytest.raises(AspEnvError, match="something that is no run"):
        train(tiny_config(), data, tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["letter.txt"]


def test_loss_that_is_not_finite_stops_the_run(
    data: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A NaN loss is one line, and no checkpoint is written."""
    network = "predictors.ffw_asp.regression_loss"
    monkeypatch.setattr(network, lambda *_: torch.tensor(float("nan"), requires_grad=True))
    with pytest.raises(AspEnvError, match="not finite in epoch 0"):
        train(tiny_config(), data, tmp_path / "run")
    assert not (tmp_path / "run" / "config.json").exists()


def test_too_few_recordings_leave_no_folder(tmp_path: Path) -> None:
    """Where nothing is left to test on the error names blocks, and nothing is half written."""
    data = write_data(tmp_path / "data", recordings=1)
    with pytest.raises(AspEnvError, match="--split blocks"):
        train(tiny_config(), data, tmp_path / "run")
    assert not (tmp_path / "run").exists()


def test_nothing_to_select_on_is_one_line(
    data: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A split that leaves no snippet for validation is refused before anything is written."""

    def all_to_train(recordings: Recordings, index: SnippetIndex, split: Split) -> object:
        _, trained_on = snippet_parts(recordings, index, split)
        return np.full(len(index), "train"), trained_on

    monkeypatch.setattr(fitting, "snippet_parts", all_to_train)
    with pytest.raises(AspEnvError, match="no snippet is left for validation") as caught:
        train(tiny_config(), data, tmp_path / "run")
    assert "\n" not in str(caught.value)
    assert not (tmp_path / "run").exists()


def test_forecasts_do_not_depend_on_the_batch(data: str, finished: Path) -> None:
    """A target alone is forecast as among all others, to 1e-5 m."""
    recordings = open_data(data)
    scene = gather_scene(recordings, index_snippets(recordings, dt_s=0.2, horizon_s=3.0))
    predictor = load_predictor(f"ffw-asp:{finished}", horizon=15, dt_s=0.2)
    together = predictor.predict(scene)
    for row in (0, 7):
        alone = predictor.predict(scene.with_targets(scene.targets[row : row + 1]))
        np.testing.assert_allclose(alone.states[0], together.states[row], atol=2e-5)
        np.testing.assert_allclose(alone.log_probs[0], together.log_probs[row], atol=1e-5)


@pytest.mark.parametrize(
    ("step", "share"), [(0, 0.1), (4, 0.5), (9, 1.0), (10, 1.0), (55, 0.5), (100, 0.0)]
)
def test_one_cycle_by_hand(step: int, share: float) -> None:
    """Of 100 steps: up over the first ten, half in the middle of the rest, zero at the end."""
    assert one_cycle(step, 100) == pytest.approx(share, abs=1e-9)


def test_paper_recipe_is_the_papers() -> None:
    """ResNet18, GRU of 2x512, 3 modes, Euler; Adam at 1e-4, batches of 32, 10 epochs."""
    config = recipe("ffw-asp", "paper", view="chauffeurnet", horizon_s=3.0)
    network = config.network
    assert (network.encoder, network.features) == ("resnet18", 512)
    assert (network.gru_width, network.gru_layers, network.modes) == (512, 2, 3)
    assert (network.skip, network.hidden) == (False, 0)
    assert (network.integrator, network.assignment) == ("euler", "angle")
    assert (config.learning_rate, config.batch_size, config.epochs) == (1e-4, 32, 10)
    assert (config.schedule, config.weight_decay) == ("plateau", 0.0)
    assert (config.height_px, config.width_px, config.snippets_per_epoch) == (360, 240, None)


def test_unknown_names_list_the_known_ones() -> None:
    """A misspelt predictor or preset is one line with a suggestion."""
    with pytest.raises(AspEnvError, match="did you mean 'ffw-asp'"):
        recipe("ffw", "cpu", view="chauffeurnet", horizon_s=3.0)
    with pytest.raises(AspEnvError, match="known are cpu, paper"):
        recipe("ffw-asp", "gpu", view="chauffeurnet", horizon_s=3.0)


def test_impossible_numbers_are_refused() -> None:
    """No epochs, or a share of standing targets above one, is refused at construction."""
    with pytest.raises(AspEnvError, match="epochs is 0"):
        tiny_config(epochs=0)
    with pytest.raises(AspEnvError, match=r"standing_share is 1\.5"):
        tiny_config(standing_share=1.5)
    assert isinstance(tiny_config(), TrainingConfig)
