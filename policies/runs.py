"""Run folders of policies, without pickles.

| file | content |
|---|---|
| `config.json` | `settings` (`PolicySettings`), `observation` (shape, type and bounds of each \
entry), `predictor` (name and hash of the weights), `steps` of training |
| `policy.safetensors` | weights of the policy, written at the end of the training |
| `checkpoint.safetensors` | during the training: weights, states of the optimizers, statistics of \
the rewards |
| `progress.csv`, `events…` | training statistics as a table, and for TensorBoard; \
`progress-N.csv` those of the first N steps of a resumed training |
"""

import dataclasses
import json
import math
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from safetensors import SafetensorError
from safetensors.torch import load, save
from stable_baselines3 import PPO, SAC
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.policies import BasePolicy, MultiInputActorCriticPolicy
from stable_baselines3.sac.policies import MultiInputPolicy as SACPolicy
from torch import Tensor, nn

from asp_env.data.predictor import Predictor
from asp_env.errors import AspEnvError, MissingExtraError
from asp_env.files import atomic_file, write_text
from asp_env.stored import brief, parse_json
from policies.networks import RasterFeatures, TrafficFeatures
from policies.settings import CONFIG, PolicySettings, read_settings

POLICY = "policy.safetensors"
CHECKPOINT = "checkpoint.safetensors"

CHECKSUM = "checksum"
"""Name of the tensor with the checksum of the others in a file."""

MAX_ENTRY = 10_000_000
"""Largest number of values of an entry of an observation, which bounds the memory. Chosen by
hand."""

LOG_STD = -1.0
"""Logarithm of the deviation of actions at the start. Chosen by hand: that of stable-baselines3, 0,
accelerates and steers at the limits a third of the time."""


@dataclass(frozen=True, slots=True, kw_only=True)
class AlgorithmClasses:
    """The class of an algorithm in stable-baselines3 or sb3-contrib, and that of its policy."""

    algorithm: type[BaseAlgorithm]
    policy: type[BasePolicy]


def algorithm_classes(name: str) -> AlgorithmClasses:
    """The classes of an algorithm.

    Args:
        name: one of `policies.settings.ALGORITHMS`.

    Raises:
        MissingExtraError: the algorithm needs sb3-contrib, which is not installed.
    """
    if name == "sac":
        return AlgorithmClasses(algorithm=SAC, policy=SACPolicy)
    if name in ("ppo", "bc"):
        return AlgorithmClasses(algorithm=PPO, policy=MultiInputActorCriticPolicy)
    try:
        from sb3_contrib import RecurrentPPO  # pyright: ignore[reportMissingImports]
        from sb3_contrib.ppo_recurrent.policies import (  # pyright: ignore[reportMissingImports]
            RecurrentMultiInputActorCriticPolicy,
        )
    except ModuleNotFoundError as error:
        raise MissingExtraError(str(error.name), "rl", f"the algorithm {name}") from error
    return AlgorithmClasses(algorithm=RecurrentPPO, policy=RecurrentMultiInputActorCriticPolicy)


def policy_arguments(settings: PolicySettings) -> dict[str, Any]:
    """Arguments of the policy's class, besides spaces and learning rate.

    Args:
        settings: the settings of the policy.
    """
    extractor: dict[str, Any] = {"width": settings.width}
    kind: type[nn.Module] = TrafficFeatures
    if settings.environment.view is not None:
        kind = RasterFeatures
        if settings.encoder is not None:
            from policies.encoders import trained_encoder

            extractor["encoder"] = trained_encoder(settings.encoder, settings.environment)
    arguments: dict[str, Any] = {
        "features_extractor_class": kind,
        "features_extractor_kwargs": extractor,
        "net_arch": [64, 64],
        "activation_fn": nn.ReLU,
    }
    if settings.algorithm != "sac":
        arguments["log_std_init"] = LOG_STD
    if settings.algorithm == "recurrent-ppo":
        arguments["lstm_hidden_size"] = settings.width
    return arguments


