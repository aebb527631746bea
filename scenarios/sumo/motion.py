"""From the front bumper positions of SUMO to the motion of vehicles with two axles.

SUMO moves the centre of the front bumper along the lane and aligns the body with the lane, unlike a
real car. Here the path is smoothed and separated from the progress along it: the front axle follows
the path, the rear axle follows without slip (a tractrix), and both are evaluated at the smoothed
progress. Standing vehicles therefore stand exactly still, no vehicle moves backwards, and the
motion is that of the kinematic bicycle.
"""

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from asp_env.dynamics.bicycle import AXLE_SHARE_OF_LENGTH
from asp_env.geometry import arc_lengths, points_at
from scenarios.polylines import Polyline
from scenarios.sumo.network import STEP_S

FRAME_RATE_HZ = 25.0
SPACING_M = 0.2
"""Distance between points of a smoothed path."""
PATH_SIGMA_M = {"pedestrian": 0.5, "bicycle": 1.2}
PATH_SIGMA_DEFAULT_M = 1.8
PROGRESS_SIGMA_S = 0.25
"""Standard deviations of the smoothing kernels. Chosen by hand."""
JUMP_M = 2.5
"""Longer steps are lane changes: no agent moves this far in one simulation step."""
CHANGE_S, CHANGE_M = 2.5, (15.0, 28.0)
"""Duration of a lane change, and the bounds of the distance that it takes."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PathStyle:
    """How the path of an agent differs from the middle of the lane, on which SUMO's agents move."""

    offset_m: float = 0.0
    """Constant distance to the left of the middle."""
    wander_m: float = 0.0
    """Amplitude of a sinusoidal deviation along the way."""
    wander_length_m: float = 1.0
    """Wave length of this deviation."""
    phase_rad: float = 0.0
    """Phase of this deviation."""
    rounding: float = 1.0
    """Factor on the length over which the path is smoothed: corners are cut further."""

    def left_m(self, along_m: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
        """Distance to the left of the middle at the given distances along the way."""
        turn = 2.0 * np.pi * along_m / self.wander_length_m
        return self.offset_m + self.wander_m * np.sin(turn + self.phase_rad)


@dataclass(frozen=True, slots=True, kw_only=True)
class Motion:
    """The motion of one agent, frame by frame; the reference point is the centre of its box."""

    first_frame: int
    xy: Float[np.ndarray, "frames 2"]
    heading_rad: Float[np.ndarray, " frames"]
    """Not wrapped: it may exceed π."""


def gaussian(values: np.ndarray, sigma: float) -> np.ndarray:
    """Smooths columns along the first axis; beyond the ends they continue as straight lines.

    Straight lines and constants stay unchanged in the interior.

    Args:
        values: (n, ...) evenly spaced samples.
        sigma: standard deviation of the kernel, samples.
    """
    reach = max(1, int(np.ceil(3.0 * sigma)))
    kernel = np.exp(-0.5 * (np.arange(-reach, reach + 1) / sigma) ** 2)
    kernel = kernel / kernel.sum()
    columns = values.reshape(len(values), -1)
    before = columns[0] + (columns[1] - columns[0]) * np.arange(-reach, 0)[:, None]
    after = columns[-1] + (columns[-1] - columns[-2]) * np.arange(1, reach + 1)[:, None]
    padded = np.concatenate([before, columns, after])
    smooth = np.stack([np.convolve(column, kernel, "valid") for column in padded.T], axis=1)
    return smooth.reshape(values.shape)


def catmull_rom(table: Float[np.ndarray, "n k"], at: Float[np.ndarray, " m"]) -> np.ndarray:
    """Interpolates an evenly spaced table with a continuous first derivative (Catmull–Rom).

    Args:
        table: (n, k) rows.
        at: (m,) fractional row numbers.
    """
    row = np.clip(at.astype(np.int64), 1, len(table) - 3)
    u = (at - row)[:, None]
    a, b, c, d = (table[row + i] for i in (-1, 0, 1, 2))
    return b + 0.5 * u * (c - a + u * (2 * a - 5 * b + 4 * c - d + u * (3 * (b - c) + d - a)))


def reconstruct(
    times_s: Float[np.ndarray, " n"],
    points: Float[np.ndarray, "n 2"],
    *,
    kind: str,
    length_m: float,
    style: PathStyle | None = None,
    frame_rate_hz: float = FRAME_RATE_HZ,
) -> Motion | None:
    """The motion of an agent from the reported positions of its front bumper.

    Args:
        times_s: (n,) times of the reports, evenly spaced.
        points: (n, 2) centre of the front bumper, m; of pedestrians the centre of the body.
        kind: class name.
        length_m: length of the agent.
        style: deviation from the middle of the lane, if there is one.
        frame_rate_hz: frames per second of the motion.

    Returns:
        The motion at all whole frames between the first and last time; None if the agent never
        moves.
    """
    points = ease_lane_changes(points)
    arc = arc_lengths(points)
    if arc[-1] < 2.0 or len(points) < 4:
        return None
    lead = round((length_m + 6.0) / SPACING_M)
    sigma_m = PATH_SIGMA_M.get(kind, PATH_SIGMA_DEFAULT_M)
    path, tangent = _smoothed_path(points, arc, lead, sigma_m * (style.rounding if style else 1.0))
    if style is not None:
        path, tangent = _beside(path, tangent, style)
    if kind in ("pedestrian", "bicycle"):
        behind_m, wheelbase_m = 0.5 * length_m, 0.0
        heading = tangent
    else:
        behind_m = (0.5 - AXLE_SHARE_OF_LENGTH) * length_m
        wheelbase_m = 2.0 * AXLE_SHARE_OF_LENGTH * length_m
        heading = _tractrix(tangent, wheelbase_m)
    first = int(np.ceil(times_s[0] * frame_rate_hz - 1e-6))
    last = int(np.floor(times_s[-1] * frame_rate_hz + 1e-6))
    frames = np.arange(first, last + 1)
    progress = gaussian(
        np.interp(frames / frame_rate_hz, times_s, arc), PROGRESS_SIGMA_S * frame_rate_hz
    )
    progress = np.maximum.accumulate(progress)
    at = lead + (np.clip(progress, 0.0, arc[-1]) - behind_m) / SPACING_M
    table = catmull_rom(np.column_stack([path, heading]), at)
    ahead = np.stack([np.cos(table[:, 2]), np.sin(table[:, 2])], axis=1)
    return Motion(
        first_frame=first,
        xy=table[:, :2] - 0.5 * wheelbase_m * ahead,
        heading_rad=table[:, 2],
    )


def ease_lane_changes(points: Polyline) -> Polyline:
    """Distributes the jumps of SUMO's lane changes over the following metres.

    The lateral offset from the new lane decays along the path, not over time, so that no agent
    moves sideways while it stands.
    """
    steps = np.diff(points, axis=0)
    lengths = np.hypot(*steps.T)
    jumps = np.flatnonzero(lengths > JUMP_M)
    regular = np.flatnonzero((lengths > 0.02) & (lengths <= JUMP_M))
    if not len(jumps) or not len(regular):
        return points
    # While standing and in jumps, the direction of travel is that of the last regular step.
    before = regular[
        np.clip(np.searchsorted(regular, np.arange(len(points)), "right") - 1, 0, None)
    ]
    ahead = steps[before] / lengths[before, None]
    left = np.stack([-ahead[:, 1], ahead[:, 0]], axis=1)
    lengths[jumps] = np.sum(steps[jumps] * ahead[jumps], axis=1).clip(0.0, JUMP_M)
    travelled = np.concatenate([[0.0], np.cumsum(lengths)])
    eased = points.copy()
    for jump in jumps:
        sideways = float(steps[jump] @ left[jump])
        speed = float(np.mean(lengths[max(jump - 4, 0) : jump + 1])) / STEP_S
        over_m = float(np.clip(CHANGE_S * speed, *CHANGE_M))
        share = np.clip((travelled[jump + 1 :] - travelled[jump + 1]) / over_m, 0.0, 1.0)
        rest = 1.0 - share**2 * (3.0 - 2.0 * share)
        eased[jump + 1 :] -= (sideways * rest)[:, None] * left[jump + 1 :]
    return eased


def _smoothed_path(
    points: Polyline, arc: np.ndarray, lead: int, sigma_m: float
) -> tuple[Polyline, np.ndarray]:
    """The smoothed path from `lead` steps before the first point, and its direction."""
    distinct = [0]
    for i in range(1, len(arc)):
        if arc[i] - arc[distinct[-1]] >= 0.1:
            distinct.append(i)
    at = np.arange(-lead, arc[-1] / SPACING_M + 20.0) * SPACING_M
    line, along = points[distinct], arc[distinct]
    raw = points_at(line, along, at)
    for outside, end, other in ((at < 0.0, 0, 1), (at > along[-1], -1, -2)):
        slope = (line[end] - line[other]) / (along[end] - along[other])
        raw[outside] = line[end] + slope * (at[outside] - along[end])[:, None]
    path = gaussian(raw, sigma_m / SPACING_M)
    steps = np.gradient(path, axis=0)
    return path, np.unwrap(np.arctan2(steps[:, 1], steps[:, 0]))


def _beside(
    path: Polyline, tangent_rad: np.ndarray, style: PathStyle
) -> tuple[Polyline, np.ndarray]:
    """A path beside another one, and its direction."""
    left = style.left_m(SPACING_M * np.arange(len(path)))
    beside = path + left[:, None] * np.stack([-np.sin(tangent_rad), np.cos(tangent_rad)], axis=1)
    steps = np.gradient(beside, axis=0)
    return beside, np.unwrap(np.arctan2(steps[:, 1], steps[:, 0]))


def _tractrix(tangent_rad: Float[np.ndarray, " n"], wheelbase_m: float) -> np.ndarray:
    """Direction of a body whose front axle follows a path and whose rear axle has no slip.

    The direction θ obeys dθ/ds = sin(ψ - θ) / wheelbase, where ψ is the direction of the path. For
    constant ψ, tan((ψ - θ)/2) decays exponentially, which makes each step exact for a bend at its
    middle.
    """
    decay = math.exp(-SPACING_M / wheelbase_m)
    middle = 0.5 * (tangent_rad[1:] + tangent_rad[:-1])
    heading = np.empty_like(tangent_rad)
    theta = heading[0] = float(tangent_rad[0])
    for i, psi in enumerate(middle.tolist(), start=1):
        theta = psi - 2.0 * math.atan(math.tan(0.5 * (psi - theta)) * decay)
        heading[i] = theta
    return heading
