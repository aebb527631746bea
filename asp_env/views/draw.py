"""Drawing boxes into single-channel pictures: plain kernels that know nothing of agents.

Pixel coordinates are (column, row) as `asp_env.views.view` defines them. A pixel belongs to a box
when its centre does; left and top edges are inside, right and bottom edges are not, so that boxes
which share an edge share no pixel. No box vanishes: sides are at least one pixel long, and the
pixel that holds the box's centre is always set.
"""

import math
from typing import no_type_check

from numba import njit

SET = 255
"""The value of a pixel that something covers; all others are 0."""


@njit(cache=True, nogil=True)
@no_type_check
def fill_box(canvas, column, row, along_column, along_row, half_length, half_width):
    """Sets the pixels of one box; those outside the canvas are left out.

    Args:
        canvas: (height, width) uint8.
        column: of the box's centre.
        row: of the box's centre.
        along_column: column part of the unit vector along the box's length.
        along_row: row part of that vector.
        half_length: half the length, pixels.
        half_width: half the width, pixels.
    """
    height, width = canvas.shape
    half_length = max(half_length, 0.5)
    half_width = max(half_width, 0.5)
    lean_column, lean_row = abs(along_column), abs(along_row)
    reach_row = half_length * lean_row + half_width * lean_column
    reach_column = half_length * lean_column + half_width * lean_row
    # Written so that NaN leaves, too.
    if not (row + reach_row > 0 and row - reach_row < height):
        return
    if not (column + reach_column > 0 and column - reach_column < width):
        return
    # The box is where two strips cross: |along| <= half_length and |across| <= half_width. On the
    # row at distance d from the centre each is an interval around slope * d. A strip that runs
    # along the rows bounds no column; the rows' range bounds it.
    length_slope = width_slope = 0.0
    length_reach = width_reach = math.inf
    if lean_column > 1e-9:
        length_slope, length_reach = -along_row / along_column, half_length / lean_column
    if lean_row > 1e-9:
        width_slope, width_reach = along_column / along_row, half_width / lean_row
    first_row = int(max(math.ceil(row - reach_row - 0.5), 0.0))
    end_row = int(min(math.ceil(row + reach_row - 0.5), height))
    for r in range(first_row, end_row):
        distance = r + 0.5 - row
        by_length, by_width = length_slope * distance, width_slope * distance
        left = column - 0.5 + max(by_length - length_reach, by_width - width_reach)
        right = column - 0.5 + min(by_length + length_reach, by_width + width_reach)
        first_column = int(max(math.ceil(left), 0.0))
        end_column = int(min(math.ceil(right), width))
        for c in range(first_column, end_column):
            canvas[r, c] = SET
    if 0 <= row < height and 0 <= column < width:
        canvas[int(row), int(column)] = SET


@njit(cache=True, nogil=True)
@no_type_check
def fill_segment(canvas, column_0, row_0, column_1, row_1, half_width):
    """Sets the pixels of a thick line with square ends that reach `half_width` beyond the points.

    A half width of 0.75 or more leaves no gap, whatever the direction.
    """
    run, drop = column_1 - column_0, row_1 - row_0
    length = math.hypot(run, drop)
    along_column, along_row = (run / length, drop / length) if length > 1e-9 else (0.0, 1.0)
    column, row = 0.5 * (column_0 + column_1), 0.5 * (row_0 + row_1)
    fill_box(canvas, column, row, along_column, along_row, 0.5 * length + half_width, half_width)
