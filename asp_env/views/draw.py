"""Compiled drawing of boxes and lines into rasters, and packing of binary rasters to bits.

Pixel coordinates are (column, row) as `asp_env.views.raster.Viewport` defines them. A pixel belongs
to a box if its centre does; left and top edges are inside, right and bottom edges are not, so boxes
that share an edge share no pixel. No box vanishes: sides are at least one pixel long, and the pixel
that contains the centre of the box is always set.

The kernels draw a `PlacedScene` into `out` (targets, channels, height, width). Binary rasters may
be packed to bits: each channel is then drawn into the buffer `plane` (height, width) and packed
into `out`; otherwise `plane` is empty. Coloured rasters are drawn as colour indices into channel 0.

All kernels are in this one file because numba's cache watches only the file of the kernel that is
called from Python: a change in another file would go unnoticed.
"""

import math
from typing import no_type_check

import numpy as np

from asp_env.compiled import njit

SET = 255
"""Value of a covered pixel of a binary raster; all other pixels are 0."""


@njit(cache=True, nogil=True)
@no_type_check
def draw_boundaries(segments, map_index, placed, half_width, plane, out):
    """Clears channel 0 of the rasters on one map and draws the map's boundaries into it.

    Args:
        segments: (segments, 5) middle x m, middle y m, cos, sin and half length m.
        map_index: index of the map; targets on other maps are skipped.
        placed: `PlacedScene`.
        half_width: half the width of the lines, pixels.
        plane: (height, width) uint8 buffer of packed rasters, or an empty array.
        out: (targets, channels, height, width or bytes) uint8; channel 0 is written.
    """
    scale = placed.pixels_per_metre
    for t in range(len(placed.targets)):
        if placed.map_of_target[t] == map_index:
            matrix = _unpack_affine(placed.pixels_from_world[t])
            canvas = _clear(out[t, 0], plane)
            _draw_lines(canvas, matrix, scale, segments, half_width, SET)
            _pack_if_buffered(canvas, plane, out[t, 0])


@njit(cache=True, nogil=True)
@no_type_check
def draw_agents(placed, snapshots, trail_half_width, plane, out):
    """Clears and draws all channels but the map's: ego box, ego trail, one channel per snapshot.

    Args:
        placed: `PlacedScene`.
        snapshots: tuple of ticks at which the other agents are drawn; the last is the present.
        trail_half_width: half the width of the trail, pixels; 0 draws no trail.
        plane: (height, width) uint8 buffer of packed rasters, or an empty array.
        out: (targets, 3 + snapshots, height, width or bytes) uint8; channels 1 on are written.
    """
    states, valid, scale = placed.states, placed.valid, placed.pixels_per_metre
    half_sizes = 0.5 * placed.sizes * scale  # pixels
    agents, now = states.shape[1], states.shape[2] - 1
    cos, sin = np.empty((len(snapshots), agents)), np.empty((len(snapshots), agents))
    situation = -1
    for t in range(len(placed.targets)):
        b, ego = placed.targets[t]
        if not valid[b, ego, now]:
            out[t, 1:] = 0
            continue
        if b != situation:  # directions are shared by consecutive targets of one situation
            situation = b
            _write_directions(states[b], valid[b], snapshots, cos, sin)
        matrix = _unpack_affine(placed.pixels_from_world[t])
        canvas = _clear(out[t, 1], plane)
        # The ego is the same in its own frame at every pose, so no rounding of the pose may enter.
        length, width = half_sizes[b, ego]
        fill_box(canvas, *placed.anchor, 0.0, -1.0, length, width, SET)
        _pack_if_buffered(canvas, plane, out[t, 1])
        canvas = _clear(out[t, 2], plane)
        if trail_half_width > 0:
            _draw_trail(canvas, states[b, ego], valid[b, ego], matrix, trail_half_width)
        _pack_if_buffered(canvas, plane, out[t, 2])
        for k in range(len(snapshots)):
            canvas, tick = _clear(out[t, 3 + k], plane), snapshots[k]
            for a in range(agents):
                if a != ego and valid[b, a, tick]:
                    x, y, c, s = states[b, a, tick, 0], states[b, a, tick, 1], cos[k, a], sin[k, a]
                    length, width = half_sizes[b, a]
                    _draw_box(canvas, matrix, scale, x, y, c, s, length, width, SET)
            _pack_if_buffered(canvas, plane, out[t, 3 + k])


@njit(cache=True, nogil=True)
@no_type_check
def draw_coloured_lines(segments, map_index, placed, half_width, colour, out):
    """Draws the lines of one map over channel 0 of the rasters on that map.

    Args:
        segments: (segments, 5) middle x m, middle y m, cos, sin and half length m.
        map_index: index of the map; targets on other maps are skipped.
        placed: `PlacedScene`.
        half_width: half the width of the lines, pixels.
        colour: colour index to write.
        out: (targets, 3, height, width) uint8 colour indices; channel 0 is written.
    """
    scale = placed.pixels_per_metre
    for t in range(len(placed.targets)):
        if placed.map_of_target[t] == map_index:
            matrix = _unpack_affine(placed.pixels_from_world[t])
            _draw_lines(out[t, 0], matrix, scale, segments, half_width, colour)


