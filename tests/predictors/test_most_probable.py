"""The most probable mode of another predictor alone."""

from pathlib import Path

import numpy as np
import pytest

from asp_env.data.predictor import feature_size, load_predictor, needs_simulation
from asp_env.data.snippets import gather_scene, index_snippets
from asp_env.errors import AspEnvError
from tests.builders import make_recording
from tests.predictors.tiny import save_random


def test_is_the_likeliest_mode_with_probability_1(tmp_path: Path) -> None:
    run = tmp_path / "run"
    save_random(run, "ffw-asp", "vectors", horizon=15, seed=0, preset="cpu")
    recordings = [make_recording()]
    index = index_snippets(recordings, dt_s=0.2, horizon_s=3.0)
    scene = gather_scene(recordings, index)
    every = load_predictor(f"ffw-asp:{run}", horizon=15, dt_s=0.2).predict(scene)
    single = load_predictor(f"most-probable:ffw-asp:{run}", horizon=15, dt_s=0.2)
    one = single.predict(scene)
    assert one.states.shape == (len(index), 1, 15, 4)
    np.testing.assert_array_equal(one.probabilities, 1.0)
    for row, mode in enumerate(every.log_probs.argmax(axis=1).tolist()):
        np.testing.assert_array_equal(one.states[row, 0], every.states[row, mode])
        np.testing.assert_array_equal(one.actions[row, 0], every.actions[row, mode])
    assert single.trained_on is not None
    assert single.metadata["view"] == "vectors"


def test_needs_the_name_of_a_predictor() -> None:
    with pytest.raises(AspEnvError, match="expected most-probable:NAME"):
        load_predictor("most-probable", horizon=15, dt_s=0.2)


def test_properties_of_many_levels_are_asked_for_once_each(monkeypatch: pytest.MonkeyPatch) -> None:
    """Twice at each of 20 levels would be a million times."""
    asked = []
    kind = type(load_predictor("constant-velocity", horizon=15, dt_s=0.2))
    for name, value in (("feature_size", 3), ("needs_simulation", True)):
        getter = property(lambda _, name=name, value=value: asked.append(name) or value)
        monkeypatch.setattr(kind, name, getter, raising=False)
    predictor = load_predictor(f"{'most-probable:' * 20}constant-velocity", horizon=15, dt_s=0.2)
    asked.clear()
    assert feature_size(predictor) == 3
    assert needs_simulation(predictor)
    assert asked == ["feature_size", "needs_simulation"]
