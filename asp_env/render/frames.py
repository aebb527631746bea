"""One frame: the map, the agents, forecasts and the plan seen from above, with texts on top."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int, Shaped, UInt8

from asp_env.data.classes import AgentClass
from asp_env.data.predictor import Forecast
from asp_env.data.recording import Background
from asp_env.data.road_map import RoadMap
from asp_env.data.scene import Scene
from asp_env.errors import AspEnvError
from asp_env.geometry import box_corners, from_frame
from asp_env.render.canvas import SHADE_COLOUR, Canvas, Colour
from asp_env.render.ground import draw_ground

EGO = 0
"""The slot of the ego."""

EGO_COLOUR: Colour = (77, 148, 255)
EGO_EDGE_COLOUR: Colour = (255, 255, 255)
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
FORECAST_COLOUR: Colour = (255, 146, 43)
PLAN_COLOUR: Colour = (120, 190, 255)
TRAIL_COLOUR: Colour = (170, 182, 200)
RECORDED_EGO_COLOUR: Colour = (242, 245, 249)
TEXT_COLOUR: Colour = (226, 232, 241)
FAINT_COLOUR: Colour = (170, 182, 200)

ALARM_GAP_M = 1.2
"""How much larger than the ego the rectangle is that marks an event."""
MIN_BOX_PX = 8.0
"""Smallest side of a drawn box, at which pedestrians remain visible. Chosen by hand."""
MIN_WEDGE_PX = 9.0
"""Narrower boxes have no wedge that shows their heading."""
MAX_REACH_M = 15.0
"""Agents further than this outside the image are not drawn; no box reaches further."""
FIT_MARGIN = 1.06
"""Width of the image relative to that of the map where the whole map is shown."""
MIN_TEXT_PX = 200
"""Images with a smaller side have no text."""
MARGIN_PX = 14.0
LINE_PX = 21.0
TIME_LINE_PX = 6.0
"""Height of the time line along the lower edge."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FrameContents:
    """What a frame shows: A agents with their past, forecasts, the plan, and texts."""

    road_map: RoadMap
    background: Background | None
    states: Shaped[np.ndarray, "a ticks 4"]
    """The last tick is the present."""
    valid: Bool[np.ndarray, "a ticks"]
    sizes: Shaped[np.ndarray, "a 2"]
    classes: Int[np.ndarray, " a"]
    route: Shaped[np.ndarray, "p 2"]
    modes: Shaped[np.ndarray, "rows modes steps 2"]
    """Forecast positions."""
    probabilities: Float[np.ndarray, "rows modes"]
    slots: Int[np.ndarray, " rows"]
    """The slot of the agent that each row forecasts."""
    elapsed_steps: Int[np.ndarray, " rows"]
    """Number of steps of each row that have passed; they are not drawn."""
    plan: Shaped[np.ndarray, "points 2"]
    """Planned positions of the ego after the present; may be empty."""
    recorded_ego: Shaped[np.ndarray, " 4"] | None = None
    """State of the ego in the recording."""
    caption: tuple[str, ...]
    """Lines of text."""
    alarms: tuple[tuple[str, Colour], ...] = ()
    """Present events and their colours, the most serious first."""


