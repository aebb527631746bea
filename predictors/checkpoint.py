"""A trained predictor's folder: `config.json` and `weights.safetensors`. Nothing is unpickled."""

import dataclasses
import hashlib
import json
import os
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError
from safetensors.torch import load_file, save
from torch import Tensor

from asp_env.data.parts import TrainedOn
from asp_env.errors import AspEnvError, CheckpointError, unknown_name
from asp_env.views import BinaryView, SceneView, view_from_config
from predictors.chaining import CHAININGS
from predictors.learned import Learned
from predictors.network import AbstractNetwork, LearnedPlug, NetworkShape

CONFIG = "config.json"
WEIGHTS = "weights.safetensors"
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
    """Writes a predictor that `load_learned` loads; the configuration last, so never half.

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
    write_json(config, folder / CONFIG)


def load_learned(
    plug: LearnedPlug, argument: str, *, dt_s: float, chaining: str = "beam"
) -> Learned:
    """The predictor in a finished run's folder.

    Raises:
        CheckpointError: it is missing, damaged, or of another predictor.
        AspEnvError: it was trained for another time step, or there is no such chaining.
    """
    if chaining not in CHAININGS:
        raise unknown_name("chaining", chaining, CHAININGS)
    if not argument:
        raise CheckpointError(
            f"predictor {plug.name} is trained: name its run as {plug.name}:RUN_DIR"
        )
    folder = Path(argument)
    config = read_config(folder)
    if config["predictor"] != plug.name:
        raise CheckpointError(
            f"{folder} holds the predictor {config['predictor']!r}, not {plug.name!r}: "
            f"name it as {config['predictor']}:{folder}"
        )
    try:
        view, network, trained_on = _build(plug, config)
        temperature = float(config["temperature"])
        training = config["provenance"].get("config", {})
    except (KeyError, TypeError, ValueError, RuntimeError) as error:
        raise CheckpointError(
            f"{folder / CONFIG} does not describe a {plug.name}: {_brief(error)}"
        ) from error
    shape = network.shape
    if abs(shape.dt_s - dt_s) > 1e-6:
        raise AspEnvError(
            f"{plug.name} in {folder} was trained for a time step of {shape.dt_s:g} s, "
            f"the scenes have {dt_s:g} s"
        )
    _load_weights(network, folder / WEIGHTS)
    about = {
        "trained_on": trained_on.source,
        "view": view.name,
        **{key: str(training[key]) for key in ("preset", "history") if key in training},
        **({"chaining": chaining} if len(network.later_ticks) > 1 else {}),
        "weights": hashlib.sha256((folder / WEIGHTS).read_bytes()).hexdigest()[:HASH_DIGITS],
    }
    return Learned(
        name=plug.name,
        network=network,
        view=view,
        trained_on=trained_on,
        about=about,
        temperature=temperature,
        chaining=chaining,
    )


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
    acceleration, steering = config["normaliser"]["action_range"]
    shape = shape_for(
        view,
        history=int(config["history"]),
        horizon=int(config["horizon"]),
        dt_s=float(config["dt_s"]),
        action_range=(float(acceleration), float(steering)),
    )
    trained_on = TrainedOn(**config["provenance"]["trained_on"])
    with torch.random.fork_rng(devices=[]):  # initial weights are drawn and at once replaced
        network = plug.network(plug.config(**config["network"]), shape)
    return view, network, trained_on


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
            f"{path} does not fit the network of its {CONFIG}: {_brief(error)}"
        ) from error


def save_weights(weights: dict[str, Tensor], path: Path) -> None:
    """Writes tensors aside, then renames."""
    _write(save({name: tensor.detach().contiguous() for name, tensor in weights.items()}), path)


def write_json(content: dict[str, Any], path: Path) -> None:
    """Writes JSON aside, then renames."""
    _write((json.dumps(content, indent=1, sort_keys=True) + "\n").encode(), path)


def _write(content: bytes, path: Path) -> None:
    aside = path.with_name(path.name + ".part")
    aside.write_bytes(content)
    os.replace(aside, path)


def _brief(error: BaseException) -> str:
    words = " ".join(str(error).split())
    return words if len(words) <= 200 else words[:197] + "..."
