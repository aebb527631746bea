"""Plugs by name: the entry points of this package and of anybody else's.

A plug is a line in the `pyproject.toml` of the package that ships it:

    [project.entry-points."asp_env.predictors"]
    my-predictor = "my_package.module:MyPredictor"

Groups: `asp_env.predictors`, `asp_env.planners`, `asp_env.drivers` (who moves the traffic),
`asp_env.sources` (schemes of DATA such as `synthetic:`), `asp_env.worlds` (where the data of such a
scheme are driven, unless they are replayed), `asp_env.commands` (sub-commands of `asp-env`).
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
    """The names that a group knows, in alphabetical order."""
    return tuple(sorted(_plugs(group)))


def find(group: Group, name: str) -> Any:
    """The object registered under `name`; its module is imported only now.

    Raises:
        AspEnvError: the name is unknown (known ones are listed), or its module is missing.
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
