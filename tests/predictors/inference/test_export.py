"""ONNX files say what the predictors say that they were made of, and explain themselves."""

import itertools
import json
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnxruntime
import pytest
import torch

from asp_env import registry
from asp_env.cli import main
from asp_env.data.scene import Scene
from asp_env.data.snippets import gather_scene, index_snippets
from asp_env.geometry import from_frame, wrap_angle
from predictors.inference import export as onnx_file
from predictors.inference.checkpoint import load_trained
from predictors.inference.export import input_names, inputs_of, write_onnx
from predictors.inference.trained import TrainedPredictor
from predictors.models.batch import make_batch
from predictors.models.network import PredictorSpec
from predictors.training.recipes import RECIPES
from tests.builders import make_recording
from tests.predictors.tiny import save_random

VIEWS = ("chauffeurnet", "vectors", "mtp")
SEGMENT = 15
CASES = [
    *((name, view, SEGMENT, "cpu") for name, view in zip(sorted(RECIPES), itertools.cycle(VIEWS))),
    *(("ssp-asp", "vectors", 2 * SEGMENT, preset) for preset in ("cpu", "ours")),
]
"""Every trainable predictor; between them every kind of view; and segments chained by beam, kept as
they are or merged."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Exported:
    """A file and what it was made of."""

    path: Path
    run: Path
    predictor: TrainedPredictor

    def says(self, batch_inputs: list[torch.Tensor]) -> list[np.ndarray]:
        """What onnxruntime makes of some inputs."""
        session = onnxruntime.InferenceSession(self.path, providers=["CPUExecutionProvider"])
        named = zip(input_names(self.predictor), batch_inputs, strict=True)
        said: Any = session.run(None, {name: tensor.numpy() for name, tensor in named})
        return said


@pytest.fixture(scope="module", params=CASES, ids=["-".join(map(str, case)) for case in CASES])
def exported(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Exported:
    """One export of each case."""
    name, view, horizon, preset = request.param
    folder = tmp_path_factory.mktemp("exported")
    run = save_random(folder / "run", name, view, horizon=horizon, preset=preset, temperature=1.7)
    write_onnx(f"{name}:{run}", folder / "file.onnx")
    plug: PredictorSpec = registry.find("predictors", name)
    predictor = load_trained(plug, str(run))
    return Exported(path=folder / "file.onnx", run=run, predictor=predictor)


def scene() -> Scene:
    """Twenty situations of the made-up crossing, in some of which vehicles brake or wait."""
    recording = [make_recording()]
    index = index_snippets(recording, dt_s=0.2, horizon_s=3.0)
    return gather_scene(recording, index.select(np.linspace(0, len(index) - 1, 20).astype(int)))


def test_onnxruntime_says_what_the_predictor_says(exported: Exported) -> None:
    """States, probabilities and actions of 20 targets, moved back into the world, to 1e-4."""
    expected = exported.predictor.predict(scene())
    batch = make_batch(scene(), exported.predictor.view, exported.predictor.history)
    states, log_probs, *actions = exported.says(inputs_of(batch))
    now = scene().target_states.astype(np.float64)[:, None, None]
    xy = from_frame(states[..., :2].astype(np.float64), now)
    np.testing.assert_allclose(xy, expected.states[..., :2], atol=1e-4)
    turned = wrap_angle(states[..., 2] + now[..., 2] - expected.states[..., 2])
    np.testing.assert_allclose(turned, 0, atol=1e-4)
    np.testing.assert_allclose(states[..., 3], expected.states[..., 3], atol=1e-4)
    np.testing.assert_allclose(log_probs, expected.log_probs, atol=1e-4)
    assert len(actions) == expected.actions_valid.all()
    for found in actions:
        np.testing.assert_allclose(found, expected.actions, atol=1e-4)


def test_whoever_stands_does_not_roll_back(exported: Exported) -> None:
    """One target at 0.1 m/s: speeds of 0 or more, the network's own to 1e-4."""
    batch = make_batch(scene(), exported.predictor.view, exported.predictor.history)
    inputs = [tensor[:1].clone() for tensor in inputs_of(batch)]
    inputs[-2][:] = torch.tensor([0.1, 0.0, 0.0])
    with torch.inference_mode():
        expected = exported.predictor.modes(onnx_file.batch_of(inputs))
    states, *_ = exported.says(inputs)
    assert states[..., 3].min() >= 0
    np.testing.assert_allclose(states, expected.states.numpy(), atol=1e-4)


