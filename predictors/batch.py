"""What networks see of a scene's targets: tensors in each target's own frame."""

from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from asp_env.data.geometry import states_to_frame
from asp_env.data.scene import Scene
from asp_env.data.snippets import Future
from asp_env.views import PictureView


class Batch(NamedTuple):
    """What is known of N targets now."""

    raster: UInt8[Tensor, "n c h w"]
    """0 or 255; networks scale it themselves."""
    actions: Float[Tensor, "n history 2"]
    """[acceleration m/s², steering rad]; the last one ends now."""
    speed_mps: Float[Tensor, " n"]
    length_m: Float[Tensor, " n"]


class Labels(NamedTuple):
    """What N targets went on to do, seen from their pose now."""

    states: Float[Tensor, "n t 4"]
    """[x ahead m, y left m, heading rad, speed m/s]."""


def make_batch(scene: Scene, view: PictureView, history: int) -> Batch:
    """What is known of the scene's targets, all of which were seen throughout the history."""
    at = (scene.targets[:, 0], scene.targets[:, 1])
    return Batch(
        raster=torch.from_numpy(view.draw(scene)),
        actions=torch.from_numpy(scene.actions[at][:, scene.history - history :]),
        speed_mps=torch.from_numpy(scene.target_states[:, 3].copy()),
        length_m=torch.from_numpy(scene.sizes[at][:, 0]),
    )


def make_labels(scene: Scene, future: Future) -> Labels:
    """The targets' future, all of which must be valid."""
    now = scene.target_states.astype(np.float64)[:, None]
    states = states_to_frame(future.states.astype(np.float64), now)
    return Labels(states=torch.from_numpy(states.astype(np.float32)))
