"""Plugs: objects that this package and any other package register by name, as entry points.

A package registers a plug in its `pyproject.toml`:

    [project.entry-points."asp_env.predictors"]
    my-predictor = "my_package.module:MyPredictor"

The groups are:

- `asp_env.predictors`: forecast the targets of a scene;
- `asp_env.planners`: plan the ego's actions;
- `asp_env.drivers`: move the agents other than the ego;
- `asp_env.readers`: find recordings in a folder, see `asp_env.data.readers.found`;
- `asp_env.sources`: data by `scheme:argument`, such as `synthetic:intersection`;
- `asp_env.worlds`: simulate the data of a source that are not replayed, such as `highway:`;
- `asp_env.views`: render scenes for networks;
- `asp_env.commands`: sub-commands of `asp-env`. A name of two words, such as `"rl train"`, is a
  command of a group: `asp-env rl train`.
"""

import re
from collections import Counter
from functools import cache
from importlib.metadata import EntryPoint, entry_points, requires
from typing import Any, Literal

from asp_env.errors import AspEnvError, unknown_name

_PACKAGE_OF_MODULE = {"pygame": "pygame-ce", "sumolib": "eclipse-sumo", "traci": "eclipse-sumo"}
"""Packages that have other names than their modules."""

_OWN = "asp-env"

Group = Literal[
    "predictors", "planners", "drivers", "readers", "sources", "worlds", "views", "commands"
]


@cache
def _plugs(group: Group) -> dict[str, EntryPoint]:
    return {point.name: point for point in entry_points(group=f"asp_env.{group}")}


def names(group: Group) -> tuple[str, ...]:
    """The names registered in a group, in alphabetical order."""
    return tuple(sorted(_plugs(group)))


def package_of(group: Group, name: str) -> str | None:
    """Name and version of the package that registers a name, such as `asp-env 0.1.0`."""
    plug = _plugs(group).get(name)
    return None if plug is None or plug.dist is None else f"{plug.dist.name} {plug.dist.version}"


def described(group: Group, name: str) -> str:
    """A registered plug in messages: `reader 'sind'`, or `reader 'x' of the package other 1.0`."""
    package = package_of(group, name)
    origin = "" if package is None or package.split()[0] == _OWN else f" of the package {package}"
    return f"{group.rstrip('s')} {name!r}{origin}"


def find(group: Group, name: str) -> Any:
    """Imports and returns the object registered under a name.

    Args:
        group: the group.
        name: the registered name.

    Raises:
        AspEnvError: the name is unknown (the message lists all names), a package is missing, or
            the object cannot be imported.
    """
    plugs, kind = _plugs(group), group.rstrip("s")
    if not plugs and not names("commands"):
        raise AspEnvError(
            f"{kind} {name!r} is not registered, since asp-env is imported from a folder that is "
            "not installed: pip install -e FOLDER"
        )
    if name not in plugs:
        raise unknown_name(kind, name, plugs)
    try:
        return plugs[name].load()
    except AspEnvError:
        raise
    except Exception as error:  # a module of another package may raise anything
        missing = error.name if isinstance(error, ModuleNotFoundError) else None
        if missing is not None and not _is_within(plugs[name].module, missing):
            raise AspEnvError(
                f"{described(group, name)} needs the package {missing!r}, which is not "
                f"installed: pip install {_requirement_with(missing)}"
            ) from error
        reason = " ".join(f"{type(error).__name__}: {error}".split())
        raise AspEnvError(
            f"{described(group, name)} cannot be imported from its entry point "
            f"{plugs[name].value} ({reason}): repair the package that registers it, or uninstall it"
        ) from error


def _requirement_with(module: str) -> str:
    """What to install for a missing module: the smallest extra with it, or the package itself."""
    package = _PACKAGE_OF_MODULE.get(module, module).replace("_", "-")
    sizes: Counter[str] = Counter()
    having = set()
    for requirement in requires(_OWN) or ():
        found = re.match(r"([\w.-]+).*extra == [\"'](.+)[\"']", requirement)
        if found and found[1] != _OWN:  # an extra of this package is that extra's own entry
            sizes[found[2]] += 1
            if found[1] == package:
                having.add(found[2])
    if not having:
        return package
    return f"'asp-env[{min(having, key=lambda extra: (sizes[extra], extra))}]'"


def _is_within(module: str, package: str) -> bool:
    """Whether a module is a package, or is in it."""
    return f"{module}.".startswith(f"{package}.")
