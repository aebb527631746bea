"""Every predictor as the conformance suite tries it, and the situations that it is asked about.

Each that can be trained is tried on pictures and on vectors, with random weights, and what chains
segments with every chaining at 6 s; so are the recipes `ours`, on vectors. A predictor is tried by
being registered, and in the recipes if it is trained.
"""

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
from predictors.models.chaining import CHAININGS
from predictors.training.recipes import RECIPES
from tests.builders import make_recording
from tests.predictors.tiny import save_random

VIEWS = ("chauffeurnet", "vectors")
SEGMENT = 15
RECORDING = make_recording()


class Case(NamedTuple):
    """One predictor as it is tried."""

    name: str
    view: str = ""
    """Of learned ones."""
    chaining: str = ""
    """Of those that chain segments."""
    preset: str = ""
    """Of those whose recipe is not `cpu`."""

    @property
    def horizon(self) -> int:
        """Ticks that it forecasts."""
        return 2 * SEGMENT if self.chaining else SEGMENT

    @property
    def label(self) -> str:
        """What the test is called."""
        return "-".join(part for part in self if part)

    def save(self, folder: Path, *, seed: int = 0) -> str:
        """Its full name, after a folder with random weights is written if it needs one."""
        if not self.view:
            return self.name
        run = folder / self.label
        if not run.exists():
            preset = self.preset or "cpu"
            save_random(run, self.name, self.view, horizon=self.horizon, seed=seed, preset=preset)
        return f"{self.name}:{run}" + (f"@{self.chaining}" if self.chaining else "")


PHYSICAL = tuple(Case(name) for name in registry.names("predictors") if name not in RECIPES)
ONE_SEGMENT = tuple(Case(name, view) for name in RECIPES for view in VIEWS)
CHAINED = tuple(Case("ssp-asp", "vectors", chaining) for chaining in CHAININGS)
OURS = tuple(Case(name, "vectors", preset="ours") for name, of in RECIPES.items() if "ours" in of)
OURS_CHAINED = tuple(Case("ssp-asp", "vectors", chaining, "ours") for chaining in CHAININGS)
LEARNED = ONE_SEGMENT + CHAINED + OURS + OURS_CHAINED


def tried(cases: tuple[Case, ...]) -> pytest.MarkDecorator:
    """Once with each of the cases' predictors."""
    labels = [case.label for case in cases]
    return pytest.mark.parametrize("predictor", cases, ids=labels, indirect=True)


every = tried(PHYSICAL + LEARNED)


@cache
def snippets(horizon: int) -> SnippetIndex:
    """All snippets with so long a future."""
    return index_snippets([RECORDING], dt_s=0.2, horizon_s=horizon * 0.2)


def situations(predictor: Predictor, recording: Recording = RECORDING) -> tuple[Scene, Future]:
    """Scene and future of all snippets with the predictor's horizon."""
    index = snippets(predictor.horizon)
    return gather_scene([recording], index), gather_future([recording], index)


def everybody(predictor: Predictor) -> tuple[Scene, Future]:
    """Scene and future with every slot of every situation as a target, absent ones too."""
    scene, _ = situations(predictor)
    targets = np.argwhere(np.ones(scene.ids.shape, dtype=bool))
    states = np.zeros((len(targets), predictor.horizon, 4), dtype=np.float32)
    valid = np.ones((len(targets), predictor.horizon), dtype=bool)
    return scene.with_targets(targets), Future(states=states, valid=valid)


def ask(predictor: Predictor, scene: Scene, future: Future) -> Forecast:
    """The forecast; only privileged predictors are handed a future."""
    return predictor.predict(scene, future if predictor.privileged else None)


def assert_same(one: Forecast, other: Forecast, rows: np.ndarray | None = None) -> None:
    """Equal bit for bit, where the second one's rows are in another order if given."""
    order = np.arange(len(one.ids)) if rows is None else rows
    for field in ("states", "actions", "actions_valid", "log_probs", "valid", "ids", "tick"):
        np.testing.assert_array_equal(getattr(one, field)[order], getattr(other, field), field)
