"""Errors caused by user input. Commands print their message, one line, instead of a traceback."""

import difflib
from collections.abc import Iterable


class AspEnvError(ValueError):
    """Invalid input. The one-line message states what was given, what was expected, what to do."""


class DataError(AspEnvError):
    """A recording, map or folder that cannot be read."""


class RepairWarning(UserWarning):
    """Files contain faults that a reader repaired, or parts that it left out or guessed."""


class CheckpointError(AspEnvError):
    """A trained predictor that cannot be loaded."""


class MissingExtraError(AspEnvError, ImportError):
    """A package is missing that only an optional extra installs."""

    def __init__(self, package: str, extra: str, purpose: str) -> None:
        """Composes the message.

        Args:
            package: the missing package.
            extra: the extra of asp-env that installs it.
            purpose: what needs the package.
        """
        super().__init__(
            f"{purpose} needs the package {package!r}, which is not installed: "
            f"pip install 'asp-env[{extra}]'"
        )


class StaleInstallError(AspEnvError):
    """The metadata of the installed package are older than its code, and lack names of it."""


class LeftOutWarning(UserWarning):
    """Recordings of DATA that cannot be read are left out. An error with `--strict`."""


def unknown_name(kind: str, given: object, known: Iterable[str]) -> AspEnvError:
    """An error that suggests the most similar known name and lists all of them.

    Args:
        kind: what the name stands for, such as `predictor`.
        given: the unknown name, or what was given in its place.
        known: all known names.
    """
    names = sorted(known)
    near = difflib.get_close_matches(given, names, n=1) if isinstance(given, str) else []
    hint = f" (did you mean {near[0]!r}?)" if near else ""
    return AspEnvError(f"unknown {kind} {given!r}{hint}: known are {', '.join(names)}")
