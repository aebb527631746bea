"""Drawing boxes and lines into binary pictures: the compiled part of views.

Pixel coordinates are (column, row) as `asp_env.views.view` defines them. A pixel belongs to a box
when its centre does; left and top edges are inside, right and bottom edges are not, so that boxes
which share an edge share no pixel. No box vanishes: sides are at least one pixel long, and the
pixel that holds the box's centre is always set.

All kernels are in this one file because numba's cache watches only the file of the kernel that is
called from Python: another file's change would go unnoticed.
"""

import math
from typing import no_type_check

import numpy as np
from numba import njit

SET = 255
"""The value of a pixel that something covers; all others are 0."""


@njit(cache=True, nogil=True)
@no_type_check
def affine(matrix):
    """A matrix (2, 3) of `View.pixels_from_world` as six numbers, which stay in registers."""
    return matrix[0, 0], matrix[0, 1], matrix[0, 2], matrix[1, 0], matrix[1, 1], matrix[1, 2]


@njit(cache=True, nogil=True)
@no_type_check
def locate(affine_map, x, y):
    """(column, row) of a point of the world."""
    column_x, column_y, column_0, row_x, row_y, row_0 = affine_map
    return column_x * x + column_y * y + column_0, row_x * x + row_y * y + row_0


@njit(cache=True, nogil=True)
@no_type_check
def turn(affine_map, x, y):
    """(column, row) parts of a direction of the world, in pixels for each metre of it."""
    column_x, column_y, _, row_x, row_y, _ = affine_map
    return column_x * x + column_y * y, row_x * x + row_y * y


@njit(cache=True, nogil=True)
@no_type_check
def out_of_sight(height, width, column, row, reach):
    """Whether nothing within `reach` of a point can show: worth asking before a box is turned."""
    beside = abs(column - 0.5 * width) > 0.5 * width + reach
    return beside or abs(row - 0.5 * height) > 0.5 * height + reach


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
    # along the rows bounds no column; the range of rows bounds it.
    length_slope = width_slope = 0.0
    length_reach = width_reach = math.inf
    if lean_column > 1e-9:
        length_slope, length_reach = -along_row / along_column, half_length / lean_column
    if lean_row > 1e-9:
        width_slope, width_reach = along_column / along_row, half_width / lean_row
    first_row = int(max(np.ceil(row - reach_row - 0.5), 0.0))
    end_row = int(min(np.ceil(row + reach_row - 0.5), float(height)))
    first_centre = column - 0.5
    for r in range(first_row, end_row):
        distance = r + 0.5 - row
        by_length, by_width = length_slope * distance, width_slope * distance
        left = first_centre + max(by_length - length_reach, by_width - width_reach)
        right = first_centre + min(by_length + length_reach, by_width + width_reach)
        first = int(max(np.ceil(left), 0.0))
        end = int(max(min(np.ceil(right), float(width)), 0.0))
        # An assignment to a slice is faster here than a loop, which would become calls of memset.
        canvas[r, first:end] = SET
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


@njit(cache=True, nogil=True)
@no_type_check
def draw_pieces(pieces, on_map, pixels_from_world, pixels_per_metre, half_width, out):
    """Draws the straight pieces of one map into channel 0 of some pictures.

    Args:
        pieces: (pieces, 5) middle x, middle y, cos, sin and half length of each, metres.
        on_map: (targets,) whose pictures.
        pixels_from_world: (targets, 2, 3).
        pixels_per_metre: of the view.
        half_width: of the lines, pixels.
        out: (targets, channels, height, width), channel 0 cleared.
    """
    height, width = out.shape[2:]
    for t in range(len(on_map)):
        if not on_map[t]:
            continue
        canvas, matrix = out[t, 0], affine(pixels_from_world[t])
        for i in range(len(pieces)):
            # Pieces reach beyond their ends by half their width, so that corners close.
            half_length = pieces[i, 4] * pixels_per_metre + half_width
            column, row = locate(matrix, pieces[i, 0], pieces[i, 1])
            if out_of_sight(height, width, column, row, half_length + half_width):
                continue
            across, down = turn(matrix, pieces[i, 2], pieces[i, 3])
            across, down = across / pixels_per_metre, down / pixels_per_metre
            fill_box(canvas, column, row, across, down, half_length, half_width)


