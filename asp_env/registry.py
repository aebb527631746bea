"""Plugs: objects that this package and any other package register by name, as entry points.

A package registers a plug in its `pyproject.toml`:

    [project.entry-points."asp_env.predictors"]
    my-predictor = "my_package.module:MyPredictor"

The groups are:

- `asp_env.predictors`: forecast the targets of a scene;
- `asp_env.planners`: plan the ego's actions;
- `asp_env.drivers`: move the agents other than the ego;
- `asp_env.sources`: data by `scheme:argument`, such as `synthetic:intersection`;
- `asp_env.worlds`: simulate the data of a source that are not replayed, such as `highway:`;
- `asp_env.commands`: sub-commands of `asp-env`.
"""

from functools import cache
from importlib.metadata import EntryPoint, entry_points
from typing import Any, Literal

from asp_env.errors import AspEnvError, unknown_name

Group = Literal["predictors", "planners", "drivers", "sources", "worlds", "commands"]


@cache
def _plugs(group: Group) -> dict[str, EntryPoint]:
    return {point.name: point for point in entry_points(group=f"asp_env.{group}")}


def names(group: Group) -> tuple[str, ...]:
    """The names registered in a group, in alphabetical order."""
    return tuple(sorted(_plugs(group)))


def find(group: Group, name: str) -> Any:
    """Imports and returns the object registered under a name.

    Args:
        group: the group.
        name: the registered name.

    Raises:
        AspEnvError: the name is unknown (the message lists all names), or a package is missing.
    """
    plugs = _plugs(group)
    if name not in plugs:
        raise unknown_name(group.rstrip("s"), name, plugs)
    try:
        return plugs[name].load()
    except ModuleNotFoundError as error:
        raise AspEnvError(
            f"{group.rstrip('s')} {name!r} needs the package {error.name!r}, which is not "
            "installed: pip install 'asp-env[all]'"
        ) from error
