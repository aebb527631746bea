"""A network so small that it trains in a second."""

import dataclasses
from pathlib import Path

import torch

from asp_env.views import make_view
from predictors.checkpoint import save_learned
from predictors.ffw_asp import FFWASP, FFWASPConfig
from predictors.learned import NetworkShape
from predictors.recipes import TrainingConfig, recipe
from tests.data.levelx_files import write_map, write_recording

NETWORK = FFWASPConfig(
    encoder="small", features=8, gru_width=8, gru_layers=1, skip=True, hidden=8, integrator="heun"
)


def tiny_config(**changes: object) -> TrainingConfig:
    """The `cpu` recipe with four epochs of three batches of eight 36x24 rasters."""
    config = dataclasses.replace(
        recipe("ffw-asp", "cpu", view="chauffeurnet", horizon_s=3.0),
        network=NETWORK,
        height_px=36,
        width_px=24,
        epochs=4,
        snippets_per_epoch=24,
        batch_size=8,
    )
    return dataclasses.replace(config, **changes)


def write_data(folder: Path, *, recordings: int = 3, cars: int = 4) -> str:
    """Recordings of 12 s in the inD layout; the folder's name."""
    for number in range(recordings):
        write_recording(
            folder, number=number, classes=("car",) * cars + ("pedestrian",), num_frames=300
        )
    write_map(folder)
    return str(folder)


def save_random(folder: Path, *, seed: int = 0) -> Path:
    """A checkpoint of the tiny network with random weights; the folder."""
    plug = FFWASP
    view = make_view("chauffeurnet", height_px=36, width_px=24)
    shape = NetworkShape(
        raster=view.shape, history=15, horizon=15, dt_s=0.2, action_range=(4.0, 0.5)
    )
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        network = plug.network(NETWORK, shape)
    folder.mkdir(parents=True)
    save_learned(
        folder,
        plug=plug,
        network_config=NETWORK,
        shape=shape,
        view=view,
        weights=network.state_dict(),
        provenance={
            "trained_on": {"source": "nothing", "split": "recording", "parts": {}},
            "config": {"preset": "tiny"},
        },
    )
    return folder
