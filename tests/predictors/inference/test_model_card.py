"""The model card of a run."""

import json
import re
from pathlib import Path

import pytest
import yaml

from asp_env import registry
from predictors.inference.checkpoint import PredictorSpec
from predictors.inference.model_card import model_card
from predictors.training.recipes import RECIPES
from tests.predictors.tiny import save_random

PROVENANCE = {
    "trained_on": {
        "source": "recordings",
        "split": "blocks",
        "parts": {"a": "train", "b": "train", "c": "validation"},
    },
    "config": {
        "preset": "cpu",
        "history": "causal",
        "validation": ["others"],
        "learning_rate": 0.002,
        "threads": None,
    },
    "snippets": {"training": 500, "validation": 20},
    "data_hash": "9d72",
    "best_epoch": 3,
    "best_value": 1.23456,
    "versions": {"torch": "2.13.0", "numpy": "2.4.6"},
}


def card_of(run: Path, **provenance: object) -> str:
    """The card of a run with a changed provenance."""
    config = json.loads((run / "config.json").read_text())
    config["provenance"] = {**config["provenance"], **provenance}
    spec: PredictorSpec = registry.find("predictors", config["predictor"])
    return model_card(config, spec.network, weights="0123456789abcdef")


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of 6 s with random weights."""
    folder = tmp_path_factory.mktemp("cards") / "run"
    return save_random(folder, "ssp-asp", "vectors", horizon=30, temperature=1.7)


@pytest.mark.parametrize("name", sorted(RECIPES))
def test_every_run_has_a_card(name: str, tmp_path: Path) -> None:
    """The card is beside the weights, with the predictor's paper and the hash of the weights."""
    card = (save_random(tmp_path / "run", name) / "README.md").read_text()
    assert f"# {name}, 3 s" in card
    assert re.search(r"arXiv:\d{4}\.\d{5}", card)
    spec: PredictorSpec = registry.find("predictors", name)
    config = json.loads((tmp_path / "run" / "config.json").read_text())
    weights = re.search(r"SHA-256 `([0-9a-f]{16})…`", card)
    assert weights is not None
    assert model_card(config, spec.network, weights=weights[1]) == card


def test_header_for_model_hubs(run: Path) -> None:
    """YAML between two lines of dashes: library, licence, tags."""
    _, header, _ = (run / "README.md").read_text().split("---\n", 2)
    assert yaml.safe_load(header) == {
        "library_name": "asp-env",
        "license": "other",
        "license_name": "terms-of-the-training-data",
        "tags": [
            "trajectory-prediction",
            "motion-forecasting",
            "autonomous-driving",
            "ssp-asp",
            "vectors",
        ],
    }


def test_numbers_of_a_run(run: Path) -> None:
    """Recordings and snippets by part, histories, horizon, epoch, value, temperature, versions."""
    card = card_of(run, **PROVENANCE)
    for text in (
        "# ssp-asp, 6 s",
        "| recipe | cpu |",
        "| history | 3 s: 15 ticks of 0.2 s |",
        "3 modes of 30 ticks of 0.2 s (6 s)",
        "| agent classes | car, van, truck, bus, truck_bus, motorcycle, other |",
        "| data | `recordings` |",
        "| validation data | `others` |",
        "| split | blocks |",
        "| recordings | 2 train, 1 validation |",
        "| snippets | 500 training, 20 validation |",
        "| histories | causal: filtered forward",
        "| learning rate | 0.002 |",
        "| best epoch | 3 |",
        "| selected by | 1.235 m, the lowest of all epochs",
        "| versions | numpy 2.4.6, torch 2.13.0 |",
        "a temperature, 1.7, on the validation data",
        "CC BY-NC-SA",
    ):
        assert text in card, text


def test_unknown_facts_are_omitted(run: Path) -> None:
    """A run with few facts has a card without empty rows and without None."""
    card = card_of(run, config={"threads": None})
    assert "None" not in card
    assert "| threads |" not in card
    assert "best epoch" not in card


def test_equal_configurations_have_equal_cards(run: Path) -> None:
    """There is no time of day and no random order."""
    assert card_of(run, **PROVENANCE) == card_of(run, **PROVENANCE)
    assert not re.search(r"\d\d:\d\d", card_of(run, **PROVENANCE))
