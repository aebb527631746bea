"""One picture of a scene for people: the map, who is there, and what is forecast and planned."""

import math

import numpy as np
from jaxtyping import Bool, Float, Int, Shaped, UInt8

from asp_env.data.classes import AgentClass
from asp_env.data.forecast import Forecast
from asp_env.data.geometry import box_corners, from_frame
from asp_env.data.recording import Background
from asp_env.data.scene import Scene
from asp_env.errors import AspEnvError
from asp_env.render.canvas import Canvas, Colour
from asp_env.render.ground import draw_ground

EGO: Colour = (77, 148, 255)
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
EDGE: Colour = (14, 17, 22)
FORECAST: Colour = (255, 146, 43)
PLAN: Colour = (120, 190, 255)
TRAIL: Colour = (170, 182, 200)
TEXT: Colour = (214, 222, 234)
EGO_SLOT = 0
MIN_WORDS_PX = 200
"""Smaller pictures have no room for time, speed and scale."""
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
        forecast: of this scene; width and strength of a mode tell its probability.
        plan: (steps, 2 or more) the ego's planned positions, metres, in their first two columns.
        background: a photograph of the place in place of the map's drivable area.

    Raises:
        AspEnvError: a size is not positive, or there is no such situation.
        DataError: the background picture cannot be read.
    """
    _check(scene, situation, size_px, extent_m)
    road_map = scene.maps[int(scene.map_index[situation])]
    ego = scene.states[situation, EGO_SLOT, -1]
    centre_m = (float(ego[0]), float(ego[1]))
    if extent_m is None:
        left, low, right, high = road_map.extent_m
        centre_m = ((left + right) / 2, (low + high) / 2)
        pixels_per_metre = min(size_px[0] / (right - left), size_px[1] / (high - low)) / FIT_MARGIN
    else:
        pixels_per_metre = size_px[0] / extent_m
    canvas = Canvas(*draw_ground(road_map, background, centre_m, pixels_per_metre, size_px))
    _draw_route(canvas, scene.route[situation, scene.route_valid[situation]])
    seen = np.flatnonzero(scene.valid[situation, :, -1])
    _draw_trails(canvas, scene, situation, seen[seen != EGO_SLOT], TRAIL)
    _draw_trails(canvas, scene, situation, seen[seen == EGO_SLOT], EGO)
    if forecast is not None:
        _draw_forecast(canvas, scene, forecast, situation)
    if plan is not None and len(plan):
        canvas.stroke(np.concatenate([ego[None, :2], plan[:, :2]])[None], 0.95, 4)
        canvas.blend(PLAN)
    _draw_boxes(canvas, scene, situation, seen)
    if min(size_px) >= MIN_WORDS_PX:
        _draw_words(canvas, scene, situation)
    return canvas.image


def _check(scene: Scene, situation: int, size_px: tuple[int, int], extent_m: float | None) -> None:
    if not 0 <= situation < len(scene.tick):
        raise AspEnvError(f"situation {situation}: the scene has {len(scene.tick)}")
    if min(size_px) < 1:
        raise AspEnvError(f"size {size_px}: expected a width and height of at least 1 pixel")
    if extent_m is not None and not 0 < extent_m < math.inf:
        raise AspEnvError(f"extent {extent_m} m: expected a positive number or None")


def _draw_route(canvas: Canvas, route: Shaped[np.ndarray, "p 2"]) -> None:
    if len(route) > 1:
        canvas.stroke(route[None], 0.3, 5)
        canvas.blend(EGO)


def _draw_trails(
    canvas: Canvas, scene: Scene, situation: int, slots: Int[np.ndarray, " s"], colour: Colour
) -> None:
    """Where agents came from, the fainter the longer ago."""
    past = scene.states[situation, slots, :, :2]
    valid = scene.valid[situation, slots]
    both = valid[:, 1:] & valid[:, :-1]
    for k in range(scene.history):
        pieces = past[both[:, k], k : k + 2]
        if len(pieces):
            canvas.stroke(pieces, 0.6 * (k + 1) / scene.history, 2)
    canvas.blend(colour)


def _draw_forecast(canvas: Canvas, scene: Scene, forecast: Forecast, situation: int) -> None:
    rows = np.flatnonzero((forecast.targets[:, 0] == situation) & forecast.valid)
    starts = scene.states[situation, forecast.targets[rows, 1], -1, :2]
    probabilities = forecast.probabilities[rows]
    # The least probable first, so that the likely ones lie on top.
    order = np.argsort(probabilities, axis=None, kind="stable")
    for row, mode in zip(*np.unravel_index(order, probabilities.shape), strict=True):
        points = forecast.states[rows[row], mode, :, :2]
        p = float(probabilities[row, mode])
        alpha = 0.25 + 0.7 * p
        canvas.stroke(np.concatenate([starts[row, None], points])[None], alpha, 1 + round(3 * p))
        canvas.dot(points[-1], alpha, 2 + 2.5 * p)
    canvas.blend(FORECAST)


def _draw_boxes(canvas: Canvas, scene: Scene, situation: int, seen: Int[np.ndarray, " s"]) -> None:
    states = scene.states[situation, seen, -1]
    near = _near(canvas, states)
    seen, states = seen[near], states[near]
    sizes = scene.sizes[situation, seen]
    boxes = canvas.frame.fixed(box_corners(states, sizes))
    wedges = canvas.frame.fixed(_wedges(states, sizes))
    # The ego has the first slot and comes last, on top.
    for slot, box, wedge in reversed(list(zip(seen.tolist(), boxes, wedges, strict=True))):
        ego = slot == EGO_SLOT
        kind = AgentClass(int(scene.classes[situation, slot]))
        canvas.fill(box, EGO if ego else CLASS_COLOURS[kind])
        canvas.fill(wedge, EDGE)
        canvas.outline(box, EGO_EDGE if ego else EDGE)


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


def _draw_words(canvas: Canvas, scene: Scene, situation: int) -> None:
    """Time and speed above, a bar of a round length below."""
    time_s = int(scene.tick[situation]) * scene.dt_s
    speed_mps = float(scene.states[situation, EGO_SLOT, -1, 3])
    canvas.text(f"{time_s:.1f} s   {speed_mps:.1f} m/s", 14, 26, TEXT)
    scale = canvas.frame.pixels_per_metre
    metres = next((m for m in (1, 2, 5, 10, 20, 50, 100, 200, 500) if m * scale > 60), 1000)
    row = canvas.frame.height_px - 14
    end = 14 + round(metres * scale)
    canvas.image[row - 1 : row + 1, 14 : end + 1] = TEXT
    canvas.image[row - 6 : row + 1, [14, end]] = TEXT
    canvas.text(f"{metres} m", 20, row - 7, TEXT)
