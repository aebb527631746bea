"""Suites: frozen sets of interactive scenarios, on which rows of different authors are comparable.

A suite is traffic from a fixed seed and a list of scenarios. The traffic is made on first use
(`suite`); the list is stored in this folder and names each recording by its content
(`python -m scenarios.suites.freeze`).
"""

from scenarios.suites.suite import SUITES, open_source

__all__ = ["SUITES", "open_source"]
