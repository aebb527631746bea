"""A line that says why the first use of an environment takes long."""

import logging
import multiprocessing
import sys
from typing import Any

from numba.core import event

KIND = "numba:compile"
"""The event of a compilation; numba does not send it where it loads a kernel from its cache."""

_logger = logging.getLogger("asp_env")


class CompilationNotice(event.Listener):
    """Logs one line at the first compilation of a kernel of this package."""

    def __init__(self) -> None:
        self._is_due = True

    def on_start(self, event: Any) -> None:
        """Logs the line if it is due."""
        module = event.data["dispatcher"].py_func.__module__
        if self._is_due and module.split(".")[0] == __name__.split(".")[0]:
            self._is_due = False
            _logger.warning(
                "asp_env: compiling, once after an installation or an update; this takes up to "
                "half a minute."
            )

    def on_end(self, event: Any) -> None:
        """Does nothing."""


_notice: CompilationNotice | None = None


def announce_compilation() -> None:
    """From now on announces the first compilation, once per process.

    Only where a person may be waiting: in the main process, on a terminal or in a notebook.
    """
    global _notice
    is_interactive = sys.stderr.isatty() or hasattr(sys, "ps1") or "ipykernel" in sys.modules
    if _notice is None and is_interactive and multiprocessing.parent_process() is None:
        _notice = CompilationNotice()
        event.register(KIND, _notice)
