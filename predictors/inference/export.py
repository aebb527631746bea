"""A trained predictor as an ONNX file that says all that its user must know.

Inputs and outputs are tensors of any number of targets, each in its own frame now; what they hold
stands beside each of them in the file, and in `docs/predictors.md`. The file's metadata are the
run's `config.json`, the classes that are predicted, and how segments are chained.

MERGED: The command `asp-env export`.
"""

import json
import logging
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, Any, final

import numpy as np
import onnx
import onnxruntime
import torch
import tyro
from jaxtyping import config
from onnxscript import opset18
from rich.console import Console
from torch import Tensor, nn

from asp_env import registry
from asp_env.data.classes import PREDICTED, AgentClass
from asp_env.errors import AspEnvError, MissingExtraError
from asp_env.files import atomic_file
from asp_env.views.vectors import VectorShape
from predictors.inference.checkpoint import folder_and_chaining, load_learned, read_config
from predictors.inference.trained import TrainedPredictor
from predictors.models.batch import Batch, VectorTensors
from predictors.models.network import LearnedPlug

OPSET = 18
op: Any = opset18  # its types know tensors of files, not those of a graph being made
TOLERANCE = 1e-4
"""How far the file may be from the network, in metres, radians, m/s, m/s² and log-probability."""

TARGETS = "targets"
"""What the file calls its open axis."""

MEANINGS: Mapping[str, str] = MappingProxyType(
    {
        "picture": "The view's picture: channel, row, column; 0 to 255.",
        "picture_bits": "The view's picture: channel, row, byte of 8 columns; the first column is "
        "the highest bit (numpy.packbits along the columns).",
        "agents": "Agents of the vector view: agent (the target first), tick (now last), field.",
        "agents_valid": "Which of them are there.",
        "lines": "Pieces of lines of the vector view: line, point, field.",
        "lines_valid": "Which of them are there.",
        "past_actions": "Acceleration m/s^2 and steering angle rad (left positive) between the "
        "past ticks and now, the last one ends now: from the states by the inverse bicycle model.",
        "motion": "Speed m/s, acceleration m/s^2 and yaw rate rad/s over the last tick.",
        "length_m": "Length of the vehicle, m.",
        "states": "Mode, tick ahead, and x ahead m, y left m, heading rad, speed m/s, in the frame "
        "of the target's pose now.",
        "log_probs": "Logarithm of each mode's probability.",
        "actions": "Mode, tick ahead, and acceleration m/s^2, steering angle rad.",
    }
)
"""What each tensor holds, after the axis of targets."""

_CHECKED_TARGETS = 3
_LENGTH_M = 4.5


def write_onnx(name: str, out: Path) -> float:
    """Writes a trained predictor to a file, if onnxruntime then says what the network says.

    Args:
        name: `predictor:RUN` or `predictor:RUN@chaining`.
        out: the file, in an existing folder.

    Returns:
        The largest difference between both on random inputs, at most 1e-4.

    Raises:
        AspEnvError: the predictor cannot be loaded, is not trained, knows the future, or the file
            would say something else.
    """
    kind, _, argument = name.partition(":")
    plug: Any = registry.find("predictors", kind)
    if not isinstance(plug, LearnedPlug):
        raise AspEnvError(f"predictor {kind!r} is not trained: there is no network to export")
    predictor = load_learned(plug, argument)
    if predictor.privileged:
        raise AspEnvError(
            f"{name} reads the recorded future, which users of the file do not have: take another "
            "chaining"
        )
    folder, _ = folder_and_chaining(argument)
    config = read_config(folder)
    content = _to_onnx(
        predictor, {"config": json.dumps(config, sort_keys=True)} | _about(predictor)
    )
    difference = _largest_difference(predictor, content)
    if not difference <= TOLERANCE:
        raise AspEnvError(
            f"{name} is not exported: onnxruntime would differ from the network by "
            f"{difference:.1g}, more than {TOLERANCE:g}"
        )
    with atomic_file(out) as partial:
        partial.write_bytes(content)
    return difference