def frame_contents(
    scene: Scene,
    situation: int,
    *,
    forecast: Forecast | None,
    plan: Shaped[np.ndarray, "points n"] | None,
    background: Background | None,
) -> FrameContents:
    """The contents of a frame that shows a situation of a scene.

    Args:
        scene: The scene.
        situation: The index of the situation.
        forecast: A forecast of this scene, or of an earlier tick with the same slots, of which the
            remaining steps are shown.
        plan: Planned positions of the ego, metres, in the first two columns.
        background: A photograph of the site.
    """
    tick = int(scene.tick[situation])
    speed_mps = float(scene.states[situation, EGO, -1, 3])
    if forecast is None:
        modes, probabilities = np.zeros((0, 1, 1, 2), np.float32), np.zeros((0, 1), np.float32)
        slots = elapsed = np.zeros(0, dtype=np.int64)
    else:
        rows = np.flatnonzero((forecast.targets[:, 0] == situation) & forecast.valid)
        modes, probabilities = forecast.states[rows][..., :2], forecast.probabilities[rows]
        slots, elapsed = forecast.targets[rows, 1], np.maximum(tick - forecast.tick[rows], 0)
    return FrameContents(
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
        elapsed_steps=elapsed,
        plan=np.zeros((0, 2), np.float32) if plan is None else plan[:, :2],
        caption=(f"{tick * scene.dt_s:.1f} s   {speed_mps:.1f} m/s",),
    )


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
    """Draws a situation from above; equal arguments give equal bits.

    Args:
        scene: The scene. Of its targets and routes only the route of the ego is drawn.
        situation: The index of the situation in the scene.
        size_px: Width and height of the image.
        extent_m: Width of the area around the ego; None shows the whole map.
        forecast: A forecast of this scene, or of an earlier tick with the same slots. Width and
            opacity of a mode show its probability.
        plan: (steps, 2 or more) Planned positions of the ego, metres, in the first two columns.
        background: A photograph of the site, drawn over the map's drivable area.

    Returns:
        An RGB image, y up.

    Raises:
        AspEnvError: A size is not positive, or there is no such situation.
        DataError: The background image cannot be read.
    """
    if not 0 <= situation < len(scene.tick):
        raise AspEnvError(f"situation {situation}: the scene has {len(scene.tick)}")
    contents = frame_contents(scene, situation, forecast=forecast, plan=plan, background=background)
    return draw_contents(contents, size_px=size_px, extent_m=extent_m).image


def draw_contents(
    contents: FrameContents, *, size_px: tuple[int, int], extent_m: float | None
) -> Canvas:
    """Draws the contents of a frame on a new canvas; see `draw_frame` for the arguments.

    Raises:
        AspEnvError: A size is not positive.
        DataError: The background image cannot be read.
    """
    if min(size_px) < 1:
        raise AspEnvError(f"size {size_px}: expected a width and height of at least 1 pixel")
    if extent_m is not None and not 0 < extent_m < math.inf:
        raise AspEnvError(f"extent {extent_m} m: expected a positive number or None")
    centre_m, scale = _camera(contents, size_px, extent_m)
    canvas = Canvas(*draw_ground(contents.road_map, contents.background, centre_m, scale, size_px))
    if len(contents.route) > 1:
        canvas.stroke(contents.route[None], 0.3, 5.0)
        canvas.blend(EGO_COLOUR)
    present = np.flatnonzero(contents.valid[:, -1])
    _draw_trails(canvas, contents, present[present != EGO], TRAIL_COLOUR)
    _draw_trails(canvas, contents, present[present == EGO], EGO_COLOUR)
    _draw_forecasts(canvas, contents)
    if len(contents.plan):
        path = np.concatenate([contents.states[EGO, None, -1, :2], contents.plan])
        canvas.stroke(path[None], 0.95, 4.0)
        canvas.blend(PLAN_COLOUR)
    if contents.recorded_ego is not None:
        size = contents.sizes[EGO]
        _draw_outline(canvas, contents.recorded_ego, size, 0.85, 2.0, RECORDED_EGO_COLOUR)
    _draw_boxes(canvas, contents, present)
    if contents.alarms and contents.valid[EGO, -1]:
        size = contents.sizes[EGO] + ALARM_GAP_M
        _draw_outline(canvas, contents.states[EGO, -1], size, 1.0, 3.0, contents.alarms[0][1])
    _draw_texts(canvas, contents)
    return canvas


def draw_legend(canvas: Canvas, entries: Sequence[tuple[str, Colour]]) -> None:
    """Draws the meaning of colours in the lower right corner."""
    if canvas.small_side_px < 2 * MIN_TEXT_PX:
        return
    right = canvas.width - MARGIN_PX
    row = canvas.height - MARGIN_PX - 6
    for text, colour in reversed(entries):
        right -= canvas.text_width(text)
        canvas.text(text, right, row, TEXT_COLOUR)
        canvas.rectangle(right - 27, row - 8, right - 7, row - 2, SHADE_COLOUR)
        canvas.rectangle(right - 26, row - 7, right - 8, row - 3, colour)
        right -= 44


