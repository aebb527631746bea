"""The view of `examples/own_view.py`, registered as an installed package would register it."""

from importlib.metadata import EntryPoint

import pytest

from asp_env import registry

OWN = "chauffeurnet-signals"


def register_own_view(
    monkeypatch: pytest.MonkeyPatch, value: str = "examples.own_view:SignalView", name: str = OWN
) -> None:
    """Adds an entry point to the registered views.

    Args:
        monkeypatch: removes it after the test.
        value: module and object of the entry point.
        name: name of the entry point.
    """
    plugs = registry._plugs
    point = EntryPoint(name=name, value=value, group="asp_env.views")

    def with_own(group: registry.Group) -> dict[str, EntryPoint]:
        return plugs(group) | ({name: point} if group == "views" else {})

    monkeypatch.setattr(registry, "_plugs", with_own)
