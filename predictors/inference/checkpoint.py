"""A trained predictor on disk: a folder with its configuration, weights and model card.

Nothing in the folder is unpickled when it is loaded.
"""

import dataclasses
import hashlib
import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError
from safetensors.torch import load_file, save
from torch import Tensor

from asp_env.data.predictor import Predictor
from asp_env.data.split import TrainedOn
from asp_env.dynamics.bicycle import Integrator
from asp_env.errors import AspEnvError, CheckpointError, unknown_name
from asp_env.files import atomic_file
from asp_env.stored import check_fields, parse_json
from asp_env.views import BinaryView, SceneView, view_from_config
from predictors.guarded import Guarded
from predictors.inference.feature_distance import FeatureDistance
from predictors.inference.model_card import model_card
from predictors.inference.pretrained import PRETRAINED, pretrained_folder, pretrained_names
from predictors.inference.trained import TrainedPredictor
from predictors.models.chaining import CHAININGS, MAX_CHAINS, Chaining
from predictors.models.network import AbstractNetwork, NetworkConfig, NetworkShape

CONFIG = "config.json"
WEIGHTS = "weights.safetensors"
CARD = "README.md"
FORMAT = 1
"""Version of the format of `config.json`."""

MAX_TICKS = 1_000
"""Largest history and horizon. Chosen by hand."""

MAX_TEMPERATURE = 1e3
"""Largest temperature; its inverse is the smallest one. Chosen by hand."""

MAX_WEIGHTS = 1 << 29
"""Largest number of weights, 2 GiB in single precision. Chosen by hand."""