def input_names(predictor: TrainedPredictor) -> tuple[str, ...]:
    """Of the file's inputs, in order."""
    shape = predictor.network.shape
    if isinstance(shape.seen, VectorShape):
        seen = VectorTensors._fields
    else:
        seen = ("picture_bits",) if shape.packed else ("picture",)
    return (*seen, "past_actions", "motion", "length_m")


def inputs_of(batch: Batch) -> list[Tensor]:
    """A batch as the file takes it."""
    seen = [batch.seen] if isinstance(batch.seen, Tensor) else list(batch.seen)
    return [*seen, batch.actions, batch.motion, batch.length_m]


def batch_of(inputs: Sequence[Tensor]) -> Batch:
    """What the file takes, as a batch."""
    *seen, actions, motion, length_m = inputs
    return Batch(
        seen=seen[0] if len(seen) == 1 else VectorTensors(*seen),
        actions=actions,
        motion=motion,
        length_m=length_m,
    )


@final
class _Forecaster(nn.Module):
    """Tensors in, tensors out."""

    def __init__(self, predictor: TrainedPredictor) -> None:
        super().__init__()
        self.network = predictor.network
        self._predictor = predictor

    def forward(self, *inputs: Tensor) -> tuple[Tensor, ...]:
        modes = self._predictor.modes(batch_of(inputs))
        said = (modes.states, modes.logits)
        return said if modes.actions is None else (*said, modes.actions)


def _to_onnx(predictor: TrainedPredictor, metadata: dict[str, str]) -> bytes:
    names = input_names(predictor)
    inputs = _random_inputs(predictor, 2)
    with _undisturbed(), torch.no_grad():
        axis = torch.export.Dim(TARGETS)
        program = torch.export.export(
            _Forecaster(predictor),
            tuple(inputs),
            dynamic_shapes=(tuple({0: axis} for _ in inputs),),
        )
        outputs = ("states", "log_probs", "actions")[: len(program.graph_signature.user_outputs)]
        exported = torch.onnx.export(
            program,
            input_names=names,
            output_names=outputs,
            opset_version=OPSET,
            dynamo=True,
            verbose=False,
            custom_translation_table=dict(_TRANSLATIONS),
        )
    assert exported is not None
    return _described(exported.model_proto, metadata).SerializeToString()


def _described(model: onnx.ModelProto, metadata: dict[str, str]) -> onnx.ModelProto:
    """With what a user must know, and without what only tells of this machine."""
    graph = model.graph
    model.producer_name, model.producer_version = "asp-env", version("asp-env")
    onnx.helper.set_model_props(model, metadata)
    axis = graph.input[0].type.tensor_type.shape.dim[0].dim_param
    for value in (*graph.input, *graph.output, *graph.value_info):
        value.ClearField("metadata_props")
        value.doc_string = MEANINGS.get(value.name, "")
        for dim in value.type.tensor_type.shape.dim:
            if dim.dim_param:  # setting it takes a number away
                dim.dim_param = dim.dim_param.replace(axis, TARGETS)
    for node in (*graph.node, graph):
        node.ClearField("metadata_props")
    return model


def _about(predictor: TrainedPredictor) -> dict[str, str]:
    classes = [kind.name.lower() for kind in AgentClass if kind in PREDICTED]
    return {"classes": json.dumps(classes), **predictor.metadata}


