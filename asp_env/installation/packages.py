"""Which packages are installed, which extra is missing for what, and plugs of other packages."""

import platform
import re
from collections.abc import Mapping
from dataclasses import dataclass
from importlib import metadata
from typing import get_args

from asp_env import registry
from asp_env.errors import AspEnvError
from asp_env.installation.version import PACKAGE

EXTRAS: Mapping[str, str] = {
    "inference": "trained predictors: mtp, dkm, ffw-asp, ssp-asp, guarded",
    "train": "asp-env train, table, demo",
    "export": "asp-env export",
    "rl": "asp-env rl train, evaluate, compare; planner sb3; asp_env.parallel_env, sb3_vec_env",
    "offline": "asp-env rl demonstrations",
    "synthetic": "data synthetic:…, other suites than highway-v1; asp-env synthesize, demo",
    "report": "asp-env evaluate, drive, study, benchmark, table, demo, which write report.html",
    "highway": "data highway:…, suite highway-v1, asp_env/HighwayIntersection-v0 and the like",
    "parquet": "asp-env study --parquet",
    "ray": "asp-env study --ray",
    "docs": "make docs, the documentation as a site",
    "render": "asp-env watch; videos and windows of environments",
}
"""What each extra of this package is needed for."""

_REQUIREMENT = re.compile(r"(?P<name>[\w.-]+)(\[[\w,]+\])?\s*(?P<versions>[^;]*)(;.*)?$")
_LEAST = re.compile(r">=\s*([\w.]+)")
_EXTRA = re.compile(r"extra == [\"']([\w-]+)[\"']")


@dataclass(frozen=True, slots=True, kw_only=True)
class PackageState:
    """A required package."""

    name: str
    version: str | None
    """The installed version; None if the package is not installed."""
    least: str | None
    """The oldest version that this package admits."""

    @property
    def fits(self) -> bool:
        """Whether the package is installed in a version that is admitted."""
        return self.version is not None and (
            self.least is None or _numbers(self.version) >= _numbers(self.least)
        )

    def __str__(self) -> str:
        """Name, version, and the required version if that is another."""
        if self.version is None:
            return f"{self.name} missing"
        too_old = "" if self.fits else f" (needs {self.least})"
        return f"{self.name} {self.version}{too_old}"


@dataclass(frozen=True, slots=True, kw_only=True)
class ExtraState:
    """An extra of this package, and what it is for."""

    name: str
    purpose: str
    packages: tuple[PackageState, ...]

    @property
    def complete(self) -> bool:
        """Whether all packages of the extra are installed."""
        return all(package.fits for package in self.packages)


@dataclass(frozen=True, slots=True, kw_only=True)
class PlugState:
    """A plug that another package registers."""

    group: registry.Group
    name: str
    package: str
    problem: str | None
    """Why it cannot be imported."""


def required_packages() -> tuple[PackageState, ...]:
    """The packages that the core needs, as installed metadata states them."""
    return _packages_of(None)


def extra_states() -> tuple[ExtraState, ...]:
    """The extras of this package."""
    return tuple(
        ExtraState(name=name, purpose=purpose, packages=_packages_of(name))
        for name, purpose in EXTRAS.items()
    )


def python_problem() -> str | None:
    """Why this version of Python does not suit, or None."""
    try:
        wanted = str(metadata.metadata(PACKAGE)["Requires-Python"] or "")
    except metadata.PackageNotFoundError:
        return f"{PACKAGE} is not installed, so that it has no commands: pip install -e FOLDER"
    least = wanted.removeprefix(">=")
    if _numbers(platform.python_version()) >= _numbers(least):
        return None
    return f"Python {platform.python_version()} is too old, expected {least} or newer"


def plugs_of_other_packages() -> tuple[PlugState, ...]:
    """The plugs that other packages register; each is imported."""
    found = []
    groups: tuple[registry.Group, ...] = get_args(registry.Group)
    for group in groups:
        for name in registry.names(group):
            package = registry.package_of(group, name)
            if package is None or package.split()[0] == PACKAGE:
                continue
            problem = None
            try:
                registry.find(group, name)
            except AspEnvError as error:
                problem = str(error)
            found.append(PlugState(group=group, name=name, package=package, problem=problem))
    return tuple(found)


def _packages_of(extra: str | None) -> tuple[PackageState, ...]:
    """The packages of an extra, with those of the extras that it includes; None means the core."""
    try:
        requirements = metadata.requires(PACKAGE) or []
    except metadata.PackageNotFoundError:
        requirements = []
    found: dict[str, PackageState] = {}
    for requirement in requirements:
        marker = _EXTRA.search(requirement)
        if (marker and marker[1]) != extra:
            continue
        parts = _REQUIREMENT.match(requirement)
        assert parts is not None, requirement
        if parts["name"] == PACKAGE:
            for included in re.findall(r"[\w-]+", (parts[2] or "").strip("[]")):
                found |= {package.name: package for package in _packages_of(included)}
        else:
            least = _LEAST.search(parts["versions"])
            found[parts["name"]] = _state(parts["name"], least and least[1])
    return tuple(found.values())


def _state(name: str, least: str | None) -> PackageState:
    try:
        version = metadata.version(name)
    except metadata.PackageNotFoundError:
        version = None
    return PackageState(name=name, version=version, least=least)


def _numbers(version: str) -> tuple[int, ...]:
    """The release numbers of a version: (2, 13, 0) for `2.13.0+cpu` and (3, 11, 0) for `3.11`."""
    release = re.match(r"[0-9]+(\.[0-9]+)*", version)
    numbers = [int(number) for number in release[0].split(".")] if release else []
    return tuple([*numbers, 0, 0, 0][:3])
