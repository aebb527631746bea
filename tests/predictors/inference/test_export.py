"""ONNX files agree with the exported predictors and document themselves."""

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
from predictors.inference import onnx_file
from predictors.inference.checkpoint import PredictorSpec, load_trained
from predictors.inference.onnx_file import input_names, inputs_of, write_onnx
from predictors.inference.pretrained import PRETRAINED, pretrained_folder
from predictors.inference.trained import TrainedPredictor
from predictors.models.batch import make_batch
from predictors.training.recipes import RECIPES
from tests.builders import make_recording
from tests.predictors.tiny import save_random

SEGMENT = 5
CASES = {
    "dkm": {"view": "chauffeurnet"},
    "mtp": {"view": "mtp"},
    "ffw-asp:pretrained": {},
    "ssp-asp:pretrained": {},
    "ssp-asp: two segments": {"horizon": 2 * SEGMENT, "segment_s": 1.0},
    "ssp-asp: two segments, merged, unrolled": {
        "horizon": 2 * SEGMENT, "segment_s": 1.0, "preset": "ours", "decoder": "unrolled",
    },
}  # fmt: skip
"""Predictors and changes of what `save_random` saves: every trainable predictor and kind of view,
the shipped weights, chains of segments that are merged or not, and unrolled decoders. Features are
left out of one file. Segments of 1 s are exported in a third of the time of 3 s."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Exported:
    """A file and the predictor that it was exported from."""

    path: Path
    run: Path
    predictor: TrainedPredictor
    features: bool
    """Whether features are the last output."""

    def outputs(self, batch_inputs: list[torch.Tensor]) -> list[np.ndarray]:
        """Outputs of onnxruntime."""
        session = onnxruntime.InferenceSession(self.path, providers=["CPUExecutionProvider"])
        named = zip(input_names(self.predictor), batch_inputs, strict=True)
        outputs: Any = session.run(None, {name: tensor.numpy() for name, tensor in named})
        return outputs


@pytest.fixture(scope="module", params=CASES)
def exported(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Exported:
    """One export of each case."""
    name, _, about = request.param.partition(":")
    folder = tmp_path_factory.mktemp("exported")
    if about == PRETRAINED:
        run = pretrained_folder(name)
    else:
        options: Any = {"view": "vectors", "horizon": SEGMENT, "preset": "cpu"}
        options |= CASES[request.param]
        run = save_random(folder / "run", name, temperature=1.7, **options)
    features = about != " two segments"
    difference = write_onnx(f"{name}:{run}", folder / "file.onnx", features=features)
    assert difference <= 1e-4
    spec: PredictorSpec = registry.find("predictors", name)
    predictor = load_trained(spec, str(run))
    return Exported(path=folder / "file.onnx", run=run, predictor=predictor, features=features)


def scene() -> Scene:
    """Twenty situations of the synthetic crossing, in some of which vehicles brake or wait."""
    recording = [make_recording()]
    index = index_snippets(recording, dt_s=0.2, horizon_s=3.0)
    return gather_scene(recording, index.select(np.linspace(0, len(index) - 1, 20).astype(int)))


def test_every_trainable_predictor_is_exported() -> None:
    assert {case.partition(":")[0] for case in CASES} == set(RECIPES)


def test_onnxruntime_agrees_with_the_predictor(exported: Exported) -> None:
    """States, probabilities, actions and features of 20 targets, to 1e-4."""
    expected = exported.predictor.predict(scene())
    batch = make_batch(scene(), exported.predictor.view, exported.predictor.history)
    states, log_probs, *others = exported.outputs(inputs_of(batch))
    now = scene().target_states.astype(np.float64)[:, None, None]
    xy = from_frame(states[..., :2].astype(np.float64), now)
    np.testing.assert_allclose(xy, expected.states[..., :2], atol=1e-4)
    heading_error = wrap_angle(states[..., 2] + now[..., 2] - expected.states[..., 2])
    np.testing.assert_allclose(heading_error, 0, atol=1e-4)
    np.testing.assert_allclose(states[..., 3], expected.states[..., 3], atol=1e-4)
    np.testing.assert_allclose(log_probs, expected.log_probs, atol=1e-4)
    named = [expected.actions] * bool(expected.actions_valid.all())
    if exported.features:
        assert expected.features is not None
        named.append(expected.features)
    for each, value in zip(others, named, strict=True):
        np.testing.assert_allclose(each, value, atol=1e-4)


def test_no_targets_give_empty_outputs(exported: Exported) -> None:
    """Arrays of no rows, each in the shape that one target has."""
    batch = make_batch(scene(), exported.predictor.view, exported.predictor.history)
    one = exported.outputs([tensor[:1] for tensor in inputs_of(batch)])
    none = exported.outputs([tensor[:0] for tensor in inputs_of(batch)])
    assert [each.shape for each in none] == [(0, *each.shape[1:]) for each in one]


def test_standing_target_has_no_negative_speed(exported: Exported) -> None:
    """One target at 0.1 m/s: speeds are not negative and agree with the network to 1e-4."""
    batch = make_batch(scene(), exported.predictor.view, exported.predictor.history)
    inputs = [tensor[:1].clone() for tensor in inputs_of(batch)]
    inputs[-2][:] = torch.tensor([0.1, 0.0, 0.0])
    with torch.inference_mode():
        expected = exported.predictor.modes(onnx_file.batch_of(inputs))
    states, *_ = exported.outputs(inputs)
    assert states[..., 3].min() >= 0
    np.testing.assert_allclose(states, expected.states.numpy(), atol=1e-4)


def test_file_documents_itself(exported: Exported) -> None:
    """The run's configuration, the classes, and a description of every tensor; no local paths."""
    model = onnx.load(exported.path)
    onnx.checker.check_model(model)
    metadata = {entry.key: entry.value for entry in model.metadata_props}
    assert json.loads(metadata["config"]) == json.loads((exported.run / "config.json").read_text())
    assert json.loads(metadata["classes"])[0] == "car"
    assert metadata["weights"] == exported.predictor.metadata["weights"]
    assert metadata.get("chaining") == exported.predictor.metadata.get("chaining")
    tensors = [*model.graph.input, *model.graph.output]
    actions = ["actions"] * (not exported.predictor.name.startswith("mtp"))
    assert [tensor.name for tensor in model.graph.output] == [
        *("states", "log_probs", *actions), *["features"] * exported.features,
    ]  # fmt: skip
    assert [tensor.name for tensor in model.graph.input] == list(input_names(exported.predictor))
    batch = make_batch(scene(), exported.predictor.view, exported.predictor.history)
    arrays = [*inputs_of(batch), *exported.outputs(inputs_of(batch))]
    for tensor, array in zip(tensors, arrays, strict=True):
        assert tensor.doc_string, tensor.name
        first, *rest = tensor.type.tensor_type.shape.dim
        assert first.dim_param == "targets"
        assert [dim.dim_value for dim in rest] == list(array.shape[1:])
    assert str(Path(onnx_file.__file__).parents[1]).encode() not in exported.path.read_bytes()


