"""Inputs and labels of the networks, as tensors of N targets.

All positions are in the frame of the target now: the origin is the centre of its box, x points
ahead along its heading and y to its left.

Dimensions: n targets, t ticks.
"""

from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from asp_env.data.scene import Scene
from asp_env.data.snippets import Future
from asp_env.geometry import states_to_frame, wrap_angle
from asp_env.views import BinaryView, RasterView, SceneView


class VectorTensors(NamedTuple):
    """The vector view of N targets; `asp_env.views.vectors` defines the fields of each row."""

    agents: Float[Tensor, "n agents ticks fields"]
    agents_valid: Bool[Tensor, "n agents ticks"]
    lines: Float[Tensor, "n lines points line_fields"]
    lines_valid: Bool[Tensor, "n lines points"]


Observation = UInt8[Tensor, "n c h w"] | VectorTensors
"""Rasters with values from 0 to 255, or packed to bits along their rows if they are binary; or
the tensors of the vector view."""


class Batch(NamedTuple):
    """Inputs of a network: the past and present of N targets."""

    observation: Observation
    actions: Float[Tensor, "n history 2"]
    """Past actions [acceleration m/s², steering rad]; the last one ends now."""
    motion: Float[Tensor, "n 3"]
    """[speed m/s, acceleration m/s², yaw rate rad/s] at the last tick."""
    length_m: Float[Tensor, " n"]


class Labels(NamedTuple):
    """The recorded future of N targets."""

    states: Float[Tensor, "n t 4"]
    """[x m, y m, heading rad, speed m/s] in the target's frame now."""
    later: tuple[Batch, ...]
    """The inputs at the end of each future segment, in the target's frame then. Empty for networks
    that learn from no future inputs."""


def make_batch(scene: Scene, view: SceneView, history: int) -> Batch:
    """Makes the inputs for the targets of a scene.

    Args:
        scene: N targets, each valid at every tick of the history.
        view: The view that renders the observation.
        history: Number of past actions.

    Returns:
        The inputs, on the CPU.
    """
    index = (scene.targets[:, 0], scene.targets[:, 1])
    now, before = scene.states[index][:, -1], scene.states[index][:, -2]
    actions = scene.actions[index][:, scene.history - history :]
    yaw_rate = wrap_angle(now[:, 2] - before[:, 2]) / np.float32(scene.dt_s)
    motion = np.stack([now[:, 3], actions[:, -1, 0], yaw_rate], axis=-1)
    return Batch(
        observation=_observe(scene, view),
        actions=torch.from_numpy(actions),
        motion=torch.from_numpy(motion),
        length_m=torch.from_numpy(scene.sizes[index][:, 0]),
    )


def make_labels(scene: Scene, future: Future, later: tuple[Batch, ...] = ()) -> Labels:
    """Makes the labels for the targets of a scene.

    Args:
        scene: N targets.
        future: Their recorded states, valid at every tick.
        later: The inputs at the end of each future segment.

    Returns:
        The labels, on the CPU.
    """
    now = scene.target_states.astype(np.float64)[:, None]
    states = states_to_frame(future.states.astype(np.float64), now)
    return Labels(states=torch.from_numpy(states.astype(np.float32)), later=later)


def _observe(scene: Scene, view: SceneView) -> Observation:
    if isinstance(view, BinaryView):
        return torch.from_numpy(view.render_packed(scene))
    drawn = view.render(scene)
    if isinstance(view, RasterView):
        return torch.from_numpy(drawn)
    return VectorTensors(*(torch.from_numpy(array) for array in drawn))
