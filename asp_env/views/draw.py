"""Drawing boxes and lines into pictures: the compiled part of views.

Pixel coordinates are (column, row) as `asp_env.views.view` defines them. A pixel belongs to a box
when its centre does; left and top edges are inside, right and bottom edges are not, so that boxes
which share an edge share no pixel. No box vanishes: sides are at least one pixel long, and the
pixel that holds the box's centre is always set.

Kernels draw into `out` (targets, channels, height, width) what is `placed`. Binary pictures may be
packed to bits: then each channel is drawn in `plane` (height, width) and packed into `out`; else
`plane` is empty. Pictures in colours are painted in numbers of colours, in channel 0.

All kernels are in this one file because numba's cache watches only the file of the kernel that is
called from Python: another file's change would go unnoticed.

MERGED: Binary pictures as bits: an eighth of the memory on the way from drawing to a network.

Rows are packed one by one, the first pixel into the highest bit (the order of `np.packbits`); the
last byte of a row is filled up with zeros.
"""

import math
from typing import no_type_check

import numpy as np
from jaxtyping import UInt8
from numba import njit

from asp_env.errors import AspEnvError

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
def fill_box(canvas, column, row, along_column, along_row, half_length, half_width, value):
    """Sets the pixels of one box; those outside the canvas are left out.

    Args:
        canvas: (height, width) uint8.
        column: of the box's centre.
        row: of the box's centre.
        along_column: column part of the unit vector along the box's length.
        along_row: row part of that vector.
        half_length: half the length, pixels.
        half_width: half the width, pixels.
        value: of the pixels.
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
        canvas[r, first:end] = value
    if 0 <= row < height and 0 <= column < width:
        canvas[int(row), int(column)] = value


@njit(cache=True, nogil=True)
@no_type_check
def fill_segment(canvas, column_0, row_0, column_1, row_1, half_width, value):
    """Sets the pixels of a thick line with square ends that reach `half_width` beyond the points.

    A half width of 0.75 or more leaves no gap, whatever the direction.
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
    """Packs rows of 0 or 255 to bits, the first pixel into the highest bit.

    Args:
        pixels: (rows, width).
        packed: (rows, ⌈width / 8⌉), written; a last byte that is not full ends with zeros.
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
        if whole > 0:  # the last eight pixels, without those that are packed already
            packed[r, whole] = (_pack_eight(row, width - 8) << (8 - rest)) & 255
        else:
            byte = 0
            for column in range(width):
                byte |= row[column] & (128 >> column)
            packed[r, 0] = byte


@njit(cache=True, nogil=True)
@no_type_check
def _pack_eight(pixels, first):
    """Eight pixels as one byte."""
    word = np.uint64(pixels[first])  # the compiler makes one load of the eight
    for i in range(1, 8):
        word |= np.uint64(pixels[first + i]) << np.uint64(8 * i)
    # The product brings the lowest bit of byte i to bit 63 - i; no two of its terms meet.
    ones = word & np.uint64(0x0101010101010101)
    return (ones * np.uint64(0x8040201008040201)) >> np.uint64(56)


@njit(cache=True, nogil=True)
@no_type_check
def _draw_box(canvas, matrix, scale, x, y, cos, sin, half_length, half_width, value):
    """A box of the world: its middle in metres, its sides in pixels, `scale` pixels to a metre."""
    column, row = locate(matrix, x, y)
    height, width = canvas.shape
    if out_of_sight(height, width, column, row, half_length + half_width + 1.0):
        return
    across, down = turn(matrix, cos, sin)
    fill_box(canvas, column, row, across / scale, down / scale, half_length, half_width, value)


@njit(cache=True, nogil=True)
@no_type_check
def _draw_lines(canvas, matrix, scale, pieces, half_width, value):
    """Straight pieces (pieces, 5): middle x, middle y, cos, sin and half length, metres."""
    for i in range(len(pieces)):
        # Pieces reach beyond their ends by half their width, so that corners close.
        half_length = pieces[i, 4] * scale + half_width
        x, y, cos, sin = pieces[i, 0], pieces[i, 1], pieces[i, 2], pieces[i, 3]
        _draw_box(canvas, matrix, scale, x, y, cos, sin, half_length, half_width, value)


@njit(cache=True, nogil=True)
@no_type_check
def _cleared(channel, plane):
    """Where to draw a channel: in itself, or in `plane`, which is packed into it afterwards."""
    # Channels are cleared one by one, just before they are drawn into: they fit the cache.
    canvas = plane if plane.size > 0 else channel
    canvas[:] = 0
    return canvas


@njit(cache=True, nogil=True)
@no_type_check
def _finish(canvas, plane, channel):
    if plane.size > 0:
        pack_rows(canvas, channel)


@njit(cache=True, nogil=True)
@no_type_check
def draw_boundaries(pieces, map_index, placed, half_width, plane, out):
    """Clears channel 0 of the pictures on one map and draws its lines, half a width in pixels."""
    scale = placed.pixels_per_metre
    for t in range(len(placed.targets)):
        if placed.map_of_target[t] == map_index:
            matrix = affine(placed.pixels_from_world[t])
            canvas = _cleared(out[t, 0], plane)
            _draw_lines(canvas, matrix, scale, pieces, half_width, SET)
            _finish(canvas, plane, out[t, 0])


@njit(cache=True, nogil=True)
@no_type_check
def draw_agents(placed, snapshots, trail_half_width, plane, out):
    """Clears and draws all channels but the map's: box, trail, then one for each snapshot.

    Args:
        placed: the scene.
        snapshots: ticks at which the other agents are drawn; the last is now.
        trail_half_width: pixels; 0 draws no trail.
        plane: memory, or nothing.
        out: pictures.
    """
    states, valid, scale = placed.states, placed.valid, placed.pixels_per_metre
    half_sizes = 0.5 * placed.sizes * scale  # pixels
    agents, now = states.shape[1], states.shape[2] - 1
    cos, sin = np.empty((len(snapshots), agents)), np.empty((len(snapshots), agents))
    turned = -1
    for t in range(len(placed.targets)):
        b, ego = placed.targets[t]
        if not valid[b, ego, now]:
            out[t, 1:] = 0
            continue
        if b != turned:  # all targets of one situation see the same boxes
            turned = b
            _directions(states[b], valid[b], snapshots, cos, sin)
        matrix = affine(placed.pixels_from_world[t])
        canvas = _cleared(out[t, 1], plane)
        # In its own frame the ego always looks the same, so no rounding of its pose may enter.
        length, width = half_sizes[b, ego]
        fill_box(canvas, *placed.anchor, 0.0, -1.0, length, width, SET)
        _finish(canvas, plane, out[t, 1])
        canvas = _cleared(out[t, 2], plane)
        if trail_half_width > 0:
            _draw_trail(canvas, states[b, ego], valid[b, ego], matrix, trail_half_width)
        _finish(canvas, plane, out[t, 2])
        for k in range(len(snapshots)):
            canvas, tick = _cleared(out[t, 3 + k], plane), snapshots[k]
            for a in range(agents):
                if a != ego and valid[b, a, tick]:
                    x, y, c, s = states[b, a, tick, 0], states[b, a, tick, 1], cos[k, a], sin[k, a]
                    length, width = half_sizes[b, a]
                    _draw_box(canvas, matrix, scale, x, y, c, s, length, width, SET)
            _finish(canvas, plane, out[t, 3 + k])


@njit(cache=True, nogil=True)
@no_type_check
def draw_coloured_lines(pieces, map_index, placed, half_width, colour, out):
    """Draws the lines of one map over what is in channel 0 of the pictures on it."""
    scale = placed.pixels_per_metre
    for t in range(len(placed.targets)):
        if placed.map_of_target[t] == map_index:
            matrix = affine(placed.pixels_from_world[t])
            _draw_lines(out[t, 0], matrix, scale, pieces, half_width, colour)


@njit(cache=True, nogil=True)
@no_type_check
def draw_coloured_agents(placed, colours, order, own_colours, out):
    """Draws boxes at all ticks over channel 0: the others, oldest first, then the own.

    Args:
        placed: the scene.
        colours: (situations, agents) of the oldest box of each agent; they go up by 1 a tick.
        order: (situations, agents) slots in the order in which they are drawn at each tick.
        own_colours: of the oldest box of the vehicle that a picture is drawn around.
        out: (targets, 3, height, width).
    """
    states, valid, scale = placed.states, placed.valid, placed.pixels_per_metre
    half_sizes = 0.5 * placed.sizes * scale  # pixels
    agents, ticks = states.shape[1:3]
    cos, sin = np.empty((ticks, agents)), np.empty((ticks, agents))
    turned = -1
    for t in range(len(placed.targets)):
        b, own = placed.targets[t]
        if not valid[b, own, ticks - 1]:
            continue
        if b != turned:
            turned = b
            _directions(states[b], valid[b], np.arange(ticks), cos, sin)
        canvas, matrix = out[t, 0], affine(placed.pixels_from_world[t])
        for own_turn in range(2):
            for k in range(ticks - own_turn):  # the own box now comes last
                for a in order[b]:
                    if (a == own) == (own_turn == 1) and valid[b, a, k]:
                        x, y, c, s = states[b, a, k, 0], states[b, a, k, 1], cos[k, a], sin[k, a]
                        length, width = half_sizes[b, a]
                        colour = k + (own_colours if own_turn else colours[b, a])
                        _draw_box(canvas, matrix, scale, x, y, c, s, length, width, colour)
        length, width = half_sizes[b, own]
        fill_box(canvas, *placed.anchor, 0.0, -1.0, length, width, own_colours + ticks - 1)


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
            fill_segment(canvas, column_0, row_0, column_1, row_1, half_width, SET)


def pack_bits(pictures: UInt8[np.ndarray, "n c h w"]) -> UInt8[np.ndarray, "n c h bytes"]:
    """Packs pixels of 0 or 255 to bits; the width becomes ⌈width / 8⌉.

    A binary view's `draw_packed` gives the same without drawing bytes first, which is faster.
    """
    *shape, width_px = pictures.shape
    packed = np.empty((*shape, -(-width_px // 8)), dtype=np.uint8)
    rows = np.ascontiguousarray(pictures).reshape(-1, width_px)
    pack_rows(rows, packed.reshape(len(rows), packed.shape[-1]))
    return packed


def unpack_bits(
    packed: UInt8[np.ndarray, "n c h bytes"], width_px: int
) -> UInt8[np.ndarray, "n c h w"]:
    """The pictures of which `pack_bits` or `draw_packed` made these bits, 0 or 255.

    Args:
        packed: bits.
        width_px: of the pictures.

    Raises:
        AspEnvError: rows of that width take another number of bytes.
    """
    if packed.shape[-1] != -(-width_px // 8):
        raise AspEnvError(
            f"rows of {packed.shape[-1]} bytes do not hold {width_px} pixels: expected "
            f"{-(-width_px // 8)} bytes, 8 pixels each"
        )
    # 0 - 1 is 255 in bytes.
    return np.negative(np.unpackbits(packed, axis=-1, count=width_px))
