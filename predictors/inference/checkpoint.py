"""A trained predictor's folder: configuration, weights and model card. Nothing is unpickled."""

import dataclasses
import hashlib
import json
import math
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError
from safetensors.torch import load_file, save
from torch import Tensor

from asp_env.data.split import TrainedOn
from asp_env.errors import AspEnvError, CheckpointError, unknown_name
from asp_env.files import atomic_file, remove_stale
from asp_env.views import BinaryView, SceneView, view_from_config
from predictors.inference.model_card import model_card
from predictors.inference.trained import TrainedPredictor
from predictors.models.chaining import CHAININGS, Chaining
from predictors.models.network import AbstractNetwork, LearnedPlug, NetworkShape
from predictors.models.ssp_asp import SSPASPNetwork

CONFIG = "config.json"
WEIGHTS = "weights.safetensors"
CARD = "README.md"
FORMAT = 1

HASH_DIGITS = 16
"""Hexadecimal digits of the weights' SHA-256 that tables show."""


def save_learned(
    folder: Path,
    *,
    plug: LearnedPlug,
    network_config: Any,
    shape: NetworkShape,
    view: SceneView,
    weights: dict[str, Tensor],
    temperature: float,
    provenance: dict[str, Any],
) -> None:
    """Writes a predictor that `load_learned` loads, and its card; the configuration last.

    Args:
        folder: an existing folder.
        plug: of which predictor this is.
        network_config: an instance of the plug's configuration.
        shape: what the network was made for, with the normaliser.
        view: what it looks at.
        weights: the network's state.
        temperature: what its logits are to be divided by.
        provenance: what it was trained on (`trained_on`) and how (`config`, with its `preset`
            if it has one); no times of day.
    """
    config = {
        "format": FORMAT,
        "predictor": plug.name,
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
    config = json.loads(json.dumps(config))  # as whoever reads it will find it
    card = model_card(config, plug, weights=weights_hash(folder))
    _write(card.encode(), folder / CARD)
    write_json(config, folder / CONFIG)


def load_learned(
    plug: LearnedPlug, argument: str, *, dt_s: float | None = None
) -> TrainedPredictor:
    """The predictor in a finished run's folder.

    Args:
        plug: of which predictor it must be.
        argument: the folder, and behind an @ how segments are chained, if not by beam.
        dt_s: the time step of the scenes to come; None takes the run's own.

    Raises:
        CheckpointError: it is missing, damaged, or of another predictor.
        AspEnvError: it was trained for another time step, or does not chain as is asked.
    """
    if not argument:
        raise CheckpointError(
            f"predictor {plug.name} is trained: name its run as {plug.name}:RUN_DIR"
        )
    folder, chaining = folder_and_chaining(argument)
    config = read_config(folder)
    if config["predictor"] != plug.name:
        raise CheckpointError(
            f"{folder} holds the predictor {config['predictor']!r}, not {plug.name!r}: "
            f"name it as {config['predictor']}:{folder}"
        )
    try:
        view, network, trained_on = _build(plug, config)
        temperature = _positive("temperature", config["temperature"])
        training = config["provenance"].get("config", {})
        _check_training(training, network.shape, view)
        about = {
            "trained_on": trained_on.source,
            "view": view.name,
            **{key: str(training[key]) for key in ("preset", "history") if key in training},
        }
    except (AttributeError, KeyError, OverflowError, RuntimeError, TypeError, ValueError) as error:
        raise CheckpointError(
            f"{folder / CONFIG} does not describe a {plug.name}: {_brief(error)}"
        ) from error
    shape = network.shape
    if dt_s is not None and abs(shape.dt_s - dt_s) > 1e-6:
        raise AspEnvError(
            f"{plug.name} in {folder} was trained for a time step of {shape.dt_s:g} s, "
            f"the scenes have {dt_s:g} s"
        )
    if len(network.later_ticks) > 1:
        about["chaining"] = chaining or "beam"
    elif chaining is not None:
        raise AspEnvError(
            f"{plug.name} in {folder} forecasts {shape.horizon * shape.dt_s:g} s at once, there is "
            f"nothing to chain: name it without @{chaining}, as {plug.name}:{folder}"
        )
    _load_weights(network, folder / WEIGHTS)
    calm = network.merging_temperature if isinstance(network, SSPASPNetwork) else None
    if chaining == "full" and calm is not None:  # the other temperature is that of merged chains
        temperature = float(calm)
    return TrainedPredictor(
        name=plug.name,
        network=network,
        view=view,
        trained_on=trained_on,
        about={**about, "weights": weights_hash(folder)},
        temperature=temperature,
        chaining=chaining or "beam",
    )


def folder_and_chaining(argument: str) -> tuple[Path, Chaining | None]:
    """What stands before and behind the last @ of `RUN@chaining`.

    A folder may have an @ in its own name: one that exists is taken as a whole.

    Raises:
        AspEnvError: there is no such chaining.
    """
    before, at, behind = argument.rpartition("@")
    if not at or Path(argument).is_dir():
        return Path(argument), None
    for chaining in CHAININGS:
        if behind == chaining:
            return Path(before), chaining
    if Path(before).is_dir():
        raise unknown_name("chaining", behind, CHAININGS)
    return Path(argument), None


def weights_hash(folder: Path) -> str:
    """The first digits of the hash of a run's weights, as tables show them."""
    return hashlib.sha256((folder / WEIGHTS).read_bytes()).hexdigest()[:HASH_DIGITS]


def read_config(folder: Path) -> dict[str, Any]:
    """What `config.json` of a finished run says.

    Raises:
        CheckpointError: it is missing or damaged.
    """
    path = folder / CONFIG
    try:
        config = json.loads(path.read_text())
    except FileNotFoundError:
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
    """The shape of a network that looks at a view; the other fields by name."""
    packed = isinstance(view, BinaryView)
    return NetworkShape(seen=view.shape, packed=packed, **numbers)


def _build(
    plug: LearnedPlug, config: dict[str, Any]
) -> tuple[SceneView, AbstractNetwork, TrainedOn]:
    view = view_from_config(config["view"])
    acceleration, steering = (
        _positive("action_range", limit) for limit in config["normaliser"]["action_range"]
    )
    shape = shape_for(
        view,
        history=int(_positive("history", config["history"])),
        horizon=int(_positive("horizon", config["horizon"])),
        dt_s=_positive("dt_s", config["dt_s"]),
        action_range=(acceleration, steering),
    )
    trained_on = TrainedOn(**config["provenance"]["trained_on"])
    with torch.random.fork_rng(devices=[]):  # initial weights are drawn and at once replaced
        network = plug.network(plug.config(**config["network"]), shape)
    return view, network, trained_on


def _positive(field: str, given: Any) -> float:
    value = float(given)
    if not (math.isfinite(value) and value > 0):
        raise ValueError(f"{field} is {value:g}, expected a positive number")
    return value


def _check_training(training: dict[str, Any], shape: NetworkShape, view: SceneView) -> None:
    """Weights may fit a network of another view or horizon that they were not trained for."""
    found = {"view": view.name, "horizon_s": round(shape.horizon * shape.dt_s, 6)}
    for field, value in found.items():
        if training.get(field, value) != value:
            raise ValueError(f"{field} is {value}, but it was trained with {training[field]}")


def read_weights(path: Path) -> dict[str, Tensor]:
    """The tensors of a finished run.

    Raises:
        CheckpointError: they are missing, damaged, or not finite.
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
    """Writes tensors atomically."""
    _write(save({name: tensor.detach().contiguous() for name, tensor in weights.items()}), path)


def write_json(content: dict[str, Any], path: Path) -> None:
    """Writes JSON atomically."""
    _write((json.dumps(content, indent=1, sort_keys=True) + "\n").encode(), path)


def _write(content: bytes, path: Path) -> None:
    with atomic_file(path) as partial:
        partial.write_bytes(content)
    remove_stale(path)


def _brief(error: BaseException) -> str:
    words = " ".join(str(error).split())
    return words if len(words) <= 200 else words[:197] + "..."
