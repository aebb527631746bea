"""Export of a trained predictor to an ONNX file that documents itself.

Inputs and outputs are tensors of any number of targets, in the targets' frames now; the file
describes each of them, as does `docs/export.md`. The file's metadata are the run's
`config.json`, the predicted classes, and how segments are chained.
"""

import json
import logging
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from importlib.metadata import version
from pathlib import Path
from types import MappingProxyType
from typing import Any, final

import numpy as np
import onnx
import onnxruntime
import torch
from jaxtyping import config
from onnxscript import opset18
from torch import Tensor, nn

from asp_env import registry
from asp_env.data.classes import PREDICTED, AgentClass
from asp_env.errors import AspEnvError
from asp_env.views.vectors import VectorShape
from predictors.inference.checkpoint import (
    PredictorSpec,
    folder_and_chaining,
    load_trained,
    read_config,
    write_file,
)
from predictors.inference.trained import TrainedPredictor
from predictors.models.batch import Batch, VectorTensors
from predictors.models.network import Modes

OPSET = 18
"""Version of the ONNX operators."""

op: Any = opset18  # typed for tensors of files, not for those of a graph under construction

TOLERANCE = 1e-4
"""Largest difference between the file and the network, in metres, radians, m/s, m/s² and
log-probability. Chosen by hand: above rounding, below any error that matters."""

TARGETS = "targets"
"""Name of the file's dynamic axis."""

MEANINGS: Mapping[str, str] = MappingProxyType(
    {
        "picture": "The view's raster: channel, row, column; 0 to 255.",
        "picture_bits": "The view's raster: channel, row, byte of 8 columns; the first column is "
        "the highest bit (numpy.packbits along the columns).",
        "agents": "Agents of the vector view: agent (the target first), tick (the last one is "
        "now), field.",
        "agents_valid": "Mask of the valid entries of agents.",
        "lines": "Pieces of lines of the vector view: line, point, field.",
        "lines_valid": "Mask of the valid entries of lines.",
        "past_actions": "Acceleration m/s^2 and steering angle rad (left positive) between the "
        "past ticks and now; the last one ends now. From the states by the inverse bicycle model.",
        "motion": "Speed m/s, acceleration m/s^2 and yaw rate rad/s over the last tick.",
        "length_m": "Length of the vehicle, m.",
        "states": "Mode, tick ahead, and x ahead m, y left m, heading rad, speed m/s, in the frame "
        "of the target's pose now.",
        "log_probs": "Logarithm of each mode's probability.",
        "actions": "Mode, tick ahead, and acceleration m/s^2, steering angle rad.",
        "features": "What the network encodes of the target: z; for ssp-asp, z and then the "
        "predicted features at the end of the first segment.",
    }
)
"""Description of each tensor; the axes are those after the axis of targets."""

_CHECKED_TARGETS = 3
_LENGTH_M = 4.5


def write_onnx(name: str, out: Path, *, features: bool = False) -> float:
    """Writes a trained predictor to a file if onnxruntime agrees with the network.

    Args:
        name: `predictor:RUN` or `predictor:RUN@chaining`.
        out: The file, in an existing folder.
        features: Whether `features` is an output, behind the others.

    Returns:
        The largest difference between both on random inputs, at most 1e-4.

    Raises:
        AspEnvError: The predictor cannot be loaded, is not trained or is privileged, or the outputs
            differ.
    """
    kind, _, argument = name.partition(":")
    spec: Any = registry.find("predictors", kind)
    if not isinstance(spec, PredictorSpec):
        raise AspEnvError(f"predictor {kind!r} is not trained: there is no network to export")
    predictor = load_trained(spec, argument)
    if predictor.privileged:
        raise AspEnvError(
            f"{name} reads the recorded future, which users of the file do not have: take another "
            "chaining"
        )
    folder, _ = folder_and_chaining(kind, argument)
    config = read_config(folder)
    metadata = {"config": json.dumps(config, sort_keys=True)} | _metadata(predictor)
    forecaster = _Forecaster(predictor, features=features)
    content = _to_onnx(predictor, forecaster, metadata)
    difference = _largest_difference(predictor, forecaster, content)
    if not difference <= TOLERANCE:
        raise AspEnvError(
            f"{name} is not exported: onnxruntime would differ from the network by "
            f"{difference:.1g}, more than {TOLERANCE:g}"
        )
    write_file(content, out)
    return difference


