"""The command `asp-env COMMAND …`, with the commands that this and other packages register."""

import contextlib
import io
import os
import re
import sys
import warnings
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import tyro
from rich.table import Table
from tyro.constructors import ConstructorRegistry, PrimitiveConstructorSpec, PrimitiveTypeInfo

from asp_env import registry
from asp_env.console import print_with_any_encoding, printable, text_console
from asp_env.errors import AspEnvError, LeftOutWarning
from asp_env.installation.version import version_line

PLUGS_OF_OPTION: Mapping[str, registry.Group] = {
    "predictor": "predictors",
    "predictors": "predictors",
    "planner": "planners",
    "traffic": "drivers",
    "view": "views",
    "data": "readers",
}
"""Groups of plugs that options of commands name; `--help` lists them."""

BAD_INPUT = 2
"""Exit status for input that a command rejects."""

SPIN_COUNT = "10000"
"""How often a thread of torch looks for work before it sleeps, some tens of microseconds. The
default is 300,000 times: where other processes use the cores, two threads then spend several times
the CPU time of one, waiting for each other. Results do not depend on it."""

HELP = ("-h", "--help")

VERSION = "--version"

STRICT = "--strict"
"""Option of every command: a recording that cannot be read is an error."""

RENAMED_OPTIONS = {
    ("drive", "--most"): "--max-scenarios",
    ("drive", "--metrics"): "--rules",
    ("train", "--preset"): "--recipe",
    ("train", "--drawing"): "--num-workers",
    ("table", "--preset"): "--recipe",
}
"""Deprecated options by command. They work for one more release, with a warning."""


_CONSTRUCTORS = ConstructorRegistry()
"""How values of options are made from their texts, besides tyro's own rules."""


@_CONSTRUCTORS.primitive_rule
def _path_rule(info: PrimitiveTypeInfo) -> PrimitiveConstructorSpec[Path] | None:
    """A path is not empty: `Path("")` is the current folder, not what an empty "$OUT" means."""
    return None if info.type is not Path else _PATH


def _path(texts: list[str]) -> Path:
    if not texts[0]:
        raise ValueError("the value is empty, expected a path")
    return Path(texts[0])


_PATH = PrimitiveConstructorSpec(
    nargs=1,
    metavar="PATH",
    instance_from_str=_path,
    is_instance=lambda value: isinstance(value, Path),
    str_from_instance=lambda path: [str(path)],
)


def main(argv: Sequence[str] | None = None) -> int:
    """Runs one command.

    Args:
        argv: the command and its options, by default those of the process.

    Returns:
        The exit status: 0 on success or that of the command, 2 with one line on stderr for bad
        input, 130 when interrupted.
    """
    if argv is None:
        print_with_any_encoding()
        if "OMP_WAIT_POLICY" not in os.environ:
            os.environ.setdefault("GOMP_SPINCOUNT", SPIN_COUNT)
    args = list(sys.argv[1:] if argv is None else argv)
    if args[:1] == [VERSION]:
        sys.stdout.write(f"{version_line()}\n")
        return 0
    group = args.pop(0) if args and args[0] in _groups() else ""
    if not args or args[0] in HELP:
        _print_commands(group)
        return 0
    name, options = f"{group} {args[0]}".strip(), args[1:]
    try:
        command = registry.find("commands", name)
        strict = STRICT in options
        options = _with_current_names(name, [option for option in options if option != STRICT])
        with _one_line_warnings(strict=strict):
            status = _parse(name, command, options).run()
    except AspEnvError as error:
        return _report(str(error))
    except LeftOutWarning as warning:
        return _report(str(warning).removesuffix("; left out"))
    except OSError as error:
        path = f"{error.filename}: " if error.filename else ""
        return _report(f"{path}{error.strerror or error}")
    except KeyboardInterrupt:
        sys.stderr.write("asp-env: interrupted\n")
        return 130
    return status or 0


@contextlib.contextmanager
def _one_line_warnings(*, strict: bool) -> Iterator[None]:
    """Prints warnings as one line each, and equal ones once.

    Commands open the same data in several environments, each of which would repeat their repairs.

    Args:
        strict: whether recordings that are left out are errors.
    """
    before = warnings.formatwarning
    shown: set[str] = set()

    def line(message: object, *_args: object, **_options: object) -> str:
        text = f"asp-env: warning: {printable(' '.join(str(message).split()))}\n"
        if text in shown:
            return ""
        shown.add(text)
        return text

    with warnings.catch_warnings():
        if strict:
            warnings.simplefilter("error", LeftOutWarning)
        warnings.formatwarning = line
        try:
            yield
        finally:
            warnings.formatwarning = before


def _groups() -> set[str]:
    """The first words of the commands whose names have two."""
    return {name.split()[0] for name in registry.names("commands") if " " in name}


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


def _parse(name: str, command: Any, args: Sequence[str]) -> Any:
    """Returns the command with its options.

    Raises:
        AspEnvError: an option is unknown, missing or invalid, in one line instead of tyro's box.
    """
    stderr = io.StringIO()
    try:
        with contextlib.redirect_stderr(stderr):
            return tyro.cli(command, prog=f"asp-env {name}", args=args, registry=_CONSTRUCTORS)
    except SystemExit as stop:
        if not stop.code:
            _print_plugs(command)
            raise
        problem = _without_box(stderr.getvalue())
        raise AspEnvError(f"{problem}; see asp-env {name} --help") from None


def _without_box(text: str) -> str:
    """The problem that tyro states in a box, as one line.

    The lines of the box are dashes where the encoding of stdout has no others. Of an optional
    value, tyro also states that it is not None.
    """
    lines = [line.strip("│ ") for line in text.splitlines()[1:-1]]
    joined = " ".join(line if line.strip("─-") else ";" for line in lines).strip("; ")
    problem = re.split("; (?:For full|Argument) helptext", joined.replace(" ;", ";"))[0]
    problem = re.sub(
        r"no type matching .*does not match choices \('None',\) - [^:]+: ", "", problem
    )
    return re.sub(r"\[/?bold\]", "", problem).rstrip(".")


def _print_plugs(command: Any) -> None:
    """Prints the registered names that options of a command take, of all installed packages."""
    options = getattr(command, "__annotations__", {})
    groups: dict[registry.Group, None] = {
        PLUGS_OF_OPTION[name]: None for name in options if name in PLUGS_OF_OPTION
    }
    for group in groups:
        sys.stdout.write(f"{group}: {', '.join(registry.names(group))}\n")


def _report(message: str) -> int:
    sys.stderr.write(f"asp-env: {printable(' '.join(message.split()))}\n")
    return BAD_INPUT


def _print_commands(group: str = "") -> None:
    """Prints the commands of a group, by default all commands."""
    table = Table(box=None, show_header=False, padding=(0, 2))
    for name in registry.names("commands"):
        if not f"{name} ".startswith(f"{group} ".lstrip()):
            continue
        try:
            description = registry.find("commands", name).__doc__ or ""
        except AspEnvError as error:
            description = str(error)
        table.add_row(name, description.strip().partition("\n")[0])
    console = text_console()
    prog = f"asp-env {group}".strip()
    console.print(f"usage: {prog} COMMAND …    ({prog} COMMAND --help lists its options)\n")
    console.print(table)
    console.print(
        f"\nasp-env {VERSION} prints versions and platform.\n"
        f"{STRICT}, with every command: a recording of DATA that cannot be read is an error; "
        "without it, the recording is left out with a warning."
    )


if __name__ == "__main__":
    sys.exit(main())
