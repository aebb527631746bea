"""Fine-tuning: what it takes from the run, what it may change, and what it records."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors.torch import load_file

from asp_env.data.predictor import load_predictor
from asp_env.data.source import open_data
from asp_env.errors import AspEnvError, CheckpointError
from asp_env.evaluation.selection import ticks_to_evaluate
from predictors.training import fine_tuning
from predictors.training.augmentation import Augmentation
from predictors.training.command import Train
from predictors.training.fine_tuning import (
    ValidationErrors,
    interpolated,
    is_improved,
    mixed_rows,
)
from predictors.training.fitting import train
from tests.data.levelx_files import write_map, write_recording
from tests.predictors.tiny import save_random, tiny_config, tiny_network, write_data


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("fine-tuning")


@pytest.fixture(scope="module")
def before(folder: Path) -> str:
    """Data that the start was trained on: other cars than those of `own`."""
    return write_data(folder / "before", cars=3)


@pytest.fixture(scope="module")
def own(folder: Path) -> str:
    return write_data(folder / "own", cars=5)


@pytest.fixture(scope="module")
def start(folder: Path, before: str) -> Path:
    """A run of one epoch."""
    return train(tiny_config("ffw-asp", "vectors", epochs=1), before, folder / "start")


def command(start: Path, data: str, out: Path, **options: Any) -> Train:
    return Train(
        predictor="ffw-asp", data=(data,), out=out, from_run=f"ffw-asp:{start}",
        **{"epochs": 2, **options},
    )  # fmt: skip


@pytest.fixture(scope="module")
def tuned(start: Path, own: str, before: str, folder: Path) -> Path:
    """A fine-tuned run, with the data of the start mixed in."""
    command(start, own, folder / "tuned", mix=(before,)).run()
    return folder / "tuned"


def config_of(run: Path) -> dict[str, Any]:
    return json.loads((run / "config.json").read_text())


def test_everything_but_the_weights_is_the_run_s(start: Path, tuned: Path) -> None:
    """View, network, normaliser, time step, history and horizon."""
    one, other = config_of(start), config_of(tuned)
    for field in ("predictor", "view", "network", "normaliser", "dt_s", "history", "horizon"):
        assert other[field] == one[field], field
    schedules = [each["provenance"]["config"] for each in (one, other)]
    assert schedules[1]["learning_rate"] == pytest.approx(0.1 * schedules[0]["learning_rate"])
    assert schedules[1]["preset"] == "cpu+fine-tuned"
    assert schedules[1]["batch_size"] == schedules[0]["batch_size"]


def test_a_run_with_augmentation_until_convergence_continues_with_it(
    before: str, own: str, tmp_path: Path
) -> None:
    """The stored ranges are those of the start; its budget is not that of the fine-tuning."""
    config = tiny_config(
        "ffw-asp",
        "vectors",
        epochs=1,
        schedule="plateau",
        budget="converged",
        patience=1,
        augmentation=Augmentation(largest_scale=1.1),
        network=tiny_network("ffw-asp", "vectors", standing=True),
    )
    start = train(config, before, tmp_path / "start")
    command(start, own, tmp_path / "tuned", epochs=1).run()
    one, other = (config_of(tmp_path / each)["provenance"]["config"] for each in ("start", "tuned"))
    assert other["augmentation"] == one["augmentation"]
    assert other["augmentation"]["largest_scale"] == 1.1
    assert (other["budget"], other["patience"]) == ("epochs", None)


def test_recordings_of_both_are_not_evaluated_on(
    start: Path, tuned: Path, before: str, own: str
) -> None:
    """Of the start's data and of the mixed-in ones nothing is left, of the own ones the test part.

    The start alone leaves its test part.
    """
    first, second = (
        load_predictor(f"ffw-asp:{run}", horizon=15, dt_s=0.2) for run in (start, tuned)
    )
    assert second.trained_on is not None
    known = set(open_data(before).hashes()) | set(open_data(own).hashes())
    assert set(second.trained_on.parts) == known

    def allowed(data: str, predictor: Any) -> int:
        recordings = open_data(data)
        masks, _ = ticks_to_evaluate(recordings, [predictor], "auto", dt_s=0.2)
        return sum(bool(mask.any()) for mask in masks)

    assert allowed(before, first) == 1
    assert allowed(before, second) == 0
    assert allowed(own, second) == 1


def test_validation_error_is_never_higher_than_that_of_the_start(tuned: Path) -> None:
    """The start is epoch 0; what is stored is the error of the result."""
    provenance = config_of(tuned)["provenance"]
    errors = provenance["fine_tuning"]["validation FDE moving"]
    assert len(errors) == 3
    assert provenance["best_value"] <= errors[0]


def test_start_remains_if_nothing_is_better(
    start: Path, own: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """At a rate that ruins the network, the weights are those of the start, bit for bit."""
    monkeypatch.setattr(fine_tuning, "LEARNING_RATE_SHARE", 1e4)
    command(start, own, tmp_path / "run").run()
    provenance = config_of(tmp_path / "run")["provenance"]
    assert provenance["fine_tuning"]["share"] == 0
    assert provenance["best_epoch"] == 0
    one, other = (load_file(run / "weights.safetensors") for run in (start, tmp_path / "run"))
    assert all(torch.equal(one[name], other[name]) for name in one)


def test_same_seed_gives_the_same_bits(start: Path, own: str, tmp_path: Path) -> None:
    runs = [tmp_path / name for name in ("one", "other")]
    for run in runs:
        command(start, own, run, epochs=1).run()
    files = [(run / "weights.safetensors").read_bytes() for run in runs]
    assert files[0] == files[1]
    assert (runs[0] / "config.json").read_bytes() == (runs[1] / "config.json").read_bytes()


def test_one_recording_is_split_by_blocks_with_a_notice(
    start: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Or validated on other data."""
    one = write_data(tmp_path / "one", recordings=1, cars=6)
    other = write_data(tmp_path / "other", recordings=1, cars=7)
    with pytest.raises(AspEnvError, match="no recording is left to test on"):
        command(start, one, tmp_path / "run", split="recording").run()
    command(start, one, tmp_path / "run", validation=(other,), epochs=1).run()
    config, data = fine_tuning._open(tiny_config("ffw-asp", "vectors"), own_long(tmp_path), None)
    assert config.split == "blocks"
    assert set(data.trained_on.parts.values()) == {"blocks"}
    assert "too few recordings" in capsys.readouterr().err


