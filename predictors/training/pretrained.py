"""Where a run starts from, other than from random weights."""

import hashlib
import json
from dataclasses import dataclass
from pathlib import Path

from torch import Tensor

from asp_env.data.split import TrainedOn
from asp_env.errors import CheckpointError
from asp_env.views import SceneView
from predictors.inference.checkpoint import WEIGHTS, read_config, read_weights
from predictors.models.encoders import load_resnet18
from predictors.models.network import AbstractNetwork, LearnedPlug


@dataclass(frozen=True, slots=True, kw_only=True)
class PretrainedWeights:
    """The weights of a finished run of the same predictor, or of a ResNet18."""

    path: Path
    weights_hash: str
    action_range: tuple[float, float] | None
    """The normaliser that the weights belong to; None for a ResNet18."""
    weights: dict[str, Tensor] | None
    """None for a ResNet18."""
    trained_on: TrainedOn | None
    """What the weights have seen; None for a ResNet18, which has seen other things."""

    @classmethod
    def read(
        cls, path: Path, plug: LearnedPlug, *, view: SceneView, dt_s: float
    ) -> "PretrainedWeights":
        """From the folder of a run, or a file of ResNet18 weights.

        Raises:
            CheckpointError: it is missing, damaged, or of another predictor, view or time step.
        """
        if path.is_file():
            digest = hashlib.sha256(path.read_bytes()).hexdigest()
            return cls(
                path=path, weights_hash=digest, action_range=None, weights=None, trained_on=None
            )
        config = read_config(path)
        if config["predictor"] != plug.name:
            raise CheckpointError(
                f"{path} holds the predictor {config['predictor']!r}, which {plug.name!r} cannot "
                "start from"
            )
        # Pictures of the same size may still show other things: weights would fit, and be wrong.
        if config.get("view") != json.loads(json.dumps(view.config())):
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
                f"{path} does not say its normaliser and what it learned from: train again"
            ) from error
        digest = hashlib.sha256((path / WEIGHTS).read_bytes()).hexdigest()
        return cls(
            path=path,
            weights_hash=digest,
            action_range=scale,
            weights=weights,
            trained_on=trained_on,
        )

    def apply(self, network: AbstractNetwork) -> list[str]:
        """Loads the weights that fit the network; the names of those that it keeps at random.

        A network for a longer horizon has an output of another size, and keeps that.

        Raises:
            CheckpointError: none of the encoder's weights fit.
        """
        if self.weights is None:
            load_resnet18(network, self.path)
            return []
        own = network.state_dict()
        # A follower that the run had not yet begins where its leader stands.
        followers = {f"target_{name}": value for name, value in self.weights.items()}
        weights = followers | self.weights
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