def test_a_file_that_differs_is_not_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """A difference of 1 is refused, and nothing is left in the folder."""
    run = save_random(tmp_path / "run", "mtp", "mtp")
    monkeypatch.setattr(onnx_file, "_to_onnx", lambda *_: b"")
    monkeypatch.setattr(onnx_file, "_largest_difference", lambda *_: 1.0)
    line = refused(capsys, f"mtp:{run}", tmp_path / "file.onnx")
    assert "would differ from the network by 1" in line
    assert [path.name for path in tmp_path.iterdir()] == ["run"]


def test_bad_input_is_refused_in_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A predictor that is not trained, a missing or wrong run, a bad chaining, and a bad file."""
    out = tmp_path / "file.onnx"
    assert "'constant-velocity' is not trained" in refused(capsys, "constant-velocity", out)
    assert "name its run as dkm:RUN_DIR" in refused(capsys, "dkm", out)
    assert "holds no trained predictor" in refused(capsys, f"dkm:{tmp_path}", out)
    run = save_random(tmp_path / "run", "ssp-asp", horizon=30)
    assert "holds the predictor 'ssp-asp'" in refused(capsys, f"dkm:{run}", out)
    assert "unknown chaining 'fast'" in refused(capsys, f"ssp-asp:{run}@fast", out)
    assert "reads the recorded future" in refused(capsys, f"ssp-asp:{run}@oracle", out)
    assert "is no folder" in refused(capsys, f"ssp-asp:{run}", tmp_path / "none" / "file.onnx")
    assert "exists: give another" in refused(capsys, f"ssp-asp:{run}", run / "config.json")
    assert not out.exists()


def test_missing_package_names_the_extra(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "onnx", None)
    monkeypatch.delitem(sys.modules, "predictors.inference.onnx_file")
    line = refused(capsys, "dkm:run", tmp_path / "file.onnx")
    assert "needs the package 'onnx'" in line
    assert "asp-env[export]" in line


def refused(capsys: pytest.CaptureFixture[str], predictor: str, out: Path) -> str:
    """The error of `asp-env export`, one line."""
    assert main(["export", predictor, "--out", str(out)]) == 2
    err = capsys.readouterr().err
    assert err.count("\n") == 1
    return err
