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

import inspect
import re
import tomllib
import traceback
from collections import Counter
from collections.abc import Callable, Iterable
from functools import cache
from importlib.metadata import (
    EntryPoint,
    PackageNotFoundError,
    distribution,
    entry_points,
    requires,
)
from pathlib import Path
from typing import Any, Literal, Protocol

from asp_env.errors import AspEnvError, StaleInstallError, unknown_name

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
    origin = "" if package is None or _is_own(group, name) else f" of the package {package}"
    return f"{group.rstrip('s')} {name!r}{origin}"


def find(group: Group, name: str) -> Any:
    """Imports and returns the object registered under a name.

    Args:
        group: the group.
        name: the registered name.

    Raises:
        AspEnvError: the name is unknown (the message lists all names), a package is missing, or
            the object cannot be imported.
        StaleInstallError: the name is one of this package, but not of its metadata.
    """
    plugs, kind = _plugs(group), group.rstrip("s")
    if not plugs and not names("commands"):
        raise AspEnvError(
            f"{kind} {name!r} is not registered, since asp-env is imported from a folder that is "
            "not installed: pip install -e FOLDER"
        )
    if not isinstance(name, str) or name not in plugs:
        if name in _declared(group):
            raise _stale_install(kind, name)
        raise unknown_name(kind, name, plugs)
    try:
        return plugs[name].load()
    except AspEnvError:
        raise
    except Exception as error:  # a module of another package may raise anything
        missing = error.name if isinstance(error, ModuleNotFoundError) else None
        if missing is not None and _top(missing) != _top(plugs[name].module):
            raise AspEnvError(
                f"{described(group, name)} needs the package {missing!r}, which is not "
                f"installed: pip install {_requirement_with(missing)}"
            ) from error
        reason = " ".join(f"{type(error).__name__}: {error}".split())
        raise AspEnvError(
            f"{described(group, name)} cannot be imported from its entry point "
            f"{plugs[name].value} ({reason}): repair the package that registers it, or uninstall it"
        ) from error


def module_of(group: Group, name: str) -> str | None:
    """The top-level package of the object that is registered under a name, None if none is."""
    point = _plugs(group).get(name)
    return None if point is None else point.module.partition(".")[0]


@cache
def _declared(group: Group) -> frozenset[str]:
    """The names in the project file of a checkout, which are registered when it is installed."""
    project = Path(__file__).parents[1] / "pyproject.toml"
    try:
        tables = tomllib.loads(project.read_text(encoding="utf-8"))["project"]
        if tables["name"] == "asp-env":
            return frozenset(tables["entry-points"][f"asp_env.{group}"])
    except (OSError, ValueError, KeyError, TypeError):
        pass
    return frozenset()


def _stale_install(kind: str, name: str) -> StaleInstallError:
    root = Path(__file__).parents[1]
    install = f"python -m pip install -e '{root}'"
    try:
        folder = Path(str(distribution("asp-env").locate_file("")))
        found = sorted(folder.glob("asp_env*.egg-info"))
    except PackageNotFoundError:
        found = []
    remedy = f"delete {found[0]} and run {install}" if found else f"run {install}"
    return StaleInstallError(
        f"{kind} {name!r} is part of this version of asp-env, but not of the metadata that were "
        f"installed for it, which are of an earlier version: {remedy}"
    )


def make(group: Group, name: str, call: Callable[[Any], Any], protocol: type) -> Any:
    """Lets the object registered under a name make something, and checks what it makes.

    Args:
        group: the group.
        name: the registered name.
        call: takes the registered object and returns what it makes.
        protocol: what is to be made.

    Raises:
        AspEnvError: the name is unknown, the object refuses, or, if another package registers it,
            it fails in any other way or makes something that lacks a part of the protocol. The
            message names the package.
    """
    plug = find(group, name)
    try:
        made = call(plug)
    except (AspEnvError, OSError):
        raise
    except Exception as error:  # another package may raise anything
        if package_of(group, name) is None or _is_own(group, name):
            raise
        last = traceback.extract_tb(error.__traceback__)[-1]
        reason = " ".join(f"{type(error).__name__}: {error}".split())
        raise AspEnvError(
            f"{described(group, name)} cannot be made ({reason}, at {last.filename}:"
            f"{last.lineno}): repair the package, or uninstall it"
        ) from error
    parts = {part for base in protocol.__mro__ for part in (*vars(base), *_fields(base))}
    parts -= set(dir(Protocol))
    missing = sorted(part for part in parts if part[0] != "_" and not hasattr(made, part))
    if missing:
        raise AspEnvError(
            f"{described(group, name)} is no {protocol.__name__}: {type(made).__name__} lacks "
            f"{', '.join(missing)}"
        )
    return made


def _fields(kind: type) -> Iterable[str]:
    return inspect.get_annotations(kind)


def _is_own(group: Group, name: str) -> bool:
    """Whether this package registers a name."""
    return (package_of(group, name) or "").split()[:1] == [_OWN]


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


def _top(module: str) -> str:
    """The package that a module is in."""
    return module.partition(".")[0]
