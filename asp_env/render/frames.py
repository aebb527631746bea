"""One picture for people: the map, who is there, and what is forecast and planned."""

import math

import numpy as np
from jaxtyping import Bool, Float, Int, Shaped, UInt8

from asp_env.data.classes import AgentClass
from asp_env.data.forecast import Forecast
from asp_env.data.geometry import box_corners, from_frame
from asp_env.data.recording import Background
from asp_env.data.scene import Scene
from asp_env.errors import AspEnvError
from asp_env.render.canvas import SHADE, Canvas, Colour
from asp_env.render.ground import draw_ground
from asp_env.render.labels import draw_labels
from asp_env.render.moment import EGO, Moment, moment_of_scene

EGO_COLOUR: Colour = (77, 148, 255)
CLASS_COLOURS: dict[AgentClass, Colour] = {
    AgentClass.CAR: (166, 182, 204),
    AgentClass.VAN: (53, 184, 180),
    AgentClass.TRUCK: (53, 184, 180),
    AgentClass.BUS: (53, 184, 180),
    AgentClass.TRUCK_BUS: (53, 184, 180),
    AgentClass.TRAILER: (53, 184, 180),
    AgentClass.MOTORCYCLE: (176, 140, 255),
    AgentClass.BICYCLE: (255, 107, 157),
    AgentClass.PEDESTRIAN: (255, 107, 157),
    AgentClass.ANIMAL: (255, 107, 157),
    AgentClass.OTHER: (183, 167, 142),
}
EGO_EDGE: Colour = (255, 255, 255)
FORECAST: Colour = (255, 146, 43)
PLAN: Colour = (120, 190, 255)
TRAIL: Colour = (170, 182, 200)
GHOST: Colour = (242, 245, 249)
ALARM_GAP_M = 1.2
"""How much larger than the ego the frame is that shows something to be wrong."""
MIN_BOX_PX = 8.0
"""Nobody is drawn smaller than this, so that pedestrians are seen."""
MIN_WEDGE_PX = 9.0
"""Narrower boxes have no room for a wedge."""
FIT_MARGIN = 1.06
"""The whole map is shown with this much room about it."""


def draw_frame(
    scene: Scene,
    *,
    situation: int = 0,
    size_px: tuple[int, int] = (720, 720),
    extent_m: float | None = 80.0,
    forecast: Forecast | None = None,
    plan: Shaped[np.ndarray, "steps n"] | None = None,
    background: Background | None = None,
) -> UInt8[np.ndarray, "height width 3"]:
    """Draws a situation from above in RGB, y up; the same arguments give the same bits.

    Args:
        scene: who is there. Of targets and route only the ego's route is drawn.
        situation: which of the scene's situations.
        size_px: width and height of the picture.
        extent_m: width of what is shown about the ego; None shows the whole map and stands still.
        forecast: of this scene, or of an earlier tick with the same slots; width and strength of
            a mode tell its probability.
        plan: (steps, 2 or more) the ego's planned positions, metres, in their first two columns.
        background: a photograph of the place, over the map's drivable area.

    Raises:
        AspEnvError: a size is not positive, or there is no such situation.
        DataError: the background picture cannot be read.
    """
    if not 0 <= situation < len(scene.tick):
        raise AspEnvError(f"situation {situation}: the scene has {len(scene.tick)}")
    moment = moment_of_scene(scene, situation, forecast=forecast, plan=plan, background=background)
    return draw_moment(moment, size_px=size_px, extent_m=extent_m).image


def draw_moment(moment: Moment, *, size_px: tuple[int, int], extent_m: float | None) -> Canvas:
    """The picture of a moment, to be drawn on further.

    Raises:
        AspEnvError: a size is not positive.
        DataError: the background picture cannot be read.
    """
    if min(size_px) < 1:
        raise AspEnvError(f"size {size_px}: expected a width and height of at least 1 pixel")
    if extent_m is not None and not 0 < extent_m < math.inf:
        raise AspEnvError(f"extent {extent_m} m: expected a positive number or None")
    where = _camera(moment, size_px, extent_m)
    canvas = Canvas(*draw_ground(moment.road_map, moment.background, *where, size_px))
    if len(moment.route) > 1:
        canvas.stroke(moment.route[None], 0.3, 5.0)
        canvas.blend(EGO_COLOUR)
    seen = np.flatnonzero(moment.valid[:, -1])
    _draw_trails(canvas, moment, seen[seen != EGO], TRAIL)
    _draw_trails(canvas, moment, seen[seen == EGO], EGO_COLOUR)
    _draw_forecasts(canvas, moment)
    if len(moment.plan):
        ahead = np.concatenate([moment.states[EGO, None, -1, :2], moment.plan])
        canvas.stroke(ahead[None], 0.95, 4.0)
        canvas.blend(PLAN)
    if moment.logged_ego is not None:
        _frame(canvas, moment.logged_ego, moment.sizes[EGO], 0.85, 2.0, GHOST)
    _draw_boxes(canvas, moment, seen)
    if moment.alarms and moment.valid[EGO, -1]:
        size = moment.sizes[EGO] + ALARM_GAP_M
        _frame(canvas, moment.states[EGO, -1], size, 1.0, 3.0, moment.alarms[0][1])
    draw_labels(canvas, moment.words, moment.alarms)
    return canvas


