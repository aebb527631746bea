"""Polylines for drawing sites: arc length, resampling, offsets, curves. Left is positive."""

import numpy as np
from jaxtyping import Float

from asp_env.geometry import arc_lengths, points_at

Polyline = Float[np.ndarray, "_ 2"]
"""Points (n, 2), m."""


def dense(line: Polyline, spacing_m: float) -> Polyline:
    """Resamples a line to points about `spacing_m` apart, ends included."""
    arc = arc_lengths(line)
    count = max(2, round(float(arc[-1]) / spacing_m) + 1)
    return points_at(line, arc, np.linspace(0.0, arc[-1], count))


def normals(line: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
    """Unit vectors to the left at each point; at a corner the mean of both sides."""
    steps = np.diff(line, axis=0)
    steps = steps / np.hypot(*steps.T)[:, None]
    ahead = np.concatenate([steps[:1], steps[:-1] + steps[1:], steps[-1:]])
    ahead = ahead / np.hypot(*ahead.T)[:, None]
    return np.stack([-ahead[:, 1], ahead[:, 0]], axis=1)


def offset(
    line: Float[np.ndarray, "n 2"], left_m: float | Float[np.ndarray, " n"]
) -> Float[np.ndarray, "n 2"]:
    """Shifts a line to the left, by one distance or by one distance per point."""
    return line + normals(line) * np.asarray(left_m).reshape(-1, 1)


def clothoid_like(
    *, heading_rad: float, curvature_per_m: float, straight_m: float, length_m: float
) -> Polyline:
    """A line from the origin with points 2 m apart: straight, then of growing curvature."""
    at = np.arange(0.0, length_m + 1e-9, 2.0)
    return bent(heading_rad, np.clip((at - straight_m) / 20.0, 0.0, 1.0) * curvature_per_m)


def bent(heading_rad: float, bend: Float[np.ndarray, " n"]) -> Polyline:
    """A line from the origin with points 2 m apart, of the given curvature at each of them, 1/m."""
    heading = heading_rad + np.concatenate([[0.0], np.cumsum(0.5 * (bend[1:] + bend[:-1]) * 2.0)])
    middle = 0.5 * (heading[1:] + heading[:-1])
    steps = 2.0 * np.stack([np.cos(middle), np.sin(middle)], axis=1)
    return np.concatenate([np.zeros((1, 2)), np.cumsum(steps, axis=0)])


def bezier(start: np.ndarray, start_rad: float, end: np.ndarray, end_rad: float) -> Polyline:
    """A cubic Bézier curve of 13 points between two points with given headings."""
    pull = 0.4 * float(np.hypot(*(end - start)))
    a = start + pull * np.array([np.cos(start_rad), np.sin(start_rad)])
    b = end - pull * np.array([np.cos(end_rad), np.sin(end_rad)])
    t = np.linspace(0.0, 1.0, 13)[:, None]
    return (1 - t) ** 3 * start + 3 * (1 - t) ** 2 * t * a + 3 * (1 - t) * t**2 * b + t**3 * end


def polar(radius_m: float, angle_rad: float | np.ndarray) -> np.ndarray:
    """Points at a distance and direction from the origin."""
    return radius_m * np.stack([np.cos(angle_rad), np.sin(angle_rad)], axis=-1)
