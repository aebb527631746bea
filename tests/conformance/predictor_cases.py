"""The predictors under test, and the situations that they forecast.

All registered predictors are tested. Trained ones have random weights and read rasters or vectors;
those that chain segments are tested with every chaining at 6 s. The recipes `ours` are tested on
vectors. A predictor with an argument is tested with each of `ARGUMENTS`. The pretrained ones are
tested with their own weights, and guarded ones with statistics by which most targets are blended.
"""

import re
from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest

from asp_env import registry
from asp_env.data.predictor import Forecast, Predictor
from asp_env.data.recording import Recording
from asp_env.data.scene import Scene
from asp_env.data.snippets import (
    Future,
    SnippetIndex,
    gather_future,
    gather_scene,
    index_snippets,
)
from predictors.inference.pretrained import PRETRAINED, pretrained_names
from predictors.models.chaining import CHAININGS
from predictors.training.recipes import RECIPES
from tests.builders import make_recording
from tests.predictors.tiny import save_distance, save_random

VIEWS = ("chauffeurnet", "vectors")
SEGMENT = 15
HISTORY = 15
ARGUMENTS = {
    "blend": ("0.25",),
    "noisy-oracle": ("2",),
    "most-probable": ("ffw-asp:pretrained", "oracle"),
    "delayed": ("2:constant-turn-rate", "3:oracle", "1:delayed:1:blend:0.5"),
}
"""Arguments of the predictors that need one."""
RECORDING = make_recording()


class Case(NamedTuple):
    """One predictor under test."""

    name: str
    view: str = ""
    """View of a trained predictor."""
    chaining: str = ""
    """Chaining of a predictor that chains segments."""
    preset: str = ""
    """Recipe, by default `cpu`."""

    @property
    def horizon(self) -> int:
        """Ticks of the forecast."""
        return 2 * SEGMENT if self.chaining else SEGMENT

    @property
    def label(self) -> str:
        """Id of the test."""
        return "-".join(part for part in self if part)

    def save(self, folder: Path, *, seed: int = 0) -> str:
        """The full name; a folder with random weights is written if the predictor needs one."""
        if not self.view:
            return self.name
        run = folder / self.label
        if not run.exists():
            preset = self.preset or "cpu"
            kind = self.name.rpartition(":")[2]
            save_random(run, kind, self.view, horizon=self.horizon, seed=seed, preset=preset)
            if self.name.startswith("guarded"):
                save_distance(run)
        return f"{self.name}:{run}" + (f"@{self.chaining}" if self.chaining else "")


PHYSICAL = tuple(
    Case(":".join(part for part in (name, argument) if part))
    for name in registry.names("predictors")
    if name not in RECIPES and name != "guarded"
    for argument in ARGUMENTS.get(name, ("",))
)
ONE_SEGMENT = tuple(Case(name, view) for name in RECIPES for view in VIEWS)
CHAINED = tuple(Case("ssp-asp", "vectors", chaining) for chaining in CHAININGS)
OURS = tuple(Case(name, "vectors", preset="ours") for name, of in RECIPES.items() if "ours" in of)
OURS_CHAINED = tuple(Case("ssp-asp", "vectors", chaining, "ours") for chaining in CHAININGS)
GUARDED = tuple(Case(f"guarded:{name}", "vectors") for name in ("ffw-asp", "mtp"))
DELAYED = tuple(Case(f"delayed:2:{name}", "vectors") for name in ("ffw-asp", "mtp"))
TRAINED = ONE_SEGMENT + CHAINED + OURS + OURS_CHAINED
SHIPPED = tuple(Case(f"{name}:{PRETRAINED}") for name in pretrained_names())


def with_predictors(cases: tuple[Case, ...]) -> pytest.MarkDecorator:
    """Runs a test once with each predictor."""
    labels = [case.label for case in cases]
    return pytest.mark.parametrize("predictor", cases, ids=labels, indirect=True)


every = with_predictors(PHYSICAL + TRAINED + DELAYED + GUARDED + SHIPPED)


@cache
def snippets(horizon: int, history: int = HISTORY) -> SnippetIndex:
    """All snippets with a history and a future of this many ticks."""
    return index_snippets([RECORDING], dt_s=0.2, horizon_s=horizon * 0.2, history_s=history * 0.2)


def snippets_for(predictor: Predictor) -> SnippetIndex:
    """All snippets with the predictor's horizon and at least its history."""
    return snippets(predictor.horizon, max(HISTORY, predictor.history))


def forecasts_all_classes(predictor: Predictor) -> bool:
    """Whether it also forecasts agents that trained predictors do not, such as pedestrians."""
    kind = re.sub(r"(delayed:\d+|most-probable|guarded):", "", predictor.name).partition(":")[0]
    return kind in (
        "oracle",
        "blind",
        "blend",
        "noisy-oracle",
        "shuffled-oracle",
        "interactive-oracle",
    )


def has_inferred_actions(predictor: Predictor) -> bool:
    """Whether its actions are inferred from recorded states, so that they may exceed the limits."""
    return predictor.privileged and predictor.trained_on is None


def situations(predictor: Predictor, recording: Recording = RECORDING) -> tuple[Scene, Future]:
    """Scene and future of all snippets with the predictor's horizon."""
    index = snippets_for(predictor)
    return gather_scene([recording], index), gather_future([recording], index)


def all_slots(predictor: Predictor) -> tuple[Scene, Future]:
    """Scene and future with every slot of every situation as a target, also absent agents."""
    scene, _ = situations(predictor)
    targets = np.argwhere(np.ones(scene.ids.shape, dtype=bool))
    states = np.zeros((len(targets), predictor.horizon, 4), dtype=np.float32)
    valid = np.ones((len(targets), predictor.horizon), dtype=bool)
    return scene.with_targets(targets), Future(states=states, valid=valid)


def predict(predictor: Predictor, scene: Scene, future: Future) -> Forecast:
    """The forecast; only privileged predictors get the future."""
    return predictor.predict(scene, future if predictor.privileged else None)


def assert_same(one: Forecast, other: Forecast, rows: np.ndarray | None = None) -> None:
    """Asserts equal bits; `rows` reorders the first forecast."""
    order = np.arange(len(one.ids)) if rows is None else rows
    for field in ("states", "actions", "actions_valid", "log_probs", "valid", "ids", "tick"):
        np.testing.assert_array_equal(getattr(one, field)[order], getattr(other, field), field)
    assert (one.features is None) == (other.features is None)
    if one.features is not None and other.features is not None:
        np.testing.assert_array_equal(one.features[order], other.features, "features")
