"""A view of another package: it renders, trains, is found again, is exported, and drives."""

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest

from asp_env import ReplayEnv
from asp_env.cli import main
from asp_env.data.predictor import load_predictor
from asp_env.data.scene import Scene
from asp_env.data.signals import SceneSignals, SignalState
from asp_env.data.snippets import gather_scene, index_snippets
from asp_env.errors import AspEnvError
from asp_env.views import ChauffeurNet, make_view
from predictors.inference.onnx_file import TOLERANCE, write_onnx
from predictors.training import recipes
from predictors.training.fitting import train
from tests.data.test_signals import with_signal
from tests.predictors.tiny import tiny_config, write_data
from tests.views.own_view import OWN, register_own_view
from tests.views.scenes import make_scene, standing


@pytest.fixture(autouse=True)
def own_view(monkeypatch: pytest.MonkeyPatch) -> None:
    register_own_view(monkeypatch)


def lit(state: SignalState) -> Scene:
    """A car at the origin, 10 m before a stop line across its lane of 4 m."""
    scene = make_scene(standing([(0.0, 0.0, 0.0)]))
    states = np.zeros((1, 1, scene.history + 1), dtype=np.int8)
    states[..., -1] = state
    lines = np.array([[[[10.0, 2.0], [10.0, -2.0]]]])
    return dataclasses.replace(scene, signals=SceneSignals(stop_lines=lines, states=states))


@pytest.mark.parametrize(
    ("state", "channel"),
    [(SignalState.RED, 0), (SignalState.AMBER, 1), (SignalState.GREEN, 2)],
)
def test_the_stop_line_is_drawn_in_the_channel_of_its_state(
    state: SignalState, channel: int
) -> None:
    """5 pixels per metre, the target at row 288 and column 120: 10 m ahead is row 238.

    The line is 0.8 m wide and its ends extend by half of that: rows 236 to 239, columns 108 to 131.
    """
    drawn = make_view(OWN).render(lit(state))[0]
    assert drawn.shape == (15, 360, 240)
    np.testing.assert_array_equal(drawn[:12], ChauffeurNet().render(lit(state))[0])
    expected = np.zeros((3, 360, 240), dtype=np.uint8)
    expected[channel, 236:240, 108:132] = 255
    np.testing.assert_array_equal(drawn[12:], expected)


def test_unknown_states_and_absent_targets_show_no_signals() -> None:
    assert not make_view(OWN).render(lit(SignalState.UNKNOWN))[0, 12:].any()
    scene = lit(SignalState.RED)
    scene.valid[0, 0, -1] = False
    assert not make_view(OWN).render(scene).any()


def test_an_environment_observes_it_by_its_name() -> None:
    """The sample has no signals, so that their channels are empty."""
    env = ReplayEnv(observations=(OWN, "chauffeurnet"))
    seen, _ = env.reset(seed=0)
    assert seen in env.observation_space
    np.testing.assert_array_equal(seen[OWN][:12], seen["chauffeurnet"])
    assert not seen[OWN][12:].any()


def test_recipes_take_its_own_resolution() -> None:
    """A quarter of 360x240 at small size, its full size in the recipe of the paper."""
    small = recipes.recipe("ffw-asp", "cpu", view=OWN, horizon_s=3.0)
    assert (small.view, small.pixels, small.network.encoder) == (OWN, (90, 60), "small")
    paper = recipes.recipe("ffw-asp", "paper", view=OWN, horizon_s=3.0)
    assert (paper.pixels, paper.network.encoder) == (None, "resnet18")


def test_it_trains_and_is_found_again_and_exported_and_drives(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    data = write_data(tmp_path / "data")
    run = train(tiny_config("ffw-asp", OWN, epochs=1), data, tmp_path / "run")
    config = json.loads((run / "config.json").read_text())
    assert config["view"] == make_view(OWN, pixels=(36, 24)).config()
    predictor = load_predictor(f"ffw-asp:{run}", horizon=15, dt_s=0.2)
    assert predictor.metadata["view"] == OWN

    index = index_snippets([with_signal()], dt_s=0.2, horizon_s=3.0)
    forecast = predictor.predict(gather_scene([with_signal()], index))
    assert forecast.valid.all()
    dark = predictor.predict(
        dataclasses.replace(gather_scene([with_signal()], index), signals=None)
    )
    assert not np.array_equal(forecast.states, dark.states)  # the network sees the signal

    assert write_onnx(f"ffw-asp:{run}", tmp_path / "own.onnx") <= TOLERANCE
    folder = tmp_path / "driven"
    options = ["--max-scenarios", "1", "--part", "all", "--out", str(folder)]
    assert main(["drive", "sample:intersection", "--predictors", f"ffw-asp:{run}", *options]) == 0
    assert (folder / "metrics.csv").exists()

    monkeypatch.undo()  # the package that registers the view is uninstalled
    with pytest.raises(AspEnvError, match=f"unknown view '{OWN}'.*known are chauffeurnet, "):
        load_predictor(f"ffw-asp:{run}", horizon=15, dt_s=0.2)


@pytest.mark.parametrize(
    ("code", "message"),
    [
        ("raise RuntimeError('out of order')", "own_broken:View .RuntimeError: out of order."),
        ("View = 3", r"view 'broken': the registered object 3 has no make\(pixels\)"),
        (
            "from asp_env.views import ChauffeurNet as View",
            "view 'broken' has the name 'chauffeurnet', under which a stored run would not find",
        ),
        (
            "class View:\n    def make(pixels=None): return 3\n    from_config = make",
            "view 'broken': int lacks a part of SceneView",
        ),
    ],
    ids=["raises", "no plug", "other name", "no view"],
)
def test_broken_views_give_one_clear_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, code: str, message: str
) -> None:
    """Other views are not affected, nor is the list of names."""
    (tmp_path / "own_broken.py").write_text(code)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(__import__("sys").modules, "own_broken", raising=False)
    register_own_view(monkeypatch, "own_broken:View", "broken")
    with pytest.raises(AspEnvError, match=message) as caught:
        make_view("broken")
    assert "\n" not in str(caught.value)
    with pytest.raises(AspEnvError, match="known are actions, chauffeurnet, "):
        ReplayEnv(observations=("nothing",))
    assert make_view("mtp").name == "mtp"
