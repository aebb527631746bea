"""What goes wrong because of what the user gave: one line, never a traceback."""

import difflib
from collections.abc import Iterable


class AspEnvError(ValueError):
    """Bad input. The message is one line: what was given, what was expected, what to do."""


class DataError(AspEnvError):
    """A recording, map or folder that cannot be read."""


class CheckpointError(AspEnvError):
    """A trained predictor that cannot be loaded."""


class MissingExtraError(AspEnvError, ImportError):
    """A package is needed that the core does not install."""

    def __init__(self, package: str, extra: str, purpose: str) -> None:
        """Names the package, the extra that installs it and what it is for."""
        super().__init__(
            f"{purpose} needs the package {package!r}, which is not installed: "
            f"pip install 'asp-env[{extra}]'"
        )


def unknown_name(kind: str, given: str, known: Iterable[str]) -> AspEnvError:
    """An error that lists the known names of a kind and suggests the nearest one."""
    names = sorted(known)
    near = difflib.get_close_matches(given, names, n=1)
    hint = f" (did you mean {near[0]!r}?)" if near else ""
    return AspEnvError(f"unknown {kind} {given!r}{hint}: known are {', '.join(names)}")