def input_names(predictor: TrainedPredictor) -> tuple[str, ...]:
    """Names of the file's inputs, in order."""
    shape = predictor.network.shape
    if isinstance(shape.observation, VectorShape):
        observation = VectorTensors._fields
    else:
        observation = ("picture_bits",) if shape.packed else ("picture",)
    return (*observation, "past_actions", "motion", "length_m")


def inputs_of(batch: Batch) -> list[Tensor]:
    """The file's inputs of a batch, in order."""
    observation = batch.observation
    tensors = [observation] if isinstance(observation, Tensor) else list(observation)
    return [*tensors, batch.actions, batch.motion, batch.length_m]


def batch_of(inputs: Sequence[Tensor]) -> Batch:
    """The batch of the file's inputs."""
    *tensors, actions, motion, length_m = inputs
    return Batch(
        observation=tensors[0] if len(tensors) == 1 else VectorTensors(*tensors),
        actions=actions,
        motion=motion,
        length_m=length_m,
    )


@final
class _Forecaster(nn.Module):
    """The calibrated network as a function of tensors."""

    def __init__(self, predictor: TrainedPredictor, *, features: bool) -> None:
        super().__init__()
        self.network = predictor.network
        self._predictor = predictor
        self._features = features

    def forward(self, *inputs: Tensor) -> tuple[Tensor, ...]:
        """The outputs, computed with one more target: onnxruntime's GRU aborts without any."""
        padded = [torch.cat([each.new_zeros((1, *each.shape[1:])), each]) for each in inputs]
        return tuple(each[1:] for each in self.outputs(padded).values())

    def outputs(self, inputs: Sequence[Tensor]) -> dict[str, Tensor]:
        """The file's outputs by name, in order, without those that the network does not have."""
        modes: Modes = self._predictor.modes(batch_of(inputs))
        outputs = {"states": modes.states, "log_probs": modes.logits}
        if modes.actions is not None:
            outputs["actions"] = modes.actions
        if self._features and modes.features is not None:
            outputs["features"] = modes.features
        return outputs


def _to_onnx(
    predictor: TrainedPredictor, forecaster: _Forecaster, metadata: dict[str, str]
) -> bytes:
    names = input_names(predictor)
    inputs = _random_inputs(predictor, 2)
    with _quiet_export(), torch.no_grad():
        axis = torch.export.Dim(TARGETS)
        program = torch.export.export(
            forecaster,
            tuple(inputs),
            dynamic_shapes=(tuple({0: axis} for _ in inputs),),
        )
        exported = torch.onnx.export(
            program,
            input_names=names,
            output_names=tuple(forecaster.outputs(inputs)),
            opset_version=OPSET,
            dynamo=True,
            verbose=False,
            custom_translation_table=dict(_TRANSLATIONS),
        )
    assert exported is not None
    return _documented(exported.model_proto, metadata).SerializeToString()


def _documented(model: onnx.ModelProto, metadata: dict[str, str]) -> onnx.ModelProto:
    """Adds metadata and descriptions, and removes traces of this machine."""
    graph = model.graph
    model.producer_name, model.producer_version = "asp-env", version("asp-env")
    onnx.helper.set_model_props(model, metadata)
    axis = graph.input[0].type.tensor_type.shape.dim[0].dim_param
    for value in (*graph.input, *graph.output, *graph.value_info):
        value.ClearField("metadata_props")
        value.doc_string = MEANINGS.get(value.name, "")
        for dim in value.type.tensor_type.shape.dim:
            if dim.dim_param:  # setting it would clear a fixed size
                dim.dim_param = dim.dim_param.replace(axis, TARGETS)
    for node in (*graph.node, graph):
        node.ClearField("metadata_props")
    return model


