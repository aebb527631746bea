"""Weights that a run starts from instead of random ones."""

import hashlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from torch import Tensor

from asp_env.data.split import TrainedOn
from asp_env.errors import AspEnvError, CheckpointError
from asp_env.views import SceneView, view_from_config
from predictors.inference.checkpoint import WEIGHTS, PredictorSpec, read_config, read_weights
from predictors.models.encoders import load_resnet18
from predictors.models.network import AbstractNetwork


@dataclass(frozen=True, slots=True, kw_only=True)
class InitialWeights:
    """The weights of a finished run of the same predictor, or of a ResNet18."""

    path: Path
    weights_hash: str
    action_range: tuple[float, float] | None
    """The normaliser that the weights belong to; None for a ResNet18."""
    weights: dict[str, Tensor] | None
    """None for a ResNet18, whose file is read later."""
    trained_on: TrainedOn | None
    """The recordings that the weights were trained on; None for a ResNet18."""

    @classmethod
    def read(
        cls, path: Path, spec: PredictorSpec, *, view: SceneView, dt_s: float
    ) -> "InitialWeights":
        """Reads the folder of a run; a file is taken for ResNet18 weights.

        Args:
            path: The folder or the file.
            spec: The kind of predictor that is trained.
            view: Its view.
            dt_s: Its time step.

        Raises:
            CheckpointError: The run is missing, damaged, or of another predictor, view or time
                step.
        """
        if path.is_file():
            return cls(
                path=path,
                weights_hash=file_hash(path),
                action_range=None,
                weights=None,
                trained_on=None,
            )
        config = read_config(path)
        if config["predictor"] != spec.name:
            raise CheckpointError(
                f"{path} holds the predictor {config['predictor']!r}, which {spec.name!r} cannot "
                "start from"
            )
        # Rasters of the same size may show other things: the weights would fit, and be wrong.
        if not _is_view(config.get("view"), view):
            raise CheckpointError(
                f"{path} has another view than this run: start from one of the same"
            )
        if config.get("dt_s") != dt_s:
            raise CheckpointError(
                f"{path} was trained for a time step of {config.get('dt_s')} s, not of {dt_s:g} s"
            )
        weights = read_weights(path / WEIGHTS)
        try:
            acceleration, steering = config["normaliser"]["action_range"]
            scale = (float(acceleration), float(steering))
            trained_on = TrainedOn(**config["provenance"]["trained_on"])
        except (KeyError, TypeError, ValueError) as error:
            raise CheckpointError(
                f"{path} does not name its normaliser and its training data: train again"
            ) from error
        return cls(
            path=path,
            weights_hash=file_hash(path / WEIGHTS),
            action_range=scale,
            weights=weights,
            trained_on=trained_on,
        )

    def apply(self, network: AbstractNetwork) -> list[str]:
        """Loads the weights that fit the network.

        A network for a longer horizon may have an output of another size, which is not loaded.

        Returns:
            The names of the weights that were not loaded.

        Raises:
            CheckpointError: The encoder's weights do not fit.
        """
        if self.weights is None:
            load_resnet18(network, self.path)
            return []
        own = network.state_dict()
        # A second encoder that the earlier run had not starts as a copy of the first.
        copies = {f"target_{name}": value for name, value in self.weights.items()}
        weights = copies | self.weights
        fitting = {
            name: value
            for name, value in weights.items()
            if name in own and own[name].shape == value.shape
        }
        encoder = {name for name in own if name.startswith("encoder.")}
        if not encoder <= set(fitting):
            raise CheckpointError(
                f"{self.path} has another encoder than this run: start from one of the same"
            )
        network.load_state_dict(fitting, strict=False)
        return sorted(set(own) - set(fitting))


def _is_view(config: Any, view: SceneView) -> bool:
    """Whether a stored configuration, which may lack newer options, describes a view."""
    try:
        return view_from_config(config) == view
    except (AspEnvError, AttributeError, TypeError, ValueError):
        return False


def file_hash(path: Path) -> str:
    """The SHA-256 of a file of weights."""
    return hashlib.sha256(path.read_bytes()).hexdigest()
