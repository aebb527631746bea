"""Which world DATA is driven in."""

from asp_env import registry
from asp_env.data.source import scheme_of
from asp_env.sim.replay import ReplayWorld
from asp_env.sim.scenario_world import ScenarioWorld


def world_of(source: str) -> type[ScenarioWorld]:
    """The world that a package registers for the scheme of DATA; else recordings are replayed.

    Raises:
        AspEnvError: a package that this world needs is missing.
    """
    scheme = scheme_of(source)
    if scheme is None or scheme not in registry.names("worlds"):
        return ReplayWorld
    return registry.find("worlds", scheme)
