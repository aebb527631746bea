"""The consoles on which commands print.

They print text as it is: names of folders, recordings and predictors may hold brackets and colons,
which rich reads as markup and as emoji otherwise, and characters that control terminals.
"""

import io
import re
from typing import Any

from rich.console import Console
from rich.text import Text

PIPED_WIDTH = 160
"""Width of tables in characters where the output is no terminal, such as a file or another
program."""

_CONTROLS = re.compile(r"[\x00-\x08\x0b-\x1f\x7f-\x9f\u200e\u200f\u202a-\u202e\u2066-\u2069]")
"""Control characters but tabs and ends of lines, and those that change the direction of text."""


def printable(text: str) -> str:
    r"""The text with escapes such as `\x1b` in the place of characters that control terminals."""
    return _CONTROLS.sub(lambda found: found[0].encode("unicode_escape").decode("ascii"), text)


class _TextConsole(Console):
    """A console without markup."""

    def __init__(self, **options: Any) -> None:
        super().__init__(markup=False, emoji=False, **options)

    def render_str(self, text: str, **options: Any) -> Text:
        """The text as rich shows it."""
        return super().render_str(printable(text), **options)


def text_console(*, stderr: bool = False, width: int | None = None) -> Console:
    """A console for lines and for tables of few columns.

    Args:
        stderr: whether it prints on the standard error, as progress beside results does.
        width: width in characters; None for that of the terminal.
    """
    return _TextConsole(stderr=stderr, width=width)


def table_console() -> Console:
    """A console for wide tables, as wide as the terminal if there is one."""
    console = text_console()
    return console if console.is_terminal else text_console(width=PIPED_WIDTH)


def page_console(width: int) -> Console:
    """A console that prints nowhere and keeps what it is given, to be exported as a page.

    Args:
        width: width in characters.
    """
    return _TextConsole(file=io.StringIO(), record=True, width=width)