def own_long(folder: Path) -> str:
    """One recording whose blocks of 12 s are longer than a snippet."""
    write_recording(folder / "long", number=0, classes=("car",) * 3, num_frames=3000)
    write_map(folder / "long")
    return str(folder / "long")


def test_options_that_the_run_decides_are_refused(start: Path, own: str, tmp_path: Path) -> None:
    for option in ({"view": "mtp"}, {"recipe": "ours"}, {"horizon": 6.0}, {"devices": 2}):
        (name,) = option
        with pytest.raises(AspEnvError, match=f"--{name} with --from"):
            command(start, own, tmp_path / "run", **option).run()
    with pytest.raises(AspEnvError, match="expected a finished run of ffw-asp"):
        Train(predictor="ffw-asp", data=(own,), out=tmp_path / "run", from_run=f"dkm:{start}").run()
    with pytest.raises(AspEnvError, match="only a fine-tuning mixes data"):
        Train(predictor="ffw-asp", data=(own,), out=tmp_path / "run", mix=(own,)).run()
    assert not (tmp_path / "run").exists()


def test_recording_in_both_data_is_refused(start: Path, own: str, tmp_path: Path) -> None:
    with pytest.raises(AspEnvError, match="give each recording once"):
        command(start, own, tmp_path / "run", mix=(own,)).run()
    assert not (tmp_path / "run").exists()


def test_run_that_does_not_state_its_training_is_refused(own: str, tmp_path: Path) -> None:
    run = save_random(tmp_path / "start", "ffw-asp", "vectors")
    with pytest.raises(CheckpointError, match="does not state how it was trained"):
        command(run, own, tmp_path / "run").run()


def test_probabilities_are_calibrated_only_on_enough_targets(
    start: Path, own: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With too few, the temperature is the start's."""
    temperatures = []
    for minimum in (1, 10**6):
        monkeypatch.setattr(fine_tuning, "MIN_CALIBRATION_TARGETS", minimum)
        run = tmp_path / f"run{minimum}"
        command(start, own, run, epochs=1).run()
        assert config_of(run)["provenance"]["fine_tuning"]["calibrated"] == (minimum == 1)
        temperatures.append(config_of(run)["temperature"])
    assert temperatures[1] == config_of(start)["temperature"] != temperatures[0]


def test_half_of_every_even_batch_is_mixed_in() -> None:
    """10 own snippets and 100 others: own and mixed in turn; every own one once in an epoch."""
    rows = mixed_rows(10, 100, per_epoch=10, epoch=3, seed=0)
    assert len(rows) == 20
    assert sorted(rows[::2]) == [*range(10)]
    assert (rows[1::2] >= 10).all()
    assert (rows[1::2] < 110).all()
    assert sorted(mixed_rows(4, 0, per_epoch=8, epoch=0, seed=1)) == [0, 0, 1, 1, 2, 2, 3, 3]


def test_average_by_hand() -> None:
    """A quarter of the way from 2 to 6 is 3; integers are fine-tuned ones; the ends are exact."""
    start = {"w": torch.tensor([2.0, 0.1]), "n": torch.tensor(3)}
    tuned = {"w": torch.tensor([6.0, 0.3]), "n": torch.tensor(8)}
    found = interpolated(start, tuned, 0.25)
    torch.testing.assert_close(found["w"], torch.tensor([3.0, 0.15]))
    assert int(found["n"]) == 8
    assert torch.equal(interpolated(start, tuned, 0.0)["w"], start["w"])
    assert torch.equal(interpolated(start, tuned, 1.0)["w"], tuned["w"])


def errors(values: list[float], vehicles: list[int]) -> ValidationErrors:
    return ValidationErrors(fde_m=np.array(values, dtype=float), vehicle=np.array(vehicles))


def test_improvement_is_more_than_its_standard_error() -> None:
    """With vehicles as clusters: the root of the squared sums of deviations, over the count."""
    zero = [10.0] * 4
    vehicles = [0, 0, 1, 1]
    # Sums of deviations are -3 and 3: √(18 · 2) / 4 = 1.5 < 2.5.
    assert is_improved(errors(zero, vehicles), errors([9, 9, 6, 6], vehicles))
    # Gains -1, -1, 3, 3: mean 1, sums -4 and 4: √(32 · 2) / 4 = 2 > 1.
    assert not is_improved(errors(zero, vehicles), errors([11, 11, 7, 7], vehicles))
    # As four vehicles the same gains have √(16 · 4 / 3) / 4 = 1.15 > 1.
    assert not is_improved(errors(zero, [0, 1, 2, 3]), errors([11, 11, 7, 7], [0, 1, 2, 3]))
    # One vehicle, or no gain.
    assert not is_improved(errors(zero, [0] * 4), errors([1.0] * 4, [0] * 4))
    assert not is_improved(errors(zero, vehicles), errors(zero, vehicles))