def draw_hint(canvas: Canvas, text: str) -> None:
    """Draws a text at the bottom in the middle, above the legend."""
    width = canvas.text_width(text)
    if text and canvas.width > width:
        left, base = (canvas.width - width) / 2, canvas.height - 3 * LINE_PX
        canvas.text(text, left, base, TEXT_COLOUR)


def draw_time_line(
    canvas: Canvas, done: float, intervals: Sequence[tuple[float, float, Colour]]
) -> None:
    """Draws a time line along the lower edge.

    Args:
        canvas: The canvas to draw on.
        done: The share of the time that has passed.
        intervals: (begin, end, colour) of events, as shares of the time; later ones on top.
    """
    height, width = canvas.height, canvas.width
    top = height - TIME_LINE_PX
    canvas.rectangle(0.0, top, width, height, SHADE_COLOUR)
    canvas.rectangle(0.0, top, done * width, height, FAINT_COLOUR)
    for begin, end, colour in intervals:
        left = min(begin * width, width - 5)
        canvas.rectangle(left, top, max(end * width, left + 5), height, colour)
    canvas.rectangle(done * width - 1.5, top - 2, done * width + 1.5, height, TEXT_COLOUR)


def _camera(
    contents: FrameContents, size_px: tuple[int, int], extent_m: float | None
) -> tuple[tuple[float, float], float]:
    """The point in the middle of the image, and pixels per metre."""
    if extent_m is not None:
        x, y = contents.states[EGO, -1, :2].tolist()
        return (x, y), size_px[0] / extent_m
    left, low, right, high = contents.road_map.extent_m
    scale = min(size_px[0] / (right - left), size_px[1] / (high - low)) / FIT_MARGIN
    return ((left + right) / 2, (low + high) / 2), scale


def _draw_trails(
    canvas: Canvas, contents: FrameContents, slots: Int[np.ndarray, " s"], colour: Colour
) -> None:
    """Past positions, fading with their age."""
    past, valid = contents.states[slots, :, :2], contents.valid[slots]
    both = valid[:, 1:] & valid[:, :-1]
    steps = both.shape[1]
    for k in range(steps):
        pieces = past[both[:, k], k : k + 2]
        if len(pieces):
            canvas.stroke(pieces, 0.6 * (k + 1) / steps, 2.0)
    canvas.blend(colour)


def _draw_forecasts(canvas: Canvas, contents: FrameContents) -> None:
    # The least probable mode comes first, so that probable ones are on top.
    order = np.argsort(contents.probabilities, axis=None, kind="stable")
    for row, mode in zip(*np.unravel_index(order, contents.probabilities.shape), strict=True):
        slot = contents.slots[row]
        points = contents.modes[row, mode, contents.elapsed_steps[row] :]
        if not (contents.valid[slot, -1] and len(points)):
            continue
        p = float(contents.probabilities[row, mode])
        alpha = 0.25 + 0.7 * p
        start = contents.states[slot, None, -1, :2]
        canvas.stroke(np.concatenate([start, points])[None], alpha, 1 + 3 * p)
        canvas.dot(points[-1], alpha, 2 + 2.5 * p)
    canvas.blend(FORECAST_COLOUR)


