"""Budgets: equal CPU time by hand, convergence, and the files of measured costs."""

import dataclasses
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest

from asp_env.errors import AspEnvError
from predictors.training.budgets import (
    EpochCost,
    EpochCosts,
    complete_costs,
    cost_key,
    cpu_time_s,
    until_converged,
)
from predictors.training.command import Train
from predictors.training.epoch_costs import _per_batch_s, measure_epochs
from predictors.training.recipes import TrainingConfig, recipe
from tests.predictors.tiny import tiny_config, write_data

REFERENCE = "ssp-asp:cpu"

COSTS = {
    "ssp-asp:cpu/vectors/3s": EpochCost(20.0, 10.0),
    "ssp-asp:cpu/vectors/6s": EpochCost(40.0),
    "dkm:cpu/vectors/3s": EpochCost(6.0),
    "dkm:cpu/vectors/6s": EpochCost(10.0),
    "dkm:cpu+staged/vectors/6s": EpochCost(10.0),
    "ssp-asp:cpu+from-scratch/vectors/6s": EpochCost(40.0, 25.0),
    "ssp-asp:ours/vectors/3s": EpochCost(1000.0),
    "ssp-asp:cpu+segment-1s/vectors/1s/segments-1s": EpochCost(7.0, 3.0),
    "ssp-asp:cpu+segment-1s/vectors/3s/segments-1s": EpochCost(15.0),
    "ssp-asp:cpu+segment-1s/vectors/6s/segments-1s": EpochCost(41.0),
    "ssp-asp:cpu+segment-6s/vectors/6s/segments-6s": EpochCost(30.0, 10.0),
}
"""CPU times of an epoch in seconds. SSP-ASP takes 2 · 10 + 8 · 20 = 180 s at 3 s, and at 6 s
8 · 40 = 320 s more, 500 s in total."""

EPOCHS: list[tuple[str, str | None, str, float, int]] = [
    ("ssp-asp", None, "cpu", 3.0, 8),  # the reference has its own epochs
    ("ssp-asp", None, "cpu", 6.0, 8),
    ("dkm", None, "cpu", 3.0, 30),  # 180 / 6
    ("dkm", None, "cpu", 6.0, 50),  # 500 / 10, at once
    ("dkm", "staged", "cpu", 6.0, 32),  # (500 - 180) / 10, after the stage of 3 s
    ("ssp-asp", "from-scratch", "cpu", 6.0, 11),  # (500 - 2 · 25) / 40 = 11.25
    ("ssp-asp", None, "ours", 3.0, 1),  # 0.18 epochs; at least one
    ("ssp-asp", "segment-1s", "cpu", 1.0, 12),  # (180 / 2 - 2 · 3) / 7
    ("ssp-asp", "segment-1s", "cpu", 3.0, 6),  # (180 - 180 / 2) / 15
    ("ssp-asp", "segment-1s", "cpu", 6.0, 10),  # (500 - 180 / 2) / 41
    ("ssp-asp", "segment-6s", "cpu", 6.0, 16),  # (500 - 2 · 10) / 30, at once
]


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> str:
    """Three recordings: one for training, one for validation, one for testing."""
    return write_data(tmp_path_factory.mktemp("data"))


@pytest.fixture
def costs(tmp_path: Path) -> Path:
    """A file of `COSTS`."""
    path = tmp_path / "epoch_costs.json"
    EpochCosts(reference=REFERENCE, epochs=COSTS).write(path)
    return path


def command(predictor: str, **options: Any) -> Train:
    """The command for vectors with the budget `cpu` of the recipe `cpu`."""
    given = {"budget": "cpu", "view": "vectors", "cpu_reference": REFERENCE, **options}
    return Train(predictor=predictor, data=("",), out=Path("nowhere"), **given)


@pytest.mark.parametrize(("predictor", "variant", "name", "horizon_s", "epochs"), EPOCHS)
def test_epochs_in_equal_cpu_time_by_hand(
    predictor: str, variant: str | None, name: str, horizon_s: float, epochs: int, costs: Path
) -> None:
    """Both stages add up to the reference's time, pre-training included."""
    given = command(predictor, variant=variant, recipe=name, horizon=horizon_s, costs=costs)
    config = given.config_for(horizon_s)
    assert (config.budget, config.epochs) == ("cpu", epochs)
    before = given.unlimited_for(horizon_s)
    assert config == dataclasses.replace(before, budget="cpu", epochs=epochs)