class TrainedPolicy:
    """A trained policy: acts on observations, without an environment."""

    def __init__(self, settings: PolicySettings, space: spaces.Dict, policy: BasePolicy) -> None:
        """Holds a policy.

        Args:
            settings: the settings of the policy.
            space: space of its observation.
            policy: its policy.
        """
        self.settings, self.space, self._policy = settings, space, policy
        self._memory: Any = None

    def act(
        self, observations: Mapping[str, np.ndarray], starts: np.ndarray | None = None
    ) -> np.ndarray:
        """The most probable actions (B, 2) in [-1, 1], float32.

        Args:
            observations: reduced observations (`policies.observations`) of B environments.
            starts: (B,) bool, which episodes begin now; only recurrent policies read it.
        """
        for name, box in self.space.items():
            if name not in observations or observations[name].shape[1:] != box.shape:
                given = getattr(observations.get(name), "shape", "none")
                raise AspEnvError(
                    f"observation {name!r}: expected shape (B, *{box.shape}) as in training, got "
                    f"{given}"
                )
        if starts is not None and starts.all():
            self._memory = None
        shown = {name: observations[name] for name in self.space.spaces}
        actions, self._memory = self._policy.predict(
            shown, state=self._memory, episode_start=starts, deterministic=True
        )
        if not np.isfinite(actions).all():
            raise AspEnvError("a policy's action is not finite, so its weights are damaged")
        return np.asarray(actions, dtype=np.float32)


def load_policy(folder: Path) -> TrainedPolicy:
    """Loads a trained policy.

    Raises:
        AspEnvError: there is no finished run, or a file is damaged.
    """
    settings = read_settings(folder)
    content = parse_json((folder / CONFIG).read_bytes())
    space = _read_space(content, folder)
    weights = read_tensors(folder / POLICY)
    kind, arguments = algorithm_classes(settings.algorithm).policy, policy_arguments(settings)
    try:
        policy = kind(
            observation_space=space,
            action_space=action_space(),
            lr_schedule=_no_learning,
            **arguments,
        )
    except (KeyError, IndexError, RuntimeError, TypeError, ValueError) as error:
        raise _other_observation(folder, error) from None
    try:
        policy.load_state_dict(weights)
    except RuntimeError as error:
        raise AspEnvError(
            f"{folder / POLICY}: does not fit {CONFIG} ({str(error).splitlines()[-1].strip()}); "
            "train the policy again"
        ) from None
    policy.set_training_mode(False)
    _check_space(policy, space, folder)
    return TrainedPolicy(settings, space, policy)


def _check_space(policy: BasePolicy, space: spaces.Dict, folder: Path) -> None:
    """Checks that the observation in `config.json` is what the network reads: it acts once.

    Raises:
        AspEnvError: it is not.
    """
    zeros = {name: np.zeros((1, *box.shape), box.dtype) for name, box in space.items()}  # pyright: ignore[reportOptionalIterable, reportCallIssue, reportArgumentType]
    try:
        policy.predict(zeros, episode_start=np.ones(1, dtype=bool), deterministic=True)
    except (KeyError, IndexError, RuntimeError, TypeError, ValueError) as error:
        raise _other_observation(folder, error) from None


def _other_observation(folder: Path, error: Exception) -> AspEnvError:
    return AspEnvError(
        f"{folder / CONFIG}: damaged, its observation is not that of the network "
        f"({type(error).__name__}: {brief(error)}); train the policy again"
    )


def _no_learning(left: float | int) -> float:
    del left
    return 0.0


def action_space() -> spaces.Box:
    """The action space of all environments."""
    return spaces.Box(-1.0, 1.0, (2,), dtype=np.float32)


def save_config(
    folder: Path,
    settings: PolicySettings,
    space: spaces.Dict,
    predictor: Predictor | None,
    steps: int,
) -> None:
    """Writes `config.json`.

    Args:
        folder: the run folder.
        settings: the settings of the policy.
        space: space of its observation.
        predictor: the predictor whose forecasts are observed.
        steps: steps of training so far.
    """
    boxes: dict[str, Any] = {}
    for name, box in space.items():
        assert isinstance(box, spaces.Box)
        low, high = float(box.low.min()), float(box.high.max())
        boxes[name] = {"shape": list(box.shape), "dtype": str(box.dtype)}
        if np.isfinite([low, high]).all():
            boxes[name] |= {"low": low, "high": high}
    content = {
        "settings": dataclasses.asdict(settings),
        "observation": boxes,
        "predictor": predictor_identity(predictor),
        "steps": steps,
    }
    write_text(folder / CONFIG, json.dumps(content, indent=1))


def predictor_identity(predictor: Predictor | None) -> dict[str, str] | None:
    """What a run states about its predictor: its name and, if trained, the hash of its weights."""
    if predictor is None:
        return None
    return {"name": predictor.name, "weights": predictor.metadata.get("weights", "")}


