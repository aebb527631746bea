"""The consoles on which commands print.

They print text as it is: names of folders, recordings and predictors may hold brackets and colons,
which rich reads as markup and as emoji otherwise.
"""

import io
from functools import partial

from rich.console import Console

PIPED_WIDTH = 160
"""Width of tables in characters where the output is no terminal, such as a file or another
program."""

_Console = partial(Console, markup=False, emoji=False)


def text_console(*, stderr: bool = False, width: int | None = None) -> Console:
    """A console for lines and for tables of few columns.

    Args:
        stderr: whether it prints on the standard error, as progress beside results does.
        width: width in characters; None for that of the terminal.
    """
    return _Console(stderr=stderr, width=width)


def table_console() -> Console:
    """A console for wide tables, as wide as the terminal if there is one."""
    console = text_console()
    return console if console.is_terminal else text_console(width=PIPED_WIDTH)


def page_console(width: int) -> Console:
    """A console that prints nowhere and keeps what it is given, to be exported as a page.

    Args:
        width: width in characters.
    """
    return _Console(file=io.StringIO(), record=True, width=width)