def _metadata(predictor: TrainedPredictor) -> dict[str, str]:
    classes = [kind.name.lower() for kind in AgentClass if kind in PREDICTED]
    return {"classes": json.dumps(classes), **predictor.metadata}


def _random_inputs(predictor: TrainedPredictor, count: int) -> list[Tensor]:
    """Inputs of the right shapes, within plausible ranges."""
    rng = np.random.default_rng(0)
    shape = predictor.network.shape
    if isinstance(shape.observation, VectorShape):
        sizes = shape.observation
        agents, lines = (count, sizes.agents, sizes.ticks), (count, sizes.lines, sizes.points)
        observation = [
            rng.normal(size=(*agents, sizes.agent_fields)).astype(np.float32),
            rng.random(agents) < 0.7,
            rng.normal(size=(*lines, sizes.line_fields)).astype(np.float32),
            rng.random(lines) < 0.7,
        ]
    else:
        channels, height, width = shape.observation
        columns = -(-width // 8) if shape.packed else width
        observation = [rng.integers(256, size=(count, channels, height, columns), dtype=np.uint8)]
    limits = np.array(shape.action_range)
    motion = [
        rng.uniform(-limits, limits, size=(count, shape.history, 2)),
        rng.uniform((0, -3, -0.5), (15, 3, 0.5), size=(count, 3)),
        np.full(count, _LENGTH_M),
    ]
    arrays = (*observation, *(each.astype(np.float32) for each in motion))
    return [torch.from_numpy(array) for array in arrays]


def _largest_difference(
    predictor: TrainedPredictor, forecaster: _Forecaster, content: bytes
) -> float:
    inputs = _random_inputs(predictor, _CHECKED_TARGETS)
    session = onnxruntime.InferenceSession(content, providers=["CPUExecutionProvider"])
    named = zip(input_names(predictor), inputs, strict=True)
    outputs: Any = session.run(None, {name: tensor.numpy() for name, tensor in named})
    with torch.inference_mode():
        expected = forecaster(*inputs)
    pairs = zip(outputs, expected, strict=True)
    return max(float(np.abs(output - tensor.numpy()).max()) for output, tensor in pairs)


def _cumulative(operator: Callable[[Any, Any], Any]) -> Callable[[Any, int], tuple[Any, Any]]:
    """Cumulative minimum or maximum along an axis of fixed length, by doubling steps.

    ONNX has no such operator. The indices, the second output, are not used.
    """

    def translate(values: Any, dim: int) -> tuple[Any, Any]:
        length, step = values.shape[dim], 1
        while step < length:
            head = op.Slice(values, [0], [step], [dim])
            rest = op.Slice(values, [0], [length - step], [dim])
            values = operator(values, op.Concat(head, rest, axis=dim))
            step *= 2
        return values, values

    return translate


def _shift_right(values: Any, places: int) -> Any:
    """Right shift of unsigned bytes; the exporter's own translation treats them as signed."""
    count = op.CastLike(op.Constant(value_int=places), values)
    return op.BitShift(values, count, direction="RIGHT")


_TRANSLATIONS: Mapping[Any, Callable[..., Any]] = MappingProxyType(
    {
        torch.ops.aten.cummin.default: _cumulative(op.Min),
        torch.ops.aten.cummax.default: _cumulative(op.Max),
        torch.ops.aten.__rshift__.Scalar: _shift_right,
    }
)


@contextmanager
def _quiet_export() -> Iterator[None]:
    """Disables runtime checks of shapes, which would fix the dynamic axis, and warnings.

    The exporter warns of packages that are not needed here, and of its own deprecations.
    """
    checks, logs = config.jaxtyping_disable, logging.root.manager.disable
    config.update("jaxtyping_disable", True)
    logging.disable(logging.WARNING)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        logging.disable(logs)
        config.update("jaxtyping_disable", checks)