def check_predictor(folder: Path, predictor: Predictor | None) -> None:
    """Checks that a predictor is the one that a policy was trained with.

    Args:
        folder: the run folder of the policy.
        predictor: the predictor that is to provide its forecasts.

    Raises:
        AspEnvError: it is another one, or has other weights.
    """
    try:
        trained_with = parse_json((folder / CONFIG).read_bytes())["predictor"]
        if trained_with is not None:
            trained_with = {key: str(trained_with[key]) for key in ("name", "weights")}
    except (OSError, KeyError, TypeError, ValueError) as error:
        raise AspEnvError(
            f"{folder / CONFIG}: damaged ({brief(error)}); train the policy again"
        ) from None
    given = predictor_identity(predictor)
    if trained_with != given:
        raise AspEnvError(
            f"{folder}: trained with {_identity_text(trained_with)}, given "
            f"{_identity_text(given)}; give the same, or train another policy"
        )


def _identity_text(identity: Mapping[str, str] | None) -> str:
    if identity is None:
        return "no predictor"
    weights = identity["weights"]
    return f"predictor {identity['name']}" + (f" (weights {weights})" if weights else "")


def _read_space(content: Any, folder: Path) -> spaces.Dict:
    try:
        for name, box in content["observation"].items():
            if not 0 < math.prod(box["shape"]) <= MAX_ENTRY:
                raise ValueError(f"{name} of shape {box['shape']}")
            bounds = np.array([box.get("low", 0.0), box.get("high", 0.0)], dtype=np.float64)
            if not (np.abs(bounds) <= np.finfo(np.float32).max).all():
                raise ValueError(f"{name} within {bounds.tolist()}")
        return spaces.Dict(
            {
                name: spaces.Box(
                    box.get("low", -np.inf),
                    box.get("high", np.inf),
                    tuple(box["shape"]),
                    dtype=np.dtype(box["dtype"]).type,
                )
                for name, box in content["observation"].items()
            }
        )
    except (KeyError, TypeError, ValueError, AttributeError, OverflowError) as error:
        raise AspEnvError(
            f"{folder / CONFIG}: damaged ({type(error).__name__}: {brief(error)}); train the "
            "policy again"
        ) from None


def read_tensors(path: Path) -> dict[str, Tensor]:
    """Reads a safetensors file.

    Raises:
        AspEnvError: there is no such file, or it is damaged.
    """
    try:
        tensors = load(path.read_bytes())
        checksum = tensors.pop(CHECKSUM, None)  # older runs have none
        if checksum is not None and not torch.equal(checksum, _checksum(tensors)):
            raise SafetensorError("its checksum differs")
        return tensors
    except FileNotFoundError:
        raise AspEnvError(
            f"{path}: missing, the training has not ended; resume it with asp-env rl train --resume"
        ) from None
    except (OSError, SafetensorError) as error:
        raise AspEnvError(f"{path}: damaged ({brief(error)}); train the policy again") from None


def write_tensors(path: Path, tensors: Mapping[str, Tensor]) -> None:
    """Writes a safetensors file with a checksum, atomically."""
    plain = {name: value.detach().cpu().contiguous().clone() for name, value in tensors.items()}
    content = save(plain | {CHECKSUM: _checksum(plain)})
    with atomic_file(path) as partial:
        partial.write_bytes(content)


def _checksum(tensors: Mapping[str, Tensor]) -> Tensor:
    """The CRC-32 of the names and the content of some tensors."""
    value = 0
    for name in sorted(tensors):
        value = zlib.crc32(name.encode(), value)
        value = zlib.crc32(_bytes(tensors[name]), value)
    return torch.tensor([value], dtype=torch.int64)


def _bytes(tensor: Tensor) -> bytes:
    return tensor.contiguous().reshape(-1).view(torch.uint8).numpy().tobytes()


def flatten_state(state: Mapping[Any, Any], prefix: str) -> dict[str, Tensor]:
    """Flattens nested state dictionaries of tensors and numbers; names are joined by `/`.

    Args:
        state: nested dictionaries and lists; other values than tensors and numbers are left out.
        prefix: start of all names.
    """
    flat: dict[str, Tensor] = {}
    for key, value in state.items():
        name = f"{prefix}/{key}"
        if isinstance(value, Mapping):
            flat |= flatten_state(value, name)
        elif isinstance(value, Tensor):
            flat[name] = value
    return flat


def restore_optimizer(
    optimizer: torch.optim.Optimizer, tensors: Mapping[str, Tensor], prefix: str
) -> None:
    """Restores the moments of an optimizer from flattened names.

    Args:
        optimizer: the optimizer of the same parameters.
        tensors: what `flatten_state` returned.
        prefix: start of the optimizer's names.
    """
    state: dict[int, dict[str, Tensor]] = {}
    start = f"{prefix}/state/"
    for name, value in tensors.items():
        if name.startswith(start):
            number, _, key = name.removeprefix(start).partition("/")
            state.setdefault(int(number), {})[key] = value
    full = optimizer.state_dict()
    full["state"] = state
    optimizer.load_state_dict(full)
