"""Measurement errors and the zero-phase smoothing of drone datasets."""

import numpy as np
from jaxtyping import Float

POSITION_SIGMA_M = 0.08
HEADING_SIGMA_RAD = np.radians(1.5)
"""Standard deviations of the errors before smoothing. Chosen by hand."""
WINDOW = 21
"""Frames per fit: 0.84 s at 25 Hz. Chosen by hand."""
_ORDER = 3


def savitzky_golay(
    values: Float[np.ndarray, "n k"], window: int = WINDOW
) -> Float[np.ndarray, "n k"]:
    """Smooths columns with zero phase by a Savitzky–Golay filter of order 3.

    The first and last half windows are evaluated on the first and last fit. Series shorter than a
    window are fitted by a straight line. scipy's filter is not used because scipy is no
    dependency.

    Args:
        values: (n, k) columns, evenly spaced in time.
        window: odd number of frames per fit.

    Returns:
        (n, k) smoothed columns.
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
    """Adds measurement errors to a track and smooths it, as trackers of drone datasets do.

    Args:
        rng: draws normal errors, independent in each frame.
        xy: (n, 2) true positions, m.
        heading_rad: (n,) true headings, continuous (not wrapped).
        window: frames per fit of the smoothing filter.

    Returns:
        Measured positions (n, 2), m, and headings (n,), rad.
    """
    errors = rng.normal(size=(len(xy), 3))
    errors *= np.array([POSITION_SIGMA_M, POSITION_SIGMA_M, HEADING_SIGMA_RAD])
    smooth = savitzky_golay(np.column_stack([xy, heading_rad]) + errors, window)
    return smooth[:, :2], smooth[:, 2]