@njit(cache=True, nogil=True)
@no_type_check
def draw_coloured_agents(placed, colours, order, target_colour, out):
    """Draws boxes at all ticks over channel 0: the other agents, oldest first, then the target.

    Args:
        placed: `PlacedScene`.
        colours: (situations, agents) colour index of the oldest box of each agent; it increases by
            1 per tick.
        order: (situations, agents) slots in the order in which they are drawn at each tick.
        target_colour: colour index of the oldest box of the target.
        out: (targets, 3, height, width) uint8 colour indices; channel 0 is written.
    """
    states, valid, scale = placed.states, placed.valid, placed.pixels_per_metre
    half_sizes = 0.5 * placed.sizes * scale  # pixels
    agents, ticks = states.shape[1:3]
    cos, sin = np.empty((ticks, agents)), np.empty((ticks, agents))
    situation = -1
    for t in range(len(placed.targets)):
        b, target = placed.targets[t]
        if not valid[b, target, ticks - 1]:
            continue
        if b != situation:
            situation = b
            _write_directions(states[b], valid[b], np.arange(ticks), cos, sin)
        canvas, matrix = out[t, 0], _unpack_affine(placed.pixels_from_world[t])
        for target_pass in range(2):
            for k in range(ticks - target_pass):  # the target's present box is drawn last
                for a in order[b]:
                    if (a == target) == (target_pass == 1) and valid[b, a, k]:
                        x, y, c, s = states[b, a, k, 0], states[b, a, k, 1], cos[k, a], sin[k, a]
                        length, width = half_sizes[b, a]
                        colour = k + (target_colour if target_pass else colours[b, a])
                        _draw_box(canvas, matrix, scale, x, y, c, s, length, width, colour)
        length, width = half_sizes[b, target]
        fill_box(canvas, *placed.anchor, 0.0, -1.0, length, width, target_colour + ticks - 1)


@njit(cache=True, nogil=True)
@no_type_check
def fill_box(canvas, column, row, along_column, along_row, half_length, half_width, value):
    """Sets the pixels of one box; pixels outside the canvas are left out.

    Args:
        canvas: (height, width) uint8.
        column: column of the box's centre.
        row: row of the box's centre.
        along_column: column component of the unit vector along the box's length.
        along_row: row component of that vector.
        half_length: half the length, pixels.
        half_width: half the width, pixels.
        value: value to write.
    """
    height, width = canvas.shape
    half_length = max(half_length, 0.5)
    half_width = max(half_width, 0.5)
    lean_column, lean_row = abs(along_column), abs(along_row)
    reach_row = half_length * lean_row + half_width * lean_column
    reach_column = half_length * lean_column + half_width * lean_row
    # These conditions also return for NaN.
    if not (row + reach_row > 0 and row - reach_row < height):
        return
    if not (column + reach_column > 0 and column - reach_column < width):
        return
    # The box is the intersection of two strips, |along| <= half_length and |across| <= half_width.
    # On the row at distance d from the centre each strip is an interval around slope * d. A strip
    # parallel to the rows does not bound the columns; it is bounded by the range of rows.
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
        # A slice assignment is faster than a loop, which the compiler turns into calls of memset.
        canvas[r, first:end] = value
    if 0 <= row < height and 0 <= column < width:
        canvas[int(row), int(column)] = value


@njit(cache=True, nogil=True)
@no_type_check
def fill_segment(canvas, column_0, row_0, column_1, row_1, half_width, value):
    """Sets the pixels of a thick line with square ends that extend `half_width` beyond its points.

    A half width of at least 0.75 pixels leaves no gap in any direction.

    Args:
        canvas: (height, width) uint8.
        column_0: column of the first point.
        row_0: row of the first point.
        column_1: column of the second point.
        row_1: row of the second point.
        half_width: half the width of the line, pixels.
        value: value to write.
    """
    run, drop = column_1 - column_0, row_1 - row_0
    length = math.hypot(run, drop)
    along_column, along_row = (run / length, drop / length) if length > 1e-9 else (0.0, 1.0)
    column, row = 0.5 * (column_0 + column_1), 0.5 * (row_0 + row_1)
    half_length = 0.5 * length + half_width
    fill_box(canvas, column, row, along_column, along_row, half_length, half_width, value)


@njit(cache=True, nogil=True)
@no_type_check
def pack_rows(pixels, packed):
    """Packs rows of pixels to bits along rows, as `np.packbits` does.

    Args:
        pixels: (rows, width) uint8, 0 or 255.
        packed: (rows, ⌈width / 8⌉) uint8, written. The first pixel of a row is the highest bit of
            its first byte; an incomplete last byte is padded with zeros.
    """
    rows, width = pixels.shape
    whole = width // 8
    rest = width - 8 * whole
    for r in range(rows):
        row = pixels[r]
        for i in range(whole):
            packed[r, i] = _pack_eight(row, 8 * i)
        if rest == 0:
            continue
        if whole > 0:  # the last eight pixels, without those that are already packed
            packed[r, whole] = (_pack_eight(row, width - 8) << (8 - rest)) & 255
        else:
            byte = 0
            for column in range(width):
                byte |= row[column] & (128 >> column)
            packed[r, 0] = byte


