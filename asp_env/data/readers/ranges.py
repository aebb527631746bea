"""Plausible ranges of the cells of tables: what no traffic exceeds is an error of unit or a damage.

The ranges are far wider than any traffic and far narrower than single precision, in which states
are stored. All of them are chosen by hand.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from asp_env.errors import DataError


@dataclass(frozen=True, slots=True, kw_only=True)
class Limit:
    """Largest plausible absolute value of the cells of a column."""

    largest: float
    unit: str
    """Unit in the plural, such as `metres`."""

    def __str__(self) -> str:
        """What a cell should be, for error messages."""
        return f"{self.unit} from {-self.largest:,.0f} to {self.largest:,.0f}"


POSITION = Limit(largest=1e7, unit="metres")
"""A position along one axis; UTM coordinates are below 10,000 km."""

SIZE = Limit(largest=200.0, unit="metres")
"""Length or width; longer than any road vehicle or tram."""

SPEED = Limit(largest=100.0, unit="m/s")
"""Velocity along one axis, or a speed limit."""

HIGHEST_LIMIT_MPS = 45.0
"""No speed limit is higher: 162 km/h. Larger numbers in m/s are km/h. Chosen by hand."""

ACCELERATION = Limit(largest=1e5, unit="m/s²")
"""Acceleration along one axis; jumps of a tracker reach thousands of m/s²."""

HEADING_DEG = Limit(largest=36_000.0, unit="degrees")
"""Headings may count whole turns: up to a hundred of them."""

HEADING_RAD = Limit(largest=628.0, unit="radians")
"""As `HEADING_DEG`."""

TIME_MS = Limit(largest=1e14, unit="milliseconds")
"""Times since any epoch; nanoseconds since 1970 are beyond."""

EXTENT_M = 10_000.0
"""Largest distance along one axis from the median position of a recording: no camera sees farther.
Positions in millimetres or micrometres are beyond."""

FROM_ORIGIN_M = 100_000.0
"""Largest distance of the median position from the origin: states are stored in single precision,
which rounds to 0.01 m there."""

MAX_FRAMES = 10_000_000
"""Largest number of frames of a recording: 23 hours at 120 Hz."""


def check_extent(
    positions: Float[np.ndarray, "rows 2"],
    names: tuple[str, str],
    located: Callable[[int], str],
) -> None:
    """Checks that all positions of a recording lie at one site.

    Args:
        positions: positions of all rows, metres.
        names: the columns of x and y.
        located: returns the file and line of a row; it begins the error message.

    Raises:
        DataError: a position is farther than `EXTENT_M` from the median, or the median is farther
            than `FROM_ORIGIN_M` from the origin. The message names the first one.
    """
    for axis, name in enumerate(names):
        along = positions[:, axis]
        middle = float(np.median(along))
        far = np.abs(along - middle) > EXTENT_M
        if far.any():
            row = int(far.argmax())
            more = f", as {int(far.sum()):,} of {len(far):,} rows are" if far.sum() > 1 else ""
            raise DataError(
                f"{located(row)}: {name} is {float(along[row]):g}, "
                f"{abs(float(along[row]) - middle):,.0f} m from the median of the file{more}; "
                f"expected metres, all within {EXTENT_M:,.0f} m of it: convert the column to "
                "metres, or correct the line or remove it"
            )
    middles = np.median(positions, axis=0).tolist()
    if math.hypot(*middles) > FROM_ORIGIN_M:
        raise DataError(
            f"{located(0)}: {' and '.join(names)} are absolute, such as UTM coordinates "
            f"({middles[0]:,.0f} and {middles[1]:,.0f} on average); expected metres from an origin "
            "at the site: subtract the same numbers, such as the recording's xUtmOrigin and "
            "yUtmOrigin, from all positions"
        )


def check_duration(frames: Int[np.ndarray, " rows"], located: Callable[[int], str]) -> None:
    """Checks that a recording lasts less than `MAX_FRAMES` frames.

    Args:
        frames: frame of each row.
        located: returns the file and line of a row; it begins the error message.

    Raises:
        DataError: it lasts longer. The message names the row that is farthest from the median.
    """
    if int(frames.max()) - int(frames.min()) < MAX_FRAMES:
        return
    away = np.abs(frames - np.median(frames))
    row = int(away.argmax())
    raise DataError(
        f"{located(row)}: is {away[row]:,.0f} frames from the median of the file; expected less "
        f"than {MAX_FRAMES:,} frames between the first and the last row: correct the line or "
        "remove it"
    )