HASH_DIGITS = 16
"""Hexadecimal digits of the weights' SHA-256 in tables."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PredictorSpec:
    """A kind of trained predictor: its name and the classes that a run of it is made of.

    The registry holds one for each trained predictor, see `predictors.plugs`.
    """

    name: str
    """Name in the registry."""
    config: type[NetworkConfig]
    """Configuration of the network, with values that JSON can store."""
    network: type[AbstractNetwork]
    """Network, constructed from (config, shape). The docstring of its module describes the
    predictor in model cards."""

    def from_name(self, argument: str, *, horizon: int, dt_s: float) -> Predictor:
        """Loads the predictor from the folder of a finished run.

        Args:
            argument: The folder, or `pretrained` for the weights that ship with this package, and
                optionally an @ and a chaining, for a run of several segments: `RUN@beam` (the
                default), `RUN@top1`, `RUN@full`, or the privileged `RUN@oracle`.
            horizon: Ignored; a trained predictor keeps its own.
            dt_s: Time step of the scenes to forecast.

        Raises:
            CheckpointError: The folder holds no finished run of this predictor, or there are no
                pretrained weights of it.
            AspEnvError: It was trained for another time step, or the chaining does not apply.
        """
        del horizon
        return load_trained(self, argument, dt_s=dt_s)

    def load_guarded(self, argument: str, *, horizon: int, dt_s: float) -> Predictor:
        """Loads the predictor with a guard, as `guarded:NAME:RUN`; see `predictors.guarded`.

        Args:
            argument: As for `from_name`.
            horizon: As for `from_name`.
            dt_s: As for `from_name`.

        Raises:
            CheckpointError: As `from_name`, or the run has no statistics of its features.
            AspEnvError: As `from_name`.
        """
        del horizon
        inner = load_trained(self, argument, dt_s=dt_s)
        run, _ = _split_chaining(argument)
        folder, _ = folder_and_chaining(self.name, argument)
        distance = FeatureDistance.load(
            folder, name=f"{self.name}:{run}", features=inner.network.config.features
        )
        return Guarded(inner=inner, distance=distance, integrator=_integrator(inner))


def save_trained(
    folder: Path,
    *,
    spec: PredictorSpec,
    network_config: Any,
    shape: NetworkShape,
    view: SceneView,
    weights: dict[str, Tensor],
    temperature: float,
    provenance: dict[str, Any],
) -> None:
    """Writes a predictor, which `load_trained` loads, and its model card; the configuration last.

    Args:
        folder: An existing folder.
        spec: The kind of predictor.
        network_config: An instance of `spec.config`.
        shape: The network's shape, with the normaliser.
        view: The view that it was trained on.
        weights: The network's state.
        temperature: Divisor of the logits.
        provenance: What it was trained on (`trained_on`) and how (`config`, with the recipe as
            `preset`, if any); no times of day.
    """
    config = {
        "format": FORMAT,
        "predictor": spec.name,
        "network": dataclasses.asdict(network_config),
        "view": view.config(),
        "dt_s": shape.dt_s,
        "history": shape.history,
        "horizon": shape.horizon,
        "normaliser": {"action_range": list(shape.action_range)},
        "temperature": temperature,
        "provenance": provenance,
    }
    save_weights(weights, folder / WEIGHTS)
    config["weights_sha256"] = hash_of(folder / WEIGHTS)
    config = json.loads(json.dumps(config))  # tuples become lists, as in the file
    card = model_card(config, spec.network, weights=weights_hash(folder))
    write_file(card.encode(), folder / CARD)
    write_json(config, folder / CONFIG)


def load_trained(
    spec: PredictorSpec, argument: str, *, dt_s: float | None = None
) -> TrainedPredictor:
    """Loads the predictor in the folder of a finished run.

    Args:
        spec: The expected kind of predictor.
        argument: The folder, or `pretrained`, and optionally an @ and a chaining.
        dt_s: Time step of the scenes to forecast; None for the run's own.

    Raises:
        CheckpointError: The folder is missing, damaged, or of another predictor.
        AspEnvError: It was trained for another time step, or the chaining does not apply.
    """
    if not argument:
        raise CheckpointError(
            f"predictor {spec.name} is trained: name its run as {spec.name}:RUN_DIR{_shipped(spec)}"
        )
    folder, chaining = folder_and_chaining(spec.name, argument)
    config = read_config(folder)
    if config["predictor"] != spec.name:
        raise CheckpointError(
            f"{folder} holds the predictor {_brief(repr(config['predictor']))}, not "
            f"{spec.name!r}: name it as {_brief(config['predictor'])}:{folder}"
        )
    try:
        view, network, trained_on = _build(spec, config)
        temperature = _positive("temperature", config["temperature"], most=MAX_TEMPERATURE)
        training = config["provenance"].get("config", {})
        _check_training(training, network.shape, view)
        metadata = {
            "trained_on": trained_on.source,
            "view": view.name,
            **{key: str(training[key]) for key in ("preset", "history") if key in training},
        }
    except (AttributeError, KeyError, OverflowError, RuntimeError, TypeError, ValueError) as error:
        raise CheckpointError(
            f"{folder / CONFIG} does not describe a {spec.name}: {_brief(error)}"
        ) from error
    shape = network.shape
    if dt_s is not None and abs(shape.dt_s - dt_s) > 1e-6:
        raise AspEnvError(
            f"{spec.name} in {folder} was trained for a time step of {shape.dt_s:g} s, "
            f"the scenes have {dt_s:g} s"
        )
    segments = len(network.later_ticks)
    if chaining == "full" and network.config.modes**segments > MAX_CHAINS:
        raise AspEnvError(
            f"{spec.name} in {folder} chains {segments} segments of {network.config.modes} modes: "
            f"@full would forecast more than {MAX_CHAINS} chains, take @beam"
        )
    if segments > 1:
        metadata["chaining"] = chaining or "beam"
    elif chaining is not None:
        raise AspEnvError(
            f"{spec.name} in {folder} forecasts {shape.horizon * shape.dt_s:g} s at once, there is "
            f"nothing to chain: name it without @{chaining}, as {spec.name}:{folder}"
        )
    _load_weights(network, folder / WEIGHTS)
    _check_hash(folder / WEIGHTS, config.get("weights_sha256"))
    return TrainedPredictor(
        name=spec.name,
        network=network,
        view=view,
        trained_on=trained_on,
        metadata={**metadata, "weights": weights_hash(folder)},
        temperature=temperature,
        chaining=chaining or "beam",
    )


def folder_and_chaining(predictor: str, argument: str) -> tuple[Path, Chaining | None]:
    """Splits `RUN@chaining` at the last @ and finds the run's folder.

    The name of a folder may contain an @: an existing folder is taken as a whole. The run
    `pretrained` is the predictor's pretrained weights.

    Raises:
        CheckpointError: The predictor has no pretrained weights.
        AspEnvError: The chaining is unknown.
    """
    run, chaining = _split_chaining(argument)
    return pretrained_folder(predictor) if run == PRETRAINED else Path(run), chaining


def _split_chaining(argument: str) -> tuple[str, Chaining | None]:
    before, separator, after = argument.rpartition("@")
    if not separator or Path(argument).is_dir():
        return argument, None
    for chaining in CHAININGS:
        if after == chaining:
            return before, chaining
    if before == PRETRAINED or Path(before).is_dir():
        raise unknown_name("chaining", after, CHAININGS)
    return argument, None


def _shipped(spec: PredictorSpec) -> str:
    return f", or {spec.name}:{PRETRAINED}" if spec.name in pretrained_names() else ""


def weights_hash(folder: Path) -> str:
    """The first digits of the hash of a run's weights."""
    return hash_of(folder / WEIGHTS)[:HASH_DIGITS]


def hash_of(path: Path) -> str:
    """The SHA-256 of a file's content."""
    return hashlib.sha256(path.read_bytes()).hexdigest()


def read_config(folder: Path) -> dict[str, Any]:
    """Reads `config.json` of a finished run.

    Raises:
        CheckpointError: The file is missing or damaged.
    """
    path = folder / CONFIG
    try:
        config = parse_json(path.read_bytes())
    except (FileNotFoundError, NotADirectoryError):
        raise CheckpointError(
            f"{folder} holds no trained predictor ({CONFIG} is missing): "
            "give the folder of a finished run"
        ) from None
    except (OSError, ValueError) as error:
        raise CheckpointError(f"{path} cannot be read: {_brief(error)}") from error
    if not isinstance(config, dict) or config.get("format") != FORMAT:
        raise CheckpointError(f"{path} is no checkpoint of format {FORMAT}: train again")
    if not isinstance(config.get("predictor"), str):
        raise CheckpointError(f"{path} does not name its predictor: train again")
    return config


