"""A training run: its files, its result, and its errors."""

import csv
import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import load_file

from asp_env.data.predictor import load_predictor
from asp_env.data.snippets import SnippetIndex, gather_scene, index_snippets
from asp_env.data.source import Recordings, open_data
from asp_env.data.split import Split, snippet_parts
from asp_env.errors import AspEnvError
from predictors.inference.calibration import fit_temperature
from predictors.inference.trained import TrainedPredictor
from predictors.models.batch import Batch, Labels
from predictors.models.chaining import Chaining
from predictors.models.losses import best_mode
from predictors.models.network import TrainingProgress
from predictors.models.ssp_asp import SSPASPNetwork
from predictors.training import data as training_data
from predictors.training.data import VALIDATION_BATCH, open_training_data
from predictors.training.fitting import train
from predictors.training.lightning_parts import SELECTED_BY, VALIDATION_LOSS, one_cycle
from predictors.training.trainer import stage_of
from tests.predictors.tiny import tiny_config, tiny_network, write_data


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> str:
    """Three recordings: one for training, one for validation, one for testing."""
    return write_data(tmp_path_factory.mktemp("data"))


@pytest.fixture(scope="module")
def finished(data: str, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished run of four epochs."""
    return train(tiny_config(), data, tmp_path_factory.mktemp("runs") / "finished")


def test_other_seed_gives_other_weights(data: str, finished: Path, tmp_path: Path) -> None:
    other = train(tiny_config(seed=1), data, tmp_path / "run")
    name = "head.layers.0.weight"
    weights = [load_file(run / "weights.safetensors")[name] for run in (finished, other)]
    assert not torch.equal(*weights)


def test_run_folder_holds_no_pickles(finished: Path) -> None:
    """It holds the configuration, weights, statistics of features, card and logs only."""
    files = {str(path.relative_to(finished)) for path in finished.rglob("*") if path.is_file()}
    assert "logs/from-epoch-00/metrics.csv" in files
    logs = {name for name in files if name.startswith("logs/")}
    written = {"config.json", "weights.safetensors", "features.safetensors", "README.md"}
    assert files - logs == written
    assert all("events" in n or n.endswith(("metrics.csv", "hparams.yaml")) for n in logs)


def test_checkpoint_names_its_training_data(data: str, finished: Path) -> None:
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
    assert predictor.metadata["trained_on"] == data
    assert predictor.metadata["preset"] == "cpu"
    assert predictor.trained_on is not None
    assert predictor.trained_on.split == "recording"
    assert dict(predictor.trained_on.parts) == known["parts"]


def test_network_that_merges_has_two_temperatures(data: str, tmp_path: Path) -> None:
    """Each temperature is the best one for the modes that it divides."""
    config = tiny_config("ssp-asp", "vectors", epochs=1, pretraining_epochs=0)
    config = dataclasses.replace(config, network=tiny_network("ssp-asp", "vectors", kept=3))
    run = train(config, data, tmp_path / "run")
    predictor = load_predictor(f"ssp-asp:{run}", horizon=15, dt_s=0.2)
    assert isinstance(predictor, TrainedPredictor)
    network = predictor.network
    assert isinstance(network, SSPASPNetwork)
    merging = network.merging_temperature
    assert merging is not None
    validation = open_training_data(config, data).validation
    batches = validation.batches(
        predictor.view, size=VALIDATION_BATCH, later_ticks=network.later_ticks, config=config
    )
    stored = json.loads((run / "config.json").read_text())["temperature"]
    both: tuple[tuple[Chaining, float], ...] = (("full", float(merging)), ("beam", stored))
    for chaining, temperature in both:
        logits, best = [], []
        with torch.inference_mode():
            for batch, labels in batches:
                modes = network.chain(batch, chaining)
                logits.append(modes.logits.numpy())
                best.append(best_mode(modes.states[..., :2], labels.states[..., :2], "distance"))
        expected = fit_temperature(np.concatenate(logits), np.concatenate(best))
        assert temperature == pytest.approx(expected, rel=1e-3)
        assert abs(temperature - 1) > 1e-2


def test_epochs_are_named_by_their_stage() -> None:
    """Two epochs of pre-training and three prediction epochs, each counted from 1."""
    config = tiny_config(pretraining_epochs=2, epochs=3)
    assert [stage_of(config, epoch) for epoch in range(5)] == [
        "pre-training 1/2", "pre-training 2/2", "epoch 1/3", "epoch 2/3", "epoch 3/3",
    ]  # fmt: skip
    limited = dataclasses.replace(config, schedule="plateau", patience=1)
    assert stage_of(limited, 4) == "epoch 3/at most 3"


def test_pretraining_has_no_validation_error(
    data: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Neither in the messages nor in the log; annealing begins after it.

    Of two epochs of two steps the second is half over at its second step.
    """
    shares: list[tuple[float, bool]] = []
    loss = SSPASPNetwork.training_loss

    def recorded(
        self: SSPASPNetwork, batch: Batch, labels: Labels, progress: TrainingProgress
    ) -> dict[str, torch.Tensor]:
        shares.append((progress.share, progress.pretraining))
        return loss(self, batch, labels, progress)

    monkeypatch.setattr(SSPASPNetwork, "training_loss", recorded)
    config = tiny_config(
        "ssp-asp", "vectors", pretraining_epochs=1, epochs=1, snippets_per_epoch=16
    )
    run = train(config, data, tmp_path / "run")
    assert shares == [(0.0, True), (0.0, True), (0.0, False), (0.5, False)]
    lines = [line for line in capsys.readouterr().err.splitlines() if "training loss" in line]
    assert [line.partition(":")[0] for line in lines] == ["pre-training 1/1", "epoch 1/1"]
    assert [f"{SELECTED_BY} n/a" in line for line in lines] == [True, False]
    with (run / "logs" / "from-epoch-00" / "metrics.csv").open(newline="") as file:
        rows = [row for row in csv.DictReader(file) if row[VALIDATION_LOSS]]
    assert [bool(row[SELECTED_BY]) for row in rows] == [False, True]
    provenance = json.loads((run / "config.json").read_text())["provenance"]
    assert (provenance["trained_epochs"], provenance["best_epoch"]) == (1, 1)


def test_progress_bar_names_the_stage(
    data: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """On a terminal the bar stands in for the lines; it counts pre-training apart, too."""
    monkeypatch.setattr("sys.stderr.isatty", lambda: True)
    config = tiny_config("ssp-asp", "vectors", pretraining_epochs=1, epochs=1, snippets_per_epoch=8)
    train(config, data, tmp_path / "run")
    shown = "".join(capsys.readouterr())
    assert "pre-training 1/1" in shown
    assert "epoch 1/1" in shown


def test_finished_run_is_refused(data: str, finished: Path) -> None:
    with pytest.raises(AspEnvError, match="holds a finished run"):
        train(tiny_config(), data, finished)


def test_a_run_that_was_killed_after_its_last_file(data: str, tmp_path: Path) -> None:
    """It is finished; its state is removed."""
    state = tmp_path / "unfinished"
    state.mkdir()
    (state / "run.json").write_text("{}")
    (tmp_path / "config.json").write_text("{}")
    with pytest.raises(AspEnvError, match="holds a finished run"):
        train(tiny_config(), data, tmp_path)
    assert not state.exists()


def test_other_configuration_is_refused(data: str, tmp_path: Path) -> None:
    """An unfinished run is continued only with its own configuration."""
    out = tmp_path / "run"
    (out / "unfinished").mkdir(parents=True)
    (out / "unfinished" / "run.json").write_text("{}")
    with pytest.raises(AspEnvError, match="unfinished run of another configuration"):
        train(tiny_config(), data, out)


def test_folder_with_other_files_is_refused(data: str, tmp_path: Path) -> None:
    """The folder is not changed."""
    (tmp_path / "letter.txt").write_text("dear")
    with pytest.raises(AspEnvError, match="something that is no run"):
        train(tiny_config(), data, tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["letter.txt"]


def test_loss_that_is_not_finite_stops_the_run(
    data: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A loss of NaN raises, and no checkpoint is written."""
    terms = "predictors.models.losses.regression_loss"
    monkeypatch.setattr(terms, lambda *_: torch.tensor(float("nan"), requires_grad=True))
    with pytest.raises(AspEnvError, match="not finite in epoch 0"):
        train(tiny_config(), data, tmp_path / "run")
    assert not (tmp_path / "run" / "config.json").exists()


def test_too_few_recordings_leave_no_folder(tmp_path: Path) -> None:
    """If no recording is left for testing, the error names blocks, and nothing is written."""
    data = write_data(tmp_path / "data", recordings=1)
    with pytest.raises(AspEnvError, match="--split blocks"):
        train(tiny_config(), data, tmp_path / "run")
    assert not (tmp_path / "run").exists()


def test_empty_validation_part_is_refused(
    data: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The error is raised before anything is written."""

    def all_to_train(recordings: Recordings, index: SnippetIndex, split: Split) -> object:
        _, trained_on = snippet_parts(recordings, index, split)
        return np.full(len(index), "train"), trained_on

    monkeypatch.setattr(training_data, "snippet_parts", all_to_train)
    with pytest.raises(AspEnvError, match="no snippet is left for validation") as caught:
        train(tiny_config(), data, tmp_path / "run")
    assert "\n" not in str(caught.value)
    assert not (tmp_path / "run").exists()


def test_forecasts_do_not_depend_on_the_batch(data: str, finished: Path) -> None:
    """The forecast of a single target equals that in a batch, to 2e-5 m."""
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
    """100 steps: rising over the first ten, half at the middle of the rest, zero at the end."""
    assert one_cycle(step, 100) == pytest.approx(share, abs=1e-9)
