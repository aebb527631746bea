"""Measurement errors and the smoothing that drone datasets hide them with."""

import numpy as np
from jaxtyping import Float

POSITION_SIGMA_M = 0.08
HEADING_SIGMA_RAD = np.radians(1.5)
WINDOW = 21
"""Frames at 25 Hz that are fitted at once."""
_ORDER = 3


def savitzky_golay(
    values: Float[np.ndarray, "n k"], window: int = WINDOW
) -> Float[np.ndarray, "n k"]:
    """Fits a cubic to the `window` frames around every frame and reads it there: no delay.

    The first and last frames, half a window each, are read off the first and last fit.
    Shorter series are fitted by a straight line.
    """
    at = np.arange(len(values), dtype=np.float64)
    if len(values) < window:
        line = np.vander(at, 2)
        return line @ np.linalg.lstsq(line, values, rcond=None)[0]
    half = window // 2
    basis = np.vander(np.arange(-half, half + 1) / half, _ORDER + 1)
    fit = basis @ np.linalg.pinv(basis)
    windows = np.lib.stride_tricks.sliding_window_view(values, window, axis=0)
    middle = np.einsum("nkw,w->nk", windows, fit[half])
    first, last = fit[:half] @ values[:window], fit[half + 1 :] @ values[-window:]
    return np.concatenate([first, middle, last])


def measure(
    rng: np.random.Generator,
    xy: Float[np.ndarray, "n 2"],
    heading_rad: Float[np.ndarray, " n"],
    window: int = WINDOW,
) -> tuple[Float[np.ndarray, "n 2"], Float[np.ndarray, " n"]]:
    """Positions and continuous headings as a tracker gives them after smoothing."""
    errors = rng.normal(size=(len(xy), 3))
    errors *= np.array([POSITION_SIGMA_M, POSITION_SIGMA_M, HEADING_SIGMA_RAD])
    smooth = savitzky_golay(np.column_stack([xy, heading_rad]) + errors, window)
    return smooth[:, :2], smooth[:, 2]