def test_file_explains_itself(exported: Exported) -> None:
    """The run's configuration, the classes, and a sentence on every tensor; no machine's paths."""
    model = onnx.load(exported.path)
    onnx.checker.check_model(model)
    told = {entry.key: entry.value for entry in model.metadata_props}
    assert json.loads(told["config"]) == json.loads((exported.run / "config.json").read_text())
    assert json.loads(told["classes"])[0] == "car"
    assert told["weights"] == exported.predictor.metadata["weights"]
    assert told.get("chaining") == exported.predictor.metadata.get("chaining")
    tensors = [*model.graph.input, *model.graph.output]
    assert [tensor.name for tensor in model.graph.input] == list(input_names(exported.predictor))
    batch = make_batch(scene(), exported.predictor.view, exported.predictor.history)
    arrays = [*inputs_of(batch), *exported.says(inputs_of(batch))]
    for tensor, array in zip(tensors, arrays, strict=True):
        assert tensor.doc_string, tensor.name
        first, *others = tensor.type.tensor_type.shape.dim
        assert first.dim_param == "targets"
        assert [dim.dim_value for dim in others] == list(array.shape[1:])
    assert str(Path(onnx_file.__file__).parents[1]).encode() not in exported.path.read_bytes()


def test_a_file_that_says_something_else_is_not_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """A difference of 1 to the network is refused, and nothing is left in the folder."""
    run = save_random(tmp_path / "run", "mtp", "mtp")
    monkeypatch.setattr(onnx_file, "_to_onnx", lambda *_: b"")
    monkeypatch.setattr(onnx_file, "_largest_difference", lambda *_: 1.0)
    line = refused(capsys, f"mtp:{run}", tmp_path / "file.onnx")
    assert "would differ from the network by 1" in line
    assert [path.name for path in tmp_path.iterdir()] == ["run"]


def test_bad_input_is_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """What is not trained, not there, or in the way is refused, and nothing is written."""
    out = tmp_path / "file.onnx"
    assert "'constant-velocity' is not trained" in refused(capsys, "constant-velocity", out)
    assert "name its run as dkm:RUN_DIR" in refused(capsys, "dkm", out)
    assert "holds no trained predictor" in refused(capsys, f"dkm:{tmp_path}", out)
    run = save_random(tmp_path / "run", "ssp-asp", horizon=2 * SEGMENT)
    assert "holds the predictor 'ssp-asp'" in refused(capsys, f"dkm:{run}", out)
    assert "unknown chaining 'fast'" in refused(capsys, f"ssp-asp:{run}@fast", out)
    assert "reads the recorded future" in refused(capsys, f"ssp-asp:{run}@oracle", out)
    assert "is no folder" in refused(capsys, f"ssp-asp:{run}", tmp_path / "none" / "file.onnx")
    assert "exists: give another" in refused(capsys, f"ssp-asp:{run}", run / "config.json")
    assert not out.exists()


def test_missing_package_names_the_extra(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Without onnx the line says what to install."""
    monkeypatch.setitem(sys.modules, "onnx", None)
    monkeypatch.delitem(sys.modules, "predictors.inference.export")
    line = refused(capsys, "dkm:run", tmp_path / "file.onnx")
    assert "needs the package 'onnx'" in line
    assert "asp-env[export]" in line


def refused(capsys: pytest.CaptureFixture[str], predictor: str, out: Path) -> str:
    """The one line that `asp-env export` refuses its input with."""
    assert main(["export", predictor, "--out", str(out)]) == 2
    told = capsys.readouterr()
    assert told.err.count("\n") == 1
    return told.err