def _random_inputs(predictor: TrainedPredictor, count: int) -> list[Tensor]:
    """Inputs of the right kind, in a range that a target may have."""
    random = np.random.default_rng(0)
    shape = predictor.network.shape
    if isinstance(shape.seen, VectorShape):
        s = shape.seen
        agents, lines = (count, s.agents, s.ticks), (count, s.lines, s.points)
        seen = [
            random.normal(size=(*agents, s.agent_fields)).astype(np.float32),
            random.random(agents) < 0.7,
            random.normal(size=(*lines, s.line_fields)).astype(np.float32),
            random.random(lines) < 0.7,
        ]
    else:
        channels, height, width = shape.seen
        columns = -(-width // 8) if shape.packed else width
        seen = [random.integers(256, size=(count, channels, height, columns), dtype=np.uint8)]
    range_ = np.array(shape.action_range)
    known = [
        random.uniform(-range_, range_, size=(count, shape.history, 2)),
        random.uniform((0, -3, -0.5), (15, 3, 0.5), size=(count, 3)),
        np.full(count, _LENGTH_M),
    ]
    return [torch.from_numpy(each) for each in (*seen, *(k.astype(np.float32) for k in known))]


def _largest_difference(predictor: TrainedPredictor, content: bytes) -> float:
    inputs = _random_inputs(predictor, _CHECKED_TARGETS)
    session = onnxruntime.InferenceSession(content, providers=["CPUExecutionProvider"])
    named = zip(input_names(predictor), inputs, strict=True)
    found: Any = session.run(None, {name: tensor.numpy() for name, tensor in named})
    with torch.inference_mode():
        expected = _Forecaster(predictor)(*inputs)
    pairs = zip(found, expected, strict=True)
    return max(float(np.abs(one - other.numpy()).max()) for one, other in pairs)


def _accumulated(of: Callable[[Any, Any], Any]) -> Callable[[Any, int], tuple[Any, Any]]:
    """Running minimum or maximum along an axis of known length, in steps of 1, 2, 4 and so on.

    ONNX knows none. The indices, the second output, are read by nobody.
    """

    def translate(values: Any, dim: int) -> tuple[Any, Any]:
        length, step = values.shape[dim], 1
        while step < length:
            head = op.Slice(values, [0], [step], [dim])
            rest = op.Slice(values, [0], [length - step], [dim])
            values = of(values, op.Concat(head, rest, axis=dim))
            step *= 2
        return values, values

    return translate


def _shift_right(values: Any, places: int) -> Any:
    """Of bytes without sign; the exporter's own version takes them for signed ones."""
    number = op.CastLike(op.Constant(value_int=places), values)
    return op.BitShift(values, number, direction="RIGHT")


_TRANSLATIONS: Mapping[Any, Callable[..., Any]] = MappingProxyType(
    {
        torch.ops.aten.cummin.default: _accumulated(op.Min),
        torch.ops.aten.cummax.default: _accumulated(op.Max),
        torch.ops.aten.__rshift__.Scalar: _shift_right,
    }
)


@contextmanager
def _undisturbed() -> Iterator[None]:
    """No checks of shapes at run time, which would fix the open axis, and no advice.

    The exporter warns of packages that nothing here needs, and of its own deprecations.
    """
    checked, logged = config.jaxtyping_disable, logging.root.manager.disable
    config.update("jaxtyping_disable", True)
    logging.disable(logging.WARNING)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        logging.disable(logged)
        config.update("jaxtyping_disable", checked)


@dataclass(frozen=True, slots=True, kw_only=True)
class Export:
    """Write a trained predictor as an ONNX file, which runs without this package."""

    predictor: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="PREDICTOR:RUN")]
    """A trained one with its folder, such as ssp-asp:runs/1 or ssp-asp:runs/1@top1."""
    out: Path
    """File to write; must not exist."""

    def run(self) -> None:
        """Exports, checks the file against the network it was made of, and writes it.

        Raises:
            AspEnvError: the predictor cannot be loaded or is not trained, or the file exists.
        """
        if self.out.exists():
            raise AspEnvError(f"{self.out} exists: give another --out, or delete it")
        if not self.out.parent.is_dir():
            raise AspEnvError(f"{self.out.parent} is no folder: make it, or give another --out")
        try:
            from predictors.inference.export import write_onnx
        except ModuleNotFoundError as error:
            raise MissingExtraError(str(error.name), "export", "export to ONNX") from error

        difference = write_onnx(self.predictor, self.out)
        Console().print(
            f"wrote {self.out}: as the network to {difference:.0e} on random inputs", soft_wrap=True
        )
