"""Which pixels boxes and lines set, and packing of pixels to bits."""

import math

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from asp_env.views.draw import fill_box, fill_segment, pack_rows

HEIGHT, WIDTH = 20, 30


def draw_box(
    column: float, row: float, angle: float, half_length: float, half_width: float
) -> np.ndarray:
    """Mask of the pixels that a box sets on an empty canvas."""
    canvas = np.zeros((HEIGHT, WIDTH), dtype=np.uint8)
    fill_box(canvas, column, row, math.cos(angle), math.sin(angle), half_length, half_width, 255)
    assert set(np.unique(canvas)) <= {0, 255}
    return canvas > 0


def depth(column: float, row: float, angle: float, half_length: float, half_width: float):
    """Depth (height, width) of every pixel centre inside the box, negative outside."""
    rows, columns = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    along = math.cos(angle) * (columns - column) + math.sin(angle) * (rows - row)
    across = math.cos(angle) * (rows - row) - math.sin(angle) * (columns - column)
    return np.minimum(half_length - abs(along), half_width - abs(across))


def test_unit_square() -> None:
    """A box of 1 by 1 around the centre of pixel (row 4, column 7) sets that pixel."""
    expected = np.zeros((HEIGHT, WIDTH), dtype=bool)
    expected[4, 7] = True
    np.testing.assert_array_equal(draw_box(7.5, 4.5, 0.0, 0.5, 0.5), expected)


@pytest.mark.parametrize("quarter", [0, 1, 2, 3])
def test_square_of_five(quarter: int) -> None:
    """A box over rows 3 to 8 and columns 10 to 15 sets those 25 pixels, at each right angle."""
    expected = np.zeros((HEIGHT, WIDTH), dtype=bool)
    expected[3:8, 10:15] = True
    angle = 0.5 * math.pi * quarter
    np.testing.assert_array_equal(draw_box(12.5, 5.5, angle, 2.5, 2.5), expected)


def test_boxes_that_share_an_edge_share_no_pixel() -> None:
    """Pixel centres on the common edge belong to exactly one of the two boxes."""
    left = draw_box(8.5, 10.0, 0.0, 2.0, 3.0)
    right = draw_box(12.5, 10.0, 0.0, 2.0, 3.0)
    assert not (left & right).any()
    np.testing.assert_array_equal(left | right, draw_box(10.5, 10.0, 0.0, 4.0, 3.0))


def test_diamond() -> None:
    """A square of half diagonal 2.6 on its corner has rows of 1, 3, 5, 3 and 1 pixels."""
    half = 2.6 / math.sqrt(2)
    assert draw_box(15.5, 9.5, 0.25 * math.pi, half, half).sum(axis=1).tolist() == [
        *[0] * 7,
        *[1, 3, 5, 3, 1],
        *[0] * 8,
    ]


@given(
    column=st.floats(-10, 40),
    row=st.floats(-10, 30),
    angle=st.floats(-7, 7),
    half_length=st.floats(0.8, 12),
    half_width=st.floats(0.8, 12),
)
def test_pixels_whose_centre_is_inside_are_set(
    column: float, row: float, angle: float, half_length: float, half_width: float
) -> None:
    """Exactly these pixels are set, also of boxes that the border cuts."""
    box = (column, row, angle, half_length, half_width)
    inside = depth(*box)
    decided = abs(inside) > 1e-6
    np.testing.assert_array_equal(draw_box(*box)[decided], (inside > 0)[decided])


@given(
    column=st.floats(0, WIDTH, exclude_max=True),
    row=st.floats(0, HEIGHT, exclude_max=True),
    angle=st.floats(-7, 7),
    half=st.floats(0, 0.5),
)
def test_small_boxes_do_not_vanish(column: float, row: float, angle: float, half: float) -> None:
    """A box of at most one pixel sets the pixel that contains its centre, and at most four."""
    drawn = draw_box(column, row, angle, half, half)
    assert drawn[int(row), int(column)]
    assert drawn.sum() <= 4


@pytest.mark.parametrize(
    ("index", "bad"),
    [(index, math.nan) for index in range(4)]
    + [(index, bad) for index in (0, 1) for bad in (math.inf, -math.inf, 1e300)],
)
def test_numbers_that_are_not_finite_draw_nothing(index: int, bad: float) -> None:
    """NaN in the centre or direction and a centre at infinity leave the canvas empty."""
    numbers = [5.0, 5.0, 1.0, 0.0, 2.0, 1.0]
    numbers[index] = bad
    canvas = np.zeros((HEIGHT, WIDTH), dtype=np.uint8)
    fill_box(canvas, *numbers, value=255)
    assert not canvas.any()


@given(
    ends=st.tuples(st.floats(0, 29), st.floats(0, 19), st.floats(0, 29), st.floats(0, 19)),
)
def test_lines_have_no_gaps(ends: tuple[float, float, float, float]) -> None:
    """A line 1.5 pixels wide is one connected component that contains both ends."""
    canvas = np.zeros((HEIGHT, WIDTH), dtype=np.uint8)
    fill_segment(canvas, *ends, 0.75, 255)
    components, labels = cv2.connectedComponents(canvas, connectivity=8)
    assert components == 2  # the background and the line
    assert labels[int(ends[1]), int(ends[0])] == labels[int(ends[3]), int(ends[2])] == 1


def test_lines_extend_half_their_width_beyond_their_ends() -> None:
    """From (4, 10) to (8, 10), 2 pixels wide: rows 9 and 10, columns 3 to 8."""
    canvas = np.zeros((HEIGHT, WIDTH), dtype=np.uint8)
    fill_segment(canvas, 4.0, 10.0, 8.0, 10.0, 1.0, 255)
    expected = np.zeros((HEIGHT, WIDTH), dtype=bool)
    expected[9:11, 3:9] = True
    np.testing.assert_array_equal(canvas > 0, expected)


def packed(pixels: np.ndarray) -> np.ndarray:
    """The rows of pixels (rows, width) as bits."""
    out = np.empty((len(pixels), -(-pixels.shape[1] // 8)), dtype=np.uint8)
    pack_rows(pixels, out)
    return out


def test_bits_by_hand() -> None:
    """Of ten pixels the first, the eighth and the last are set: 1000 0001 and 0100 0000."""
    pixels = np.zeros((1, 10), dtype=np.uint8)
    pixels[0, [0, 7, 9]] = 255
    assert packed(pixels).tolist() == [[0b10000001, 0b01000000]]


@given(
    shape=st.tuples(st.integers(0, 6), st.integers(1, 40)),
    seed=st.integers(0, 1000),
    share=st.sampled_from([0.0, 0.1, 0.5, 1.0]),
)
def test_bits_are_those_of_numpy(shape: tuple[int, int], seed: int, share: float) -> None:
    pixels = np.where(np.random.default_rng(seed).random(shape) < share, 255, 0).astype(np.uint8)
    np.testing.assert_array_equal(packed(pixels), np.packbits(pixels, axis=-1))
