"""The console on which commands print wide tables."""

from rich.console import Console

PIPED_WIDTH = 160
"""Width in characters where the output is no terminal, such as a file or another program."""


def table_console() -> Console:
    """A console on the standard output, as wide as the terminal if there is one."""
    console = Console()
    return console if console.is_terminal else Console(width=PIPED_WIDTH)
