"""Networks that train in a second: of every trainable predictor, for every view."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from asp_env import registry
from asp_env.data.recording import Recording
from asp_env.data.snippets import index_snippets
from asp_env.views import RasterView, make_view, with_history
from predictors.inference.checkpoint import PredictorSpec, save_trained, shape_for
from predictors.inference.feature_distance import FeatureDistance
from predictors.models.batch import Batch, Labels
from predictors.models.network import AbstractNetwork, NetworkConfig, NetworkShape
from predictors.training.data import Batches
from predictors.training.recipes import TrainingConfig, recipe
from tests.builders import make_recording
from tests.data.levelx_files import write_map, write_recording

PIXELS = (36, 24)
RANGE = (4.0, 0.5)

SIZES = {"features": 8, "hidden": 8, "gru_width": 8, "gru_layers": 1}
"""Values of those fields in every network's configuration that has them and sets them."""


def pixels_of(view: str) -> tuple[int, int] | None:
    """Height and width of the rasters of a view in tests."""
    drawn = make_view(view)
    if not isinstance(drawn, RasterView):
        return None
    _, height, width = drawn.shape
    return (36, 36 * width // height)


def tiny_network(
    predictor: str, view: str = "chauffeurnet", *, preset: str = "cpu", **changes: Any
) -> NetworkConfig:
    """The network's configuration of a recipe with `SIZES` and further changes."""
    config = recipe(predictor, preset, view=view, horizon_s=3.0).network
    small: dict[str, Any] = {n: size for n, size in SIZES.items() if getattr(config, n, 0)}
    small["encoder"] = "vector" if pixels_of(view) is None else "small"
    return dataclasses.replace(config, **{**small, **changes})


def tiny_config(
    predictor: str = "ffw-asp", view: str = "chauffeurnet", **changes: Any
) -> TrainingConfig:
    """The recipe `cpu` with four epochs of three batches of eight 36x24 rasters."""
    config = recipe(predictor, "cpu", view=view, horizon_s=3.0)
    config = dataclasses.replace(
        config,
        network=tiny_network(predictor, view),
        pixels=pixels_of(view),
        epochs=4 - config.pretraining_epochs,
        snippets_per_epoch=24,
        batch_size=8,
    )
    return dataclasses.replace(config, **changes)


def tiny_shape(view: str = "chauffeurnet", horizon: int = 15, history: int = 15) -> NetworkShape:
    """The shape of a network for small rasters, or for vectors."""
    drawn = with_history(make_view(view, pixels=pixels_of(view)), history)
    return shape_for(drawn, history=history, horizon=horizon, dt_s=0.2, action_range=RANGE)


def make_network(
    predictor: str, config: NetworkConfig, shape: NetworkShape, *, seed: int = 0
) -> AbstractNetwork:
    """A network with random weights; torch's global generator is unchanged."""
    spec: PredictorSpec = registry.find("predictors", predictor)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        return spec.network(config, shape)


def draw_samples(
    rows: Sequence[int],
    *,
    view: str = "chauffeurnet",
    horizon_s: float = 3.0,
    later_ticks: Sequence[int] = (),
    recording: Recording | None = None,
) -> tuple[Batch, Labels]:
    """Some snippets of the synthetic crossing as one batch."""
    recordings = [make_recording() if recording is None else recording]
    index = index_snippets(recordings, dt_s=0.2, horizon_s=horizon_s)
    batches = Batches(
        recordings,
        index.select(np.array(rows)),
        view=make_view(view, pixels=pixels_of(view)),
        batch_size=len(rows),
        later_ticks=later_ticks,
    )
    return next(iter(batches))


def write_data(folder: Path, *, recordings: int = 3, cars: int = 4) -> str:
    """Writes recordings of 12 s in the format of inD and returns the folder's name."""
    for number in range(recordings):
        write_recording(
            folder, number=number, classes=("car",) * cars + ("pedestrian",), num_frames=300
        )
    write_map(folder)
    return str(folder)


def save_random(
    folder: Path,
    predictor: str = "ffw-asp",
    view: str = "chauffeurnet",
    *,
    horizon: int = 15,
    seed: int = 0,
    preset: str = "cpu",
    temperature: float = 1.0,
    history: int = 15,
    **changes: Any,
) -> Path:
    """Writes a checkpoint of a tiny network with random weights and returns the folder.

    The network differs from the recipe's by `SIZES` and `changes`.
    """
    spec: PredictorSpec = registry.find("predictors", predictor)
    config = tiny_network(predictor, view, preset=preset, **changes)
    shape = tiny_shape(view, horizon, history)
    network = make_network(predictor, config, shape, seed=seed)
    folder.mkdir(parents=True)
    save_trained(
        folder,
        spec=spec,
        network_config=config,
        shape=shape,
        view=with_history(make_view(view, pixels=pixels_of(view)), history),
        weights=network.state_dict(),
        temperature=temperature,
        provenance={
            "trained_on": {"source": "nothing", "split": "recording", "parts": {}},
            "config": {"preset": "tiny"},
        },
    )
    return folder


def save_distance(run: Path, *, threshold: float = 2.5) -> FeatureDistance:
    """Adds statistics of features to a tiny run: the distance from zero over a threshold."""
    size = SIZES["features"]
    distance = FeatureDistance(mean=np.zeros(size), whitening=np.eye(size), threshold=threshold)
    distance.save(run)
    return distance
