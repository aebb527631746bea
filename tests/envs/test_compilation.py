"""The line about the compilation of kernels."""

import logging
import sys

import pytest
from numba import njit
from numba.core import event

from asp_env.envs import compilation


@pytest.fixture
def notice():
    """A registered notice."""
    made = compilation.CompilationNotice()
    event.register(compilation.KIND, made)
    yield made
    event.unregister(compilation.KIND, made)


def _kernel(module: str):
    def double(x):
        return 2 * x

    double.__module__ = module
    return njit(double)


@pytest.mark.usefixtures("notice")
def test_the_first_compilation_of_the_package_is_announced_once(caplog):
    """Kernels of other packages are not, and neither are calls of compiled kernels."""
    caplog.set_level(logging.WARNING, logger="asp_env")
    _kernel("other.module")(1)
    assert not caplog.records
    kernel = _kernel("asp_env.some.module")
    assert kernel(1) == 2
    assert kernel(2.0) == 4.0
    assert [record.getMessage() for record in caplog.records] == [
        "asp_env: compiling, once after an installation or an update; this takes up to half a "
        "minute."
    ]


@pytest.mark.parametrize("interactive", [True, False])
def test_only_a_person_is_told(monkeypatch, interactive):
    """At a terminal, or at a Python prompt."""
    monkeypatch.setattr(compilation, "_notice", None)
    registered = []
    monkeypatch.setattr(compilation.event, "register", lambda *args: registered.append(args))
    monkeypatch.delattr(sys, "ps1", raising=False)
    monkeypatch.setattr(sys.stderr, "isatty", lambda: interactive, raising=False)
    for _ in range(2):
        compilation.announce_compilation()
    assert len(registered) == interactive