@njit(cache=True, nogil=True)
@no_type_check
def _pack_eight(pixels, first):
    word = np.uint64(pixels[first])  # the compiler combines the eight loads into one
    for i in range(1, 8):
        word |= np.uint64(pixels[first + i]) << np.uint64(8 * i)
    # The product moves the lowest bit of byte i to bit 63 - i; no two of its terms overlap.
    ones = word & np.uint64(0x0101010101010101)
    return (ones * np.uint64(0x8040201008040201)) >> np.uint64(56)


@njit(cache=True, nogil=True)
@no_type_check
def _clear(channel, plane):
    """The cleared array into which a channel is drawn: `plane` for packed rasters, else itself."""
    # Each channel is cleared just before it is drawn into, while it fits the processor's cache.
    canvas = plane if plane.size > 0 else channel
    canvas[:] = 0
    return canvas


@njit(cache=True, nogil=True)
@no_type_check
def _pack_if_buffered(canvas, plane, channel):
    if plane.size > 0:
        pack_rows(canvas, channel)


@njit(cache=True, nogil=True)
@no_type_check
def _draw_box(canvas, matrix, scale, x, y, cos, sin, half_length, half_width, value):
    """Draws a box given in world coordinates.

    Args:
        canvas: (height, width) uint8.
        matrix: `_unpack_affine` of the map from the world to pixels.
        scale: pixels per metre.
        x: centre, metres.
        y: centre, metres.
        cos: cosine of the heading.
        sin: sine of the heading.
        half_length: half the length, pixels.
        half_width: half the width, pixels.
        value: value to write.
    """
    column, row = _to_pixel(matrix, x, y)
    height, width = canvas.shape
    if _out_of_sight(height, width, column, row, half_length + half_width + 1.0):
        return
    across, down = _to_pixel_direction(matrix, cos, sin)
    fill_box(canvas, column, row, across / scale, down / scale, half_length, half_width, value)


@njit(cache=True, nogil=True)
@no_type_check
def _draw_lines(canvas, matrix, scale, segments, half_width, value):
    for i in range(len(segments)):
        # Segments extend beyond their ends by half their width, so that corners are closed.
        half_length = segments[i, 4] * scale + half_width
        x, y, cos, sin = segments[i, 0], segments[i, 1], segments[i, 2], segments[i, 3]
        _draw_box(canvas, matrix, scale, x, y, cos, sin, half_length, half_width, value)


@njit(cache=True, nogil=True)
@no_type_check
def _draw_trail(canvas, states, valid, matrix, half_width):
    """Connects consecutive valid states (ticks, 4) of one agent; gaps remain gaps."""
    for k in range(1, len(states)):
        if valid[k - 1] and valid[k]:
            column_0, row_0 = _to_pixel(matrix, states[k - 1, 0], states[k - 1, 1])
            column_1, row_1 = _to_pixel(matrix, states[k, 0], states[k, 1])
            fill_segment(canvas, column_0, row_0, column_1, row_1, half_width, SET)


@njit(cache=True, nogil=True)
@no_type_check
def _write_directions(states, valid, snapshots, cos, sin):
    """Writes cosine and sine (snapshots, agents) of the headings of states (agents, ticks, 4)."""
    for k in range(len(snapshots)):
        for a in range(len(states)):
            if valid[a, snapshots[k]]:
                cos[k, a] = math.cos(states[a, snapshots[k], 2])
                sin[k, a] = math.sin(states[a, snapshots[k], 2])


@njit(cache=True, nogil=True)
@no_type_check
def _unpack_affine(matrix):
    """The entries of a matrix (2, 3) as six numbers, which the compiler holds in registers."""
    return matrix[0, 0], matrix[0, 1], matrix[0, 2], matrix[1, 0], matrix[1, 1], matrix[1, 2]


@njit(cache=True, nogil=True)
@no_type_check
def _to_pixel(affine, x, y):
    """(column, row) of a point of the world, metres."""
    column_x, column_y, column_0, row_x, row_y, row_0 = affine
    return column_x * x + column_y * y + column_0, row_x * x + row_y * y + row_0


@njit(cache=True, nogil=True)
@no_type_check
def _to_pixel_direction(affine, x, y):
    """(column, row) components of a direction of the world, pixels per metre."""
    column_x, column_y, _, row_x, row_y, _ = affine
    return column_x * x + column_y * y, row_x * x + row_y * y


@njit(cache=True, nogil=True)
@no_type_check
def _out_of_sight(height, width, column, row, reach):
    """Whether nothing within `reach` pixels of a point is inside the canvas."""
    beside = abs(column - 0.5 * width) > 0.5 * width + reach
    return beside or abs(row - 0.5 * height) > 0.5 * height + reach