@njit(cache=True, nogil=True)
@no_type_check
def draw_agents(
    states,
    valid,
    sizes,
    targets,
    snapshots,
    pixels_from_world,
    pixels_per_metre,
    anchor,
    trail_half_width,
    out,
):
    """Clears and draws all channels but the map's: box, trail, then one for each snapshot.

    Args:
        states: (situations, agents, ticks, 4) float32, the last tick is now.
        valid: (situations, agents, ticks).
        sizes: (situations, agents, 2) lengths and widths, metres.
        targets: (targets, 2) situation and slot of the ego of each picture.
        snapshots: ticks at which the other agents are drawn; the last is now.
        pixels_from_world: (targets, 2, 3).
        pixels_per_metre: of the view.
        anchor: (column, row) of the ego in every picture.
        trail_half_width: pixels.
        out: (targets, 3 + snapshots, height, width).
    """
    agents, now = states.shape[1], states.shape[2] - 1
    height, width = out.shape[2:]
    cos, sin = np.empty((len(snapshots), agents)), np.empty((len(snapshots), agents))
    turned = -1
    for t in range(len(targets)):
        b, ego = targets[t]
        if not valid[b, ego, now]:
            out[t, 1:] = 0
            continue
        if b != turned:  # all targets of one situation see the same boxes
            turned = b
            _directions(states[b], valid[b], snapshots, cos, sin)
        matrix = affine(pixels_from_world[t])
        # Channels are cleared one by one, just before they are drawn into: they fit the cache.
        out[t, 1:3] = 0
        # In its own frame the ego always looks the same, so no rounding of its pose may enter.
        half_length = 0.5 * sizes[b, ego, 0] * pixels_per_metre
        half_width = 0.5 * sizes[b, ego, 1] * pixels_per_metre
        fill_box(out[t, 1], anchor[0], anchor[1], 0.0, -1.0, half_length, half_width)
        _draw_trail(out[t, 2], states[b, ego], valid[b, ego], matrix, trail_half_width)
        for k in range(len(snapshots)):
            tick = snapshots[k]
            out[t, 3 + k] = 0
            for a in range(agents):
                if a == ego or not valid[b, a, tick]:
                    continue
                half_length = 0.5 * sizes[b, a, 0] * pixels_per_metre
                half_width = 0.5 * sizes[b, a, 1] * pixels_per_metre
                column, row = locate(matrix, states[b, a, tick, 0], states[b, a, tick, 1])
                if out_of_sight(height, width, column, row, half_length + half_width + 1.0):
                    continue
                across, down = turn(matrix, cos[k, a], sin[k, a])
                across, down = across / pixels_per_metre, down / pixels_per_metre
                fill_box(out[t, 3 + k], column, row, across, down, half_length, half_width)


@njit(cache=True, nogil=True)
@no_type_check
def _directions(states, valid, snapshots, cos, sin):
    """Writes the headings of all agents at all snapshots, (snapshots, agents)."""
    for k in range(len(snapshots)):
        for a in range(len(states)):
            if valid[a, snapshots[k]]:
                cos[k, a] = math.cos(states[a, snapshots[k], 2])
                sin[k, a] = math.sin(states[a, snapshots[k], 2])


@njit(cache=True, nogil=True)
@no_type_check
def _draw_trail(canvas, states, valid, matrix, half_width):
    """The way through the valid states of one agent; a gap stays a gap."""
    for k in range(1, len(states)):
        if valid[k - 1] and valid[k]:
            column_0, row_0 = locate(matrix, states[k - 1, 0], states[k - 1, 1])
            column_1, row_1 = locate(matrix, states[k, 0], states[k, 1])
            fill_segment(canvas, column_0, row_0, column_1, row_1, half_width)