def _camera(
    moment: Moment, size_px: tuple[int, int], extent_m: float | None
) -> tuple[tuple[float, float], float]:
    """The point in the middle, and pixels per metre."""
    if extent_m is not None:
        x, y = moment.states[EGO, -1, :2].tolist()
        return (x, y), size_px[0] / extent_m
    left, low, right, high = moment.road_map.extent_m
    scale = min(size_px[0] / (right - left), size_px[1] / (high - low)) / FIT_MARGIN
    return ((left + right) / 2, (low + high) / 2), scale


def _draw_trails(
    canvas: Canvas, moment: Moment, slots: Int[np.ndarray, " s"], colour: Colour
) -> None:
    """Where agents came from, the fainter the longer ago."""
    past, valid = moment.states[slots, :, :2], moment.valid[slots]
    both = valid[:, 1:] & valid[:, :-1]
    steps = both.shape[1]
    for k in range(steps):
        pieces = past[both[:, k], k : k + 2]
        if len(pieces):
            canvas.stroke(pieces, 0.6 * (k + 1) / steps, 2.0)
    canvas.blend(colour)


def _draw_forecasts(canvas: Canvas, moment: Moment) -> None:
    # The least probable first, so that the likely ones lie on top.
    order = np.argsort(moment.probabilities, axis=None, kind="stable")
    for row, mode in zip(*np.unravel_index(order, moment.probabilities.shape), strict=True):
        slot = moment.slots[row]
        points = moment.modes[row, mode, moment.steps_gone[row] :]
        if not (moment.valid[slot, -1] and len(points)):
            continue
        p = float(moment.probabilities[row, mode])
        alpha = 0.25 + 0.7 * p
        start = moment.states[slot, None, -1, :2]
        canvas.stroke(np.concatenate([start, points])[None], alpha, 1 + 3 * p)
        canvas.dot(points[-1], alpha, 2 + 2.5 * p)
    canvas.blend(FORECAST)


def _draw_boxes(canvas: Canvas, moment: Moment, seen: Int[np.ndarray, " s"]) -> None:
    states = moment.states[seen, -1]
    near = _near(canvas, states)
    seen, states = seen[near], states[near]
    scale = canvas.frame.pixels_per_metre / canvas.unit
    sizes = np.maximum(moment.sizes[seen], MIN_BOX_PX / scale).astype(states.dtype)
    boxes = canvas.frame.fixed(box_corners(states, sizes))
    wedges = canvas.frame.fixed(_wedges(states, sizes))
    wide = sizes[:, 1] * scale >= MIN_WEDGE_PX
    # The ego has the first slot and comes last, on top.
    for i in reversed(range(len(seen))):
        ego = seen[i] == EGO
        kind = AgentClass(int(moment.classes[seen[i]]))
        canvas.fill(boxes[i], EGO_COLOUR if ego else CLASS_COLOURS[kind])
        if wide[i]:
            canvas.fill(wedges[i], SHADE)
        canvas.outline(boxes[i], EGO_EDGE if ego else SHADE)


def _near(canvas: Canvas, states: Shaped[np.ndarray, "s 4"]) -> Bool[np.ndarray, " s"]:
    """Agents of whom anything can show: within 15 m of the picture."""
    frame = canvas.frame
    pixels, margin = frame.pixels(states[:, :2]), 15 * frame.pixels_per_metre
    size = (frame.width_px + margin, frame.height_px + margin)
    return np.asarray(((pixels > -margin) & (pixels < size)).all(axis=-1))


def _wedges(
    states: Float[np.ndarray, "s 4"], sizes: Float[np.ndarray, "s 2"]
) -> Float[np.ndarray, "s 3 2"]:
    """Triangles at the fronts of boxes that point ahead."""
    half_length, half_width = sizes[:, 0] / 2, sizes[:, 1] / 2
    tip = 0.82 * half_length
    back = tip - np.minimum(1.1, 0.6 * half_length)
    side = 0.62 * half_width
    zero = np.zeros_like(tip)
    corners = np.stack([tip, zero, back, side, back, -side], axis=-1).reshape(-1, 3, 2)
    return from_frame(corners, states[:, None])


def _frame(
    canvas: Canvas,
    state: Shaped[np.ndarray, " 4"],
    size: Shaped[np.ndarray, " 2"],
    alpha: float,
    width_px: float,
    colour: Colour,
) -> None:
    """An empty box."""
    corners = box_corners(state, size)
    canvas.stroke(np.concatenate([corners, corners[:1]])[None], alpha, width_px)
    canvas.blend(colour)