def shape_for(view: SceneView, **numbers: Any) -> NetworkShape:
    """The shape of a network for a view.

    Args:
        view: The view.
        **numbers: The other fields of `NetworkShape`.
    """
    packed = isinstance(view, BinaryView)
    return NetworkShape(observation=view.shape, packed=packed, **numbers)


def _build(
    spec: PredictorSpec, config: dict[str, Any]
) -> tuple[SceneView, AbstractNetwork, TrainedOn]:
    view = view_from_config(config["view"])
    acceleration, steering = (
        _positive("action_range", limit) for limit in config["normaliser"]["action_range"]
    )
    shape = shape_for(
        view,
        history=_count("history", config["history"]),
        horizon=_count("horizon", config["horizon"]),
        dt_s=_positive("dt_s", config["dt_s"]),
        action_range=(acceleration, steering),
    )
    check_fields(TrainedOn, config["provenance"]["trained_on"])
    trained_on = TrainedOn(**config["provenance"]["trained_on"])
    check_fields(spec.config, config["network"])
    network_config = spec.config(**config["network"])
    with torch.device("meta"):  # shapes alone: the numbers may stand for any size
        shapes = spec.network(network_config, shape).state_dict()
    if (size := sum(map(torch.numel, shapes.values()))) > MAX_WEIGHTS:
        raise ValueError(f"a network of {size:,} weights, expected at most {MAX_WEIGHTS:,}")
    with torch.random.fork_rng(devices=[]):  # for initial weights, which are replaced
        network = spec.network(network_config, shape)
    return view, network, trained_on


def _integrator(predictor: TrainedPredictor) -> Integrator:
    """The integrator of the network's bicycle model; Heun's method for a network without one."""
    return getattr(predictor.network.config, "integrator", "heun")


def _positive(field: str, given: Any, *, most: float = math.inf) -> float:
    value = float(given)
    if not (math.isfinite(value) and value > 0):
        raise ValueError(f"{field} is {value:g}, expected a positive number")
    if not 1 / most <= value <= most:
        raise ValueError(f"{field} is {value:g}, expected {1 / most:g} to {most:g}")
    return value


def _count(field: str, given: Any) -> int:
    value = _positive(field, given)
    if value != math.floor(value) or value > MAX_TICKS:
        raise ValueError(f"{field} is {value:g}, expected a whole number up to {MAX_TICKS:,}")
    return int(value)


def _check_hash(path: Path, expected: Any) -> None:
    """Compares weights with the hash in the configuration, which older runs lack."""
    if expected is not None and hash_of(path) != expected:
        raise CheckpointError(
            f"{path} is damaged or of another run: its SHA-256 is not that in {CONFIG}; copy the "
            "run again"
        )


def _check_training(training: dict[str, Any], shape: NetworkShape, view: SceneView) -> None:
    """Refuses a view or horizon other than in training; the weights might fit nevertheless."""
    loaded = {"view": view.name, "horizon_s": round(shape.horizon * shape.dt_s, 6)}
    for field, value in loaded.items():
        if training.get(field, value) != value:
            raise ValueError(f"{field} is {value}, but it was trained with {training[field]}")


def read_weights(path: Path) -> dict[str, Tensor]:
    """Reads the weights of a finished run.

    Raises:
        CheckpointError: The file is missing or damaged, or a weight is not finite.
    """
    try:
        weights = load_file(path)
    except FileNotFoundError:
        raise CheckpointError(f"{path} is missing: the run is not complete, train again") from None
    except (OSError, ValueError, SafetensorError) as error:
        raise CheckpointError(f"{path} cannot be read: {_brief(error)}") from error
    if not all(bool(tensor.isfinite().all()) for tensor in weights.values()):
        raise CheckpointError(f"{path} holds weights that are not finite: train again")
    return weights


def _load_weights(network: AbstractNetwork, path: Path) -> None:
    try:
        network.load_state_dict(read_weights(path))
    except RuntimeError as error:
        raise CheckpointError(
            f"{path} does not fit the network of its {CONFIG}, train again: {_brief(error)}"
        ) from error


def save_weights(weights: dict[str, Tensor], path: Path) -> None:
    """Writes tensors as safetensors, atomically."""
    write_file(save({name: tensor.detach().contiguous() for name, tensor in weights.items()}), path)


def write_json(content: dict[str, Any], path: Path) -> None:
    """Writes JSON with sorted keys, atomically."""
    write_file((json.dumps(content, indent=1, sort_keys=True) + "\n").encode(), path)


def write_file(content: bytes, path: Path) -> None:
    """Writes a file atomically."""
    with atomic_file(path) as partial:
        partial.write_bytes(content)


def _brief(error: object) -> str:
    text = " ".join(str(error).split())
    return text if len(text) <= 200 else text[:197] + "..."
