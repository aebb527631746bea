"""`asp-env COMMAND …`: the commands that this package and others register."""

import contextlib
import io
import re
import sys
from collections.abc import Sequence
from typing import Any

import tyro
from rich.console import Console
from rich.table import Table

from asp_env import registry
from asp_env.errors import AspEnvError

BAD_INPUT = 2

RENAMED_OPTIONS = {
    ("drive", "--most"): "--max-scenarios",
    ("drive", "--metrics"): "--rules",
    ("train", "--preset"): "--recipe",
    ("train", "--drawing"): "--num-workers",
    ("table", "--preset"): "--recipe",
}
"""Old names of options, by command. They work for one more release, with a warning."""


def main(argv: Sequence[str] | None = None) -> int:
    """Runs one command; 0 on success, 2 with one line on stderr for bad input."""
    given = list(sys.argv[1:] if argv is None else argv)
    if not given or given[0] in ("-h", "--help"):
        _list_commands()
        return 0
    name, rest = given[0], given[1:]
    try:
        command = registry.find("commands", name)
        _parse(name, command, _with_current_names(name, rest)).run()
    except AspEnvError as error:
        return _refuse(str(error))
    except OSError as error:
        where = f"{error.filename}: " if error.filename else ""
        return _refuse(f"{where}{error.strerror or error}")
    except KeyboardInterrupt:
        sys.stderr.write("asp-env: interrupted\n")
        return 130
    return 0


def _with_current_names(command: str, args: Sequence[str]) -> list[str]:
    """Replaces deprecated options, each with a warning on stderr."""
    current: list[str] = []
    for arg in args:
        option, equals, value = arg.partition("=")
        renamed = RENAMED_OPTIONS.get((command, option))
        if renamed is not None:
            sys.stderr.write(f"asp-env: {option} is deprecated; use {renamed}\n")
            arg = f"{renamed}{equals}{value}"
        current.append(arg)
    return current


def _parse(name: str, command: Any, rest: Sequence[str]) -> Any:
    """The command with its options.

    Raises:
        AspEnvError: they are not understood; the parser's box of text becomes one line.
    """
    told = io.StringIO()
    try:
        with contextlib.redirect_stderr(told):
            return tyro.cli(command, prog=f"asp-env {name}", args=rest)
    except SystemExit as stop:
        if not stop.code:
            raise
        lines = [line.strip("│─ ") or ";" for line in told.getvalue().splitlines()[1:-1]]
        what = re.split("; (?:For full|Argument) helptext", " ".join(lines).replace(" ;", ";"))[0]
        raise AspEnvError(f"{what.rstrip('.')}; see asp-env {name} --help") from None


def _refuse(message: str) -> int:
    sys.stderr.write(f"asp-env: {' '.join(message.split())}\n")
    return BAD_INPUT


def _list_commands() -> None:
    table = Table(box=None, show_header=False, padding=(0, 2))
    for name in registry.names("commands"):
        try:
            what = registry.find("commands", name).__doc__ or ""
        except AspEnvError as error:
            what = str(error)
        table.add_row(name, what.strip().partition("\n")[0])
    console = Console()
    console.print("usage: asp-env COMMAND …    (asp-env COMMAND --help tells its options)\n")
    console.print(table)


if __name__ == "__main__":
    sys.exit(main())
