"""What one picture shows, whatever it was taken from."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int, Shaped

from asp_env.data.forecast import Forecast
from asp_env.data.recording import Background
from asp_env.data.road_map import RoadMap
from asp_env.data.scene import Scene
from asp_env.render.canvas import Colour

EGO = 0
"""The slot of the ego."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Moment:
    """A agents at one time with where they came from, and what is forecast and planned."""

    road_map: RoadMap
    background: Background | None
    states: Shaped[np.ndarray, "a ticks 4"]
    """The last one is now."""
    valid: Bool[np.ndarray, "a ticks"]
    sizes: Shaped[np.ndarray, "a 2"]
    classes: Int[np.ndarray, " a"]
    route: Shaped[np.ndarray, "p 2"]
    modes: Shaped[np.ndarray, "rows modes steps 2"]
    """Forecast positions."""
    probabilities: Float[np.ndarray, "rows modes"]
    slots: Int[np.ndarray, " rows"]
    """Of whom each row is."""
    steps_gone: Int[np.ndarray, " rows"]
    """How many steps of each row have passed; they are not shown."""
    plan: Shaped[np.ndarray, "points 2"]
    """Where the ego means to be from now on; may be empty."""
    logged_ego: Shaped[np.ndarray, " 4"] | None = None
    """Where the recording has the ego."""
    words: tuple[str, ...]
    """Lines of text."""
    alarms: tuple[tuple[str, Colour], ...] = ()
    """What is wrong now, the gravest first."""


def moment_of_scene(
    scene: Scene,
    situation: int,
    *,
    forecast: Forecast | None,
    plan: Shaped[np.ndarray, "points n"] | None,
    background: Background | None,
) -> Moment:
    """A situation of a scene; of a forecast made earlier, what is still to come."""
    tick = int(scene.tick[situation])
    speed_mps = float(scene.states[situation, EGO, -1, 3])
    if forecast is None:
        modes, probabilities = np.zeros((0, 1, 1, 2), np.float32), np.zeros((0, 1), np.float32)
        slots = gone = np.zeros(0, dtype=np.int64)
    else:
        rows = np.flatnonzero((forecast.targets[:, 0] == situation) & forecast.valid)
        modes, probabilities = forecast.states[rows][..., :2], forecast.probabilities[rows]
        slots, gone = forecast.targets[rows, 1], np.maximum(tick - forecast.tick[rows], 0)
    return Moment(
        road_map=scene.maps[int(scene.map_index[situation])],
        background=background,
        states=scene.states[situation],
        valid=scene.valid[situation],
        sizes=scene.sizes[situation],
        classes=scene.classes[situation],
        route=scene.route[situation, scene.route_valid[situation]],
        modes=modes,
        probabilities=probabilities,
        slots=slots,
        steps_gone=gone,
        plan=np.zeros((0, 2), np.float32) if plan is None else plan[:, :2],
        words=(f"{tick * scene.dt_s:.1f} s   {speed_mps:.1f} m/s",),
    )
