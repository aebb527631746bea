"""What one picture shows, whatever it was taken from.

MERGED: Words on a picture: a caption, what is wrong, a scale, a legend, and a line of time.
MERGED: One picture for people: the map, who is there, and what is forecast and planned.
"""

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
from asp_env.render.canvas import SHADE, Canvas, Colour
from asp_env.render.ground import draw_ground

EGO = 0
"""The slot of the ego."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FrameContents:
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


def frame_contents(
    scene: Scene,
    situation: int,
    *,
    forecast: Forecast | None,
    plan: Shaped[np.ndarray, "points n"] | None,
    background: Background | None,
) -> FrameContents:
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
        steps_gone=gone,
        plan=np.zeros((0, 2), np.float32) if plan is None else plan[:, :2],
        words=(f"{tick * scene.dt_s:.1f} s   {speed_mps:.1f} m/s",),
    )


TEXT: Colour = (226, 232, 241)
FAINT: Colour = (170, 182, 200)
MIN_WORDS_PX = 200
"""Smaller pictures have no room for words."""
MARGIN_PX = 14.0
LINE_PX = 21.0
TIME_LINE_PX = 6.0
"""Height of the line of time, below everything else."""


def draw_labels(canvas: Canvas, words: Sequence[str], alarms: Sequence[tuple[str, Colour]]) -> None:
    """A caption above at the left, alarms above at the right, a bar of a round length below."""
    if canvas.small_side_px < MIN_WORDS_PX:
        return
    for number, line in enumerate(words):
        canvas.text(line, MARGIN_PX, 26 + number * LINE_PX, TEXT if number == 0 else FAINT)
    for number, (what, colour) in enumerate(alarms):
        _badge(canvas, what, 26 + number * (LINE_PX + 9), colour)
    _scale_bar(canvas)


def _badge(canvas: Canvas, what: str, row: float, colour: Colour) -> None:
    """Dark words on a bright field at the right edge."""
    width = canvas.text_width(what)
    right = canvas.width - MARGIN_PX
    canvas.field(right - width - 16, row - 16, right, row + 8, colour)
    canvas.text(what, right - width - 8, row, SHADE, rim=False)


def _scale_bar(canvas: Canvas) -> None:
    scale = canvas.frame.pixels_per_metre / canvas.unit
    metres = next((m for m in (1, 2, 5, 10, 20, 50, 100, 200, 500) if m * scale > 60), 1000)
    row, end = canvas.height - MARGIN_PX, MARGIN_PX + metres * scale
    for grow, colour in ((1.0, SHADE), (0.0, TEXT)):
        left, right = MARGIN_PX - grow, end + grow
        canvas.field(left, row - 2 - grow, right, row + grow, colour)
        for tip in (MARGIN_PX, end - 1):
            canvas.field(tip - grow, row - 7 - grow, tip + 1 + grow, row + grow, colour)
    canvas.text(f"{metres} m", MARGIN_PX + 6, row - 8, TEXT)


def draw_legend(canvas: Canvas, entries: Sequence[tuple[str, Colour]]) -> None:
    """What colours mean, below at the right."""
    if canvas.small_side_px < 2 * MIN_WORDS_PX:
        return
    right = canvas.width - MARGIN_PX
    row = canvas.height - MARGIN_PX - 6
    for what, colour in reversed(entries):
        right -= canvas.text_width(what)
        canvas.text(what, right, row, TEXT)
        canvas.field(right - 27, row - 8, right - 7, row - 2, SHADE)
        canvas.field(right - 26, row - 7, right - 8, row - 3, colour)
        right -= 44


def draw_hint(canvas: Canvas, words: str) -> None:
    """Words below in the middle, above the legend."""
    width = canvas.text_width(words)
    if words and canvas.width > width:
        canvas.text(words, (canvas.width - width) / 2, canvas.height - 3 * LINE_PX, TEXT)


def draw_time_line(
    canvas: Canvas, done: float, spells: Sequence[tuple[float, float, Colour]]
) -> None:
    """A bar along the lower edge.

    Args:
        canvas: what is drawn on.
        done: the share of the time that has passed.
        spells: (from, to, colour) of what went wrong, as shares of the time; later ones on top.
    """
    height, width = canvas.height, canvas.width
    top = height - TIME_LINE_PX
    canvas.field(0.0, top, width, height, SHADE)
    canvas.field(0.0, top, done * width, height, FAINT)
    for begin, end, colour in spells:
        left = min(begin * width, width - 5)
        canvas.field(left, top, max(end * width, left + 5), height, colour)
    canvas.field(done * width - 1.5, top - 2, done * width + 1.5, height, TEXT)


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
    moment = frame_contents(scene, situation, forecast=forecast, plan=plan, background=background)
    return draw_contents(moment, size_px=size_px, extent_m=extent_m).image


def draw_contents(
    moment: FrameContents, *, size_px: tuple[int, int], extent_m: float | None
) -> Canvas:
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
    moment: FrameContents, size_px: tuple[int, int], extent_m: float | None
) -> tuple[tuple[float, float], float]:
    """The point in the middle, and pixels per metre."""
    if extent_m is not None:
        x, y = moment.states[EGO, -1, :2].tolist()
        return (x, y), size_px[0] / extent_m
    left, low, right, high = moment.road_map.extent_m
    scale = min(size_px[0] / (right - left), size_px[1] / (high - low)) / FIT_MARGIN
    return ((left + right) / 2, (low + high) / 2), scale


def _draw_trails(
    canvas: Canvas, moment: FrameContents, slots: Int[np.ndarray, " s"], colour: Colour
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


def _draw_forecasts(canvas: Canvas, moment: FrameContents) -> None:
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


def _draw_boxes(canvas: Canvas, moment: FrameContents, seen: Int[np.ndarray, " s"]) -> None:
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
