"""What an agent is shown of a scene: raster, action history and state of the ego."""

from collections.abc import Sequence

import numpy as np
from gymnasium import spaces
from jaxtyping import Shaped

from asp_env.data.scene import Scene
from asp_env.dynamics import MAX_STEERING_RAD, wrap_angle
from asp_env.errors import AspEnvError, unknown_name
from asp_env.sim.world import EGO, Events
from asp_env.views import PictureView

KNOWN = ("raster", "actions", "state")

MAX_SEEN_ACCELERATION_MPS2 = 10.0
"""Inferred accelerations beyond this are shown as this, so that the space is bounded."""

STATE_FIELDS: dict[str, tuple[float, float]] = {
    "speed_mps": (-60.0, 60.0),
    "acceleration_mps2": (-MAX_SEEN_ACCELERATION_MPS2, MAX_SEEN_ACCELERATION_MPS2),
    "steering_rad": (-MAX_STEERING_RAD, MAX_STEERING_RAD),
    "route_offset_m": (-50.0, 50.0),
    "route_heading_error_rad": (-float(np.pi), float(np.pi)),
    "route_done": (-1.0, 2.0),
    "to_goal_m": (-200.0, 1000.0),
    "length_m": (0.0, 30.0),
    "width_m": (0.0, 10.0),
}
"""Fields of the `state` observation in their order, with their bounds; values are clipped."""


class Observer:
    """Turns scenes into observations; draws nothing that is not asked for."""

    def __init__(self, names: Sequence[str], view: PictureView, history: int) -> None:
        """An observer of the named parts.

        Raises:
            AspEnvError: a name is unknown, or there is none.
        """
        if not names:
            raise AspEnvError(f"no observation given: expected some of {', '.join(KNOWN)}")
        for name in names:
            if name not in KNOWN:
                raise unknown_name("observation", name, KNOWN)
        self.names = tuple(names)
        self._view = view
        low, high = np.array(list(STATE_FIELDS.values()), dtype=np.float32).T
        self._state_bounds = low, high
        limit = np.array([MAX_SEEN_ACCELERATION_MPS2, MAX_STEERING_RAD], dtype=np.float32)
        self._action_limit = limit
        actions = np.tile(limit, (history, 1))
        possible: dict[str, spaces.Space] = {
            "raster": spaces.Box(0, 255, view.shape, dtype=np.uint8),
            "actions": spaces.Box(-actions, actions, dtype=np.float32),
            "state": spaces.Box(low, high, dtype=np.float32),
        }
        self.space = spaces.Dict({name: possible[name] for name in self.names})

    def observe(self, scene: Scene, events: Events) -> dict[str, Shaped[np.ndarray, "b ..."]]:
        """One array per part, with the episodes first."""
        made = {"raster": self._raster, "actions": self._actions, "state": self._state}
        return {name: made[name](scene, events) for name in self.names}

    def _raster(self, scene: Scene, events: Events) -> np.ndarray:
        del events
        rows = np.arange(len(scene.tick))
        egos = np.stack([rows, np.full(len(rows), EGO)], axis=-1)
        return self._view.draw(scene.with_targets(egos))

    def _actions(self, scene: Scene, events: Events) -> np.ndarray:
        del events
        limit = self._action_limit
        return np.clip(scene.actions[:, EGO], -limit, limit)

    def _state(self, scene: Scene, events: Events) -> np.ndarray:
        ego = scene.states[:, EGO, -1]
        action = scene.actions[:, EGO, -1]
        fields = np.stack(
            [
                ego[:, 3],
                action[:, 0],
                action[:, 1],
                events.route_offset_m,
                wrap_angle(ego[:, 2] - events.route_heading_rad),
                events.route_m / np.maximum(events.goal_m, 1.0),
                events.goal_m - events.route_m,
                scene.sizes[:, EGO, 0],
                scene.sizes[:, EGO, 1],
            ],
            axis=-1,
        )
        low, high = self._state_bounds
        return np.clip(fields.astype(np.float32), low, high)