def _draw_boxes(canvas: Canvas, contents: FrameContents, slots: Int[np.ndarray, " s"]) -> None:
    states = contents.states[slots, -1]
    visible = _may_be_visible(canvas, states)
    slots, states = slots[visible], states[visible]
    viewport = canvas.viewport
    scale = viewport.pixels_per_metre / canvas.unit
    sizes = np.maximum(contents.sizes[slots], MIN_BOX_PX / scale).astype(states.dtype)
    boxes = viewport.to_fixed_point(box_corners(states, sizes))
    wedges = viewport.to_fixed_point(_wedges(states, sizes))
    wide = sizes[:, 1] * scale >= MIN_WEDGE_PX
    # The ego has the first slot and is drawn last, on top.
    for i in reversed(range(len(slots))):
        ego = slots[i] == EGO
        kind = AgentClass(int(contents.classes[slots[i]]))
        canvas.fill(boxes[i], EGO_COLOUR if ego else CLASS_COLOURS[kind])
        if wide[i]:
            canvas.fill(wedges[i], SHADE_COLOUR)
        canvas.outline(boxes[i], EGO_EDGE_COLOUR if ego else SHADE_COLOUR)


def _may_be_visible(canvas: Canvas, states: Shaped[np.ndarray, "s 4"]) -> Bool[np.ndarray, " s"]:
    viewport = canvas.viewport
    pixels, margin = viewport.to_pixels(states[:, :2]), MAX_REACH_M * viewport.pixels_per_metre
    size = (viewport.width_px + margin, viewport.height_px + margin)
    return np.asarray(((pixels > -margin) & (pixels < size)).all(axis=-1))


def _wedges(
    states: Float[np.ndarray, "s 4"], sizes: Float[np.ndarray, "s 2"]
) -> Float[np.ndarray, "s 3 2"]:
    """Triangles at the front of boxes that point in the direction of the heading."""
    half_length, half_width = sizes[:, 0] / 2, sizes[:, 1] / 2
    tip = 0.82 * half_length
    back = tip - np.minimum(1.1, 0.6 * half_length)
    side = 0.62 * half_width
    zero = np.zeros_like(tip)
    corners = np.stack([tip, zero, back, side, back, -side], axis=-1).reshape(-1, 3, 2)
    return from_frame(corners, states[:, None])


def _draw_outline(
    canvas: Canvas,
    state: Shaped[np.ndarray, " 4"],
    size: Shaped[np.ndarray, " 2"],
    alpha: float,
    width_px: float,
    colour: Colour,
) -> None:
    corners = box_corners(state, size)
    canvas.stroke(np.concatenate([corners, corners[:1]])[None], alpha, width_px)
    canvas.blend(colour)


def _draw_texts(canvas: Canvas, contents: FrameContents) -> None:
    """The caption at the top left, alarms at the top right, a scale bar at the bottom left."""
    if canvas.small_side_px < MIN_TEXT_PX:
        return
    for number, line in enumerate(contents.caption):
        colour = TEXT_COLOUR if number == 0 else FAINT_COLOUR
        canvas.text(line, MARGIN_PX, 26 + number * LINE_PX, colour)
    for number, (name, colour) in enumerate(contents.alarms):
        _draw_badge(canvas, name, 26 + number * (LINE_PX + 9), colour)
    _draw_scale_bar(canvas)


def _draw_badge(canvas: Canvas, text: str, row: float, colour: Colour) -> None:
    """Dark text on a bright rectangle at the right edge."""
    width = canvas.text_width(text)
    right = canvas.width - MARGIN_PX
    canvas.rectangle(right - width - 16, row - 16, right, row + 8, colour)
    canvas.text(text, right - width - 8, row, SHADE_COLOUR, rim=False)


def _draw_scale_bar(canvas: Canvas) -> None:
    scale = canvas.viewport.pixels_per_metre / canvas.unit
    metres = next((m for m in (1, 2, 5, 10, 20, 50, 100, 200, 500) if m * scale > 60), 1000)
    row, end = canvas.height - MARGIN_PX, MARGIN_PX + metres * scale
    for rim, colour in ((1.0, SHADE_COLOUR), (0.0, TEXT_COLOUR)):
        canvas.rectangle(MARGIN_PX - rim, row - 2 - rim, end + rim, row + rim, colour)
        for tip in (MARGIN_PX, end - 1):
            canvas.rectangle(tip - rim, row - 7 - rim, tip + 1 + rim, row + rim, colour)
    canvas.text(f"{metres} m", MARGIN_PX + 6, row - 8, TEXT_COLOUR)
