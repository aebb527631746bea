"""The consoles on which commands print.

They print text as it is: names of folders, recordings and predictors may hold brackets and colons,
which rich reads as markup and as emoji otherwise, and characters that control terminals.
"""

import codecs
import io
import re
import sys
import unicodedata
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


_SIMILAR = str.maketrans({"\u2212": "-", "\u2013": "-", "\u2014": "-", "\u00d7": "x"})
"""Letters for minus signs, dashes and the sign of multiplication."""


def similar(error: UnicodeError) -> tuple[str, int]:
    """Letters that every encoding has in the place of those that an encoding lacks, else `?`.

    Raises:
        UnicodeError: the error is not one of encoding.
    """
    if not isinstance(error, UnicodeEncodeError):
        raise error
    missing = error.object[error.start : error.end].translate(_SIMILAR)
    letters = unicodedata.normalize("NFKD", missing)
    shown = (each for each in letters if not unicodedata.combining(each))
    return "".join(each if each.isascii() else "?" for each in shown), error.end


def print_with_any_encoding() -> None:
    """Makes the standard output and the standard error take text that their encodings lack.

    Terminals and files of other encodings than UTF-8 would end a command at `₃`.
    """
    codecs.register_error("asp_env.similar", similar)
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="asp_env.similar")


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