def test_epochs_of_the_reference_can_be_given(costs: Path) -> None:
    """With 5 prediction epochs it takes 2 · 10 + 5 · 20 = 120 s, 20 epochs of DKM."""
    assert command("ssp-asp", costs=costs, epochs=5).config_for(3.0).epochs == 5
    assert command("dkm", costs=costs, epochs=5).config_for(3.0).epochs == 20


def test_cost_that_is_not_measured_is_an_error(costs: Path) -> None:
    with pytest.raises(AspEnvError, match="epoch of mtp:cpu/vectors/3s is not measured"):
        command("mtp", costs=costs).config_for(3.0)
    with pytest.raises(AspEnvError, match="the reference ssp-asp:cpu, not dkm:cpu"):
        command("dkm", costs=costs, cpu_reference="dkm").config_for(3.0)
    costs.write_text("{}")
    with pytest.raises(AspEnvError, match="holds no costs of epochs"):
        command("dkm", costs=costs).config_for(3.0)


def test_needed_costs_are_those_of_both_stages() -> None:
    """Of the reference and of the predictor, each once."""
    keys = [cost_key(each) for each in command("ssp-asp", horizon=6.0).costly_configs()]
    assert keys == ["ssp-asp:cpu/vectors/3s", "ssp-asp:cpu/vectors/6s"]
    keys = [cost_key(each) for each in command("dkm", horizon=3.0).costly_configs()]
    assert keys == ["ssp-asp:cpu/vectors/3s", "dkm:cpu/vectors/3s"]
    short = command("ssp-asp", segment_s=1.0, history_s=2.0, horizon=6.0).costly_configs()
    assert [cost_key(each) for each in short] == [
        "ssp-asp:cpu/vectors/3s/history-2s",
        "ssp-asp:cpu/vectors/6s/history-2s",
        "ssp-asp:cpu/vectors/1s/segments-1s/history-2s",
        "ssp-asp:cpu/vectors/6s/segments-1s/history-2s",
    ]


def test_options_that_change_the_cost_have_costs_of_their_own() -> None:
    short = command("dkm", precision="bf16-mixed", max_snippets=900).costly_configs()
    assert [cost_key(each) for each in short] == [
        "ssp-asp:cpu/vectors/3s/bf16-mixed/900-snippets",
        "dkm:cpu/vectors/3s/bf16-mixed/900-snippets",
    ]


def test_parked_targets_have_costs_of_their_own(costs: Path) -> None:
    """With them an epoch has more snippets, so that the costs without them do not apply."""
    keys = [cost_key(each) for each in command("dkm", parked=True).costly_configs()]
    assert keys == ["ssp-asp:cpu/vectors/3s/parked", "dkm:cpu/vectors/3s/parked"]
    with pytest.raises(AspEnvError, match="ssp-asp:cpu/vectors/3s/parked is not measured"):
        command("dkm", parked=True, costs=costs).config_for(3.0)


def test_known_costs_stay_and_new_ones_are_scaled(tmp_path: Path) -> None:
    """A machine that takes 25 s for the reference's 20 s takes 10 s for what costs 8 s."""
    path = tmp_path / "costs.json"
    ssp, dkm = (recipe(name, "cpu", view="vectors", horizon_s=3.0) for name in ("ssp-asp", "dkm"))
    asked: list[list[str]] = []

    def measure(seconds: dict[str, float]) -> Any:
        def measured(configs: Sequence[TrainingConfig]) -> list[EpochCost]:
            asked.append([each.predictor for each in configs])
            return [
                EpochCost(seconds[each.predictor], 5.0 * (each.pretraining_epochs > 0))
                for each in configs
            ]

        return measured

    complete_costs(path, REFERENCE, [ssp], measure({"ssp-asp": 20.0}))
    both = complete_costs(path, REFERENCE, [ssp, dkm], measure({"ssp-asp": 25.0, "dkm": 10.0}))
    assert both.of(ssp) == EpochCost(20.0, 5.0)
    assert both.of(dkm) == EpochCost(8.0, 0.0)
    assert EpochCosts.read(path, REFERENCE) == both
    complete_costs(path, REFERENCE, [dkm, ssp], measure({}))
    assert asked == [["ssp-asp"], ["dkm", "ssp-asp"]]


