"""`asp-env completion`: a script with which a shell completes commands, options and choices."""

import contextlib
import io
import re
import sys
from dataclasses import dataclass
from typing import Annotated, Any, Literal, Union

import tyro

from asp_env import registry
from asp_env.errors import AspEnvError

_NEWLINES = re.compile(r"\\+n")
_SPECIFICATION = "COMPLETION_SPEC = "


@dataclass(frozen=True, slots=True, kw_only=True)
class Completion:
    """Print a completion script for a shell.

    bash: asp-env completion bash > ~/.local/share/bash-completion/completions/asp-env

    zsh:  asp-env completion zsh > FOLDER/_asp-env, where FOLDER is in $fpath

    fish: asp-env completion fish > ~/.config/fish/completions/asp-env.fish

    The script has the commands of all packages that are installed now.
    """

    shell: Annotated[Literal["bash", "zsh", "fish"], tyro.conf.Positional]
    """The shell."""

    def run(self) -> None:
        """Prints the script."""
        sys.stdout.write(completion_script(self.shell))


def completion_script(shell: Literal["bash", "zsh", "fish"]) -> str:
    """The script for a shell. Commands that cannot be imported are left out."""
    script = io.StringIO()
    with contextlib.redirect_stdout(script), contextlib.suppress(SystemExit):
        tyro.cli(_all_commands(), prog="asp-env", args=["--tyro-print-completion", shell])
    return "".join(
        _NEWLINES.sub(" ", line) if _SPECIFICATION in line else line  # scripts split descriptions
        for line in script.getvalue().splitlines(keepends=True)
    )


def _all_commands() -> Any:
    """A union of all commands, in which groups such as `rl` are unions themselves."""
    tree: dict[str, Any] = {}
    for name in registry.names("commands"):
        *groups, command = name.split()
        branch = tree
        for group in groups:
            branch = branch.setdefault(group, {})
        with contextlib.suppress(AspEnvError):
            branch[command] = registry.find("commands", name)
    return _union(tree)


def _union(tree: dict[str, Any]) -> Any:
    parts = [
        Annotated[
            _union(part) if isinstance(part, dict) else part,
            tyro.conf.subcommand(name, prefix_name=False),
        ]
        for name, part in tree.items()
    ]
    return Union[tuple(parts)]  # noqa: UP007 (the members are not known before)
