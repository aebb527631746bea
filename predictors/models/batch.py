"""What networks see of a scene's targets: tensors in each target's own frame."""

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
    """What N targets see, each in its own frame now; fields as `asp_env.views.vectors` names."""

    agents: Float[Tensor, "n agents ticks fields"]
    agents_valid: Bool[Tensor, "n agents ticks"]
    lines: Float[Tensor, "n lines points line_fields"]
    lines_valid: Bool[Tensor, "n lines points"]


Seen = UInt8[Tensor, "n c h w"] | VectorTensors
"""Pictures of 0 to 255, binary ones packed to bits along their rows; or polylines and agents."""


class Batch(NamedTuple):
    """What is known of N targets now."""

    seen: Seen
    actions: Float[Tensor, "n history 2"]
    """[acceleration m/s², steering rad]; the last one ends now."""
    motion: Float[Tensor, "n 3"]
    """[speed m/s, acceleration m/s², yaw rate rad/s] of the last tick."""
    length_m: Float[Tensor, " n"]


class Labels(NamedTuple):
    """What N targets went on to do, seen from their pose now."""

    states: Float[Tensor, "n t 4"]
    """[x ahead m, y left m, heading rad, speed m/s]."""
    later: tuple[Batch, ...]
    """What is known of the targets at the end of each segment to come, seen from their pose then;
    empty for networks that learn from no later scene."""


def make_batch(scene: Scene, view: SceneView, history: int) -> Batch:
    """What is known of the scene's targets, all of which were seen throughout the history."""
    at = (scene.targets[:, 0], scene.targets[:, 1])
    now, before = scene.states[at][:, -1], scene.states[at][:, -2]
    actions = scene.actions[at][:, scene.history - history :]
    yaw_rate = wrap_angle(now[:, 2] - before[:, 2]) / np.float32(scene.dt_s)
    motion = np.stack([now[:, 3], actions[:, -1, 0], yaw_rate], axis=-1)
    return Batch(
        seen=_seen(scene, view),
        actions=torch.from_numpy(actions),
        motion=torch.from_numpy(motion),
        length_m=torch.from_numpy(scene.sizes[at][:, 0]),
    )


def make_labels(scene: Scene, future: Future, later: tuple[Batch, ...] = ()) -> Labels:
    """The targets' future, all of which must be valid."""
    now = scene.target_states.astype(np.float64)[:, None]
    states = states_to_frame(future.states.astype(np.float64), now)
    return Labels(states=torch.from_numpy(states.astype(np.float32)), later=later)


def _seen(scene: Scene, view: SceneView) -> Seen:
    if isinstance(view, BinaryView):
        return torch.from_numpy(view.render_packed(scene))
    drawn = view.render(scene)
    if isinstance(view, RasterView):
        return torch.from_numpy(drawn)
    return VectorTensors(*(torch.from_numpy(array) for array in drawn))