def test_mean_time_of_a_batch_by_hand() -> None:
    """Of 20 batches, 4 at the start and 4 at the end do not count; of two, one does."""
    times = [*(10.0 * n for n in range(5)), *(40.0 + n for n in range(1, 13)), *([52.0] * 4)]
    assert len(times) == 21
    assert _per_batch_s(times) == pytest.approx(1.0)
    assert _per_batch_s([0.0, 5.0, 7.0]) == pytest.approx(2.0)
    assert _per_batch_s([0.0, 5.0]) == pytest.approx(5.0)


def test_measured_costs_are_positive(data: str) -> None:
    """SSP-ASP has a cost of pre-training, DKM none."""
    configs = [
        tiny_config("ssp-asp", "vectors", pretraining_epochs=1),
        tiny_config("dkm", "vectors"),
    ]
    ssp, dkm = measure_epochs(configs, data)
    assert min(*ssp, dkm.prediction_s) > 0
    assert dkm.pretraining_s == 0


def test_converged_runs_have_a_limit_and_plateau() -> None:
    """80 epochs for a recipe of 8, whose annealing takes 8; other fields stay."""
    base = recipe("ssp-asp", "cpu", view="vectors", horizon_s=3.0)
    config = until_converged(base)
    assert (config.epochs, config.patience, config.progress_epochs) == (80, 10, 8)
    assert (config.schedule, config.budget) == ("plateau", "converged")
    fields = ("epochs", "patience", "progress_epochs", "schedule", "budget")
    same = {field: getattr(base, field) for field in fields}
    assert dataclasses.replace(config, **same) == base
    few = command("ssp-asp", budget="converged", epochs=5, patience=3).config_for(3.0)
    assert (few.epochs, few.patience, few.progress_epochs) == (5, 3, 5)


def test_options_of_other_budgets_are_refused(tmp_path: Path) -> None:
    for options, what in (
        ({"patience": 3}, "patience is 3 with the budget cpu"),
        ({"budget": "epochs", "costs": tmp_path}, "costs are given with the budget epochs"),
        ({"variant": "long"}, "variant long multiplies the epochs, which the budget cpu sets"),
    ):
        with pytest.raises(AspEnvError, match=what):
            command("dkm", **options).config_for(3.0)


def test_train_measures_once_and_trains_as_many_epochs(data: str, tmp_path: Path) -> None:
    """The costs lie beside the run; a folder of something else is not changed."""
    given = Train(
        predictor="dkm", data=(data,), out=tmp_path / "run", view="vectors", budget="cpu",
        cpu_reference="dkm", epochs=2, max_snippets=16,
    )  # fmt: skip
    given.run()
    path = tmp_path / "run" / "epoch_costs.json"
    costs = EpochCosts.read(path, "dkm:cpu")
    assert list(costs.epochs) == ["dkm:cpu/vectors/3s/16-snippets"]
    provenance = json.loads((tmp_path / "run" / "config.json").read_text())["provenance"]
    assert provenance["config"]["budget"] == "cpu"
    assert provenance["trained_epochs"] == 2
    (tmp_path / "letters").mkdir()
    (tmp_path / "letters" / "letter.txt").write_text("dear")
    with pytest.raises(AspEnvError, match="something that is no run"):
        dataclasses.replace(given, out=tmp_path / "letters").run()
    assert [each.name for each in (tmp_path / "letters").iterdir()] == ["letter.txt"]


def test_costs_of_a_short_history_are_measured(data: str) -> None:
    """The view shows 2 s; the segments of 1 s are those of the run."""
    given = command("ssp-asp", segment_s=1.0, history_s=2.0, horizon=3.0)
    config = dataclasses.replace(given.unlimited_for(3.0), max_snippets=16)
    assert measure_epochs([config], data)[0].prediction_s > 0


def test_time_of_stages_by_hand() -> None:
    """2 · 10 + 8 · 20 + 8 · 40 = 500 s."""
    costs = EpochCosts(reference=REFERENCE, epochs=COSTS)
    stages = [recipe("ssp-asp", "cpu", view="vectors", horizon_s=each) for each in (3.0, 6.0)]
    assert cpu_time_s(stages, costs) == 500.0
