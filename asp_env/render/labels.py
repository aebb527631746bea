"""Words on a picture: a caption, what is wrong, a scale, a legend, and a line of time."""

from collections.abc import Sequence

from asp_env.render.canvas import SHADE, Canvas, Colour

TEXT: Colour = (226, 232, 241)
FAINT: Colour = (170, 182, 200)
MIN_WORDS_PX = 200
"""Smaller pictures have no room for words."""
MARGIN_PX = 14.0
LINE_PX = 21.0
TIME_LINE_PX = 6.0
"""Height of the line of time, below everything else."""


def draw_labels(canvas: Canvas, words: Sequence[str], alarms: Sequence[tuple[str, Colour]]) -> None:
    """A caption above at the left, alarms above at the right, a bar of a round length below."""
    if canvas.small_side_px < MIN_WORDS_PX:
        return
    for number, line in enumerate(words):
        canvas.text(line, MARGIN_PX, 26 + number * LINE_PX, TEXT if number == 0 else FAINT)
    for number, (what, colour) in enumerate(alarms):
        _badge(canvas, what, 26 + number * (LINE_PX + 9), colour)
    _scale_bar(canvas)


def _badge(canvas: Canvas, what: str, row: float, colour: Colour) -> None:
    """Dark words on a bright field at the right edge."""
    width = canvas.text_width(what)
    right = canvas.width - MARGIN_PX
    canvas.field(right - width - 16, row - 16, right, row + 8, colour)
    canvas.text(what, right - width - 8, row, SHADE, rim=False)


def _scale_bar(canvas: Canvas) -> None:
    scale = canvas.frame.pixels_per_metre / canvas.unit
    metres = next((m for m in (1, 2, 5, 10, 20, 50, 100, 200, 500) if m * scale > 60), 1000)
    row, end = canvas.height - MARGIN_PX, MARGIN_PX + metres * scale
    for grow, colour in ((1.0, SHADE), (0.0, TEXT)):
        left, right = MARGIN_PX - grow, end + grow
        canvas.field(left, row - 2 - grow, right, row + grow, colour)
        for tip in (MARGIN_PX, end - 1):
            canvas.field(tip - grow, row - 7 - grow, tip + 1 + grow, row + grow, colour)
    canvas.text(f"{metres} m", MARGIN_PX + 6, row - 8, TEXT)


def draw_legend(canvas: Canvas, entries: Sequence[tuple[str, Colour]]) -> None:
    """What colours mean, below at the right."""
    if canvas.small_side_px < 2 * MIN_WORDS_PX:
        return
    right = canvas.width - MARGIN_PX
    row = canvas.height - MARGIN_PX - 6
    for what, colour in reversed(entries):
        right -= canvas.text_width(what)
        canvas.text(what, right, row, TEXT)
        canvas.field(right - 27, row - 8, right - 7, row - 2, SHADE)
        canvas.field(right - 26, row - 7, right - 8, row - 3, colour)
        right -= 44


def draw_hint(canvas: Canvas, words: str) -> None:
    """Words below in the middle, above the legend."""
    width = canvas.text_width(words)
    if words and canvas.width > width:
        canvas.text(words, (canvas.width - width) / 2, canvas.height - 3 * LINE_PX, TEXT)


def draw_time_line(
    canvas: Canvas, done: float, spells: Sequence[tuple[float, float, Colour]]
) -> None:
    """A bar along the lower edge.

    Args:
        canvas: what is drawn on.
        done: the share of the time that has passed.
        spells: (from, to, colour) of what went wrong, as shares of the time; later ones on top.
    """
    height, width = canvas.height, canvas.width
    top = height - TIME_LINE_PX
    canvas.field(0.0, top, width, height, SHADE)
    canvas.field(0.0, top, done * width, height, FAINT)
    for begin, end, colour in spells:
        left = min(begin * width, width - 5)
        canvas.field(left, top, max(end * width, left + 5), height, colour)
    canvas.field(done * width - 1.5, top - 2, done * width + 1.5, height, TEXT)
