"""Hashes of the code, the plugs and the weights that a result depends on."""

import hashlib
import platform
import re
from collections.abc import Iterable
from functools import cache
from importlib import metadata
from importlib.util import find_spec
from pathlib import Path

from asp_env import registry
from asp_env.errors import AspEnvError
from asp_env.evaluation.results import PACKAGES
from asp_env.registry import Group

CORE = "asp_env"
"""Package that every result depends on."""

_SEPARATORS = re.compile(r"[:,=]")
_NOT_WEIGHTS = (".csv", ".md", ".log")
"""Suffixes of files in a run folder that do not influence what the run predicts."""


def versions() -> dict[str, str]:
    """Versions of Python and of the packages that results can depend on in their last bits."""
    found = {"python": platform.python_version()}
    for package in PACKAGES:
        try:
            found[package] = metadata.version(package)
        except metadata.PackageNotFoundError:
            continue
    return found


@cache
def package_hash(package: str) -> str:
    """SHA-256 of the Python files of an installed package or module.

    Args:
        package: name of a top-level package.
    """
    spec = find_spec(package)
    if spec is None:
        return ""
    if spec.submodule_search_locations is None:
        return _hash_of([Path(spec.origin)] if spec.origin else [])
    files = [
        path for place in spec.submodule_search_locations for path in Path(place).rglob("*.py")
    ]
    return _hash_of(files)


def registered_code(*groups: Group) -> list[str]:
    """Hashes of all packages that register something in some groups."""
    packages = {
        registry.module_of(group, name) for group in groups for name in registry.names(group)
    }
    return sorted(package_hash(each) for each in packages if each is not None)


def identity(name: str, groups: Iterable[Group]) -> list[str]:
    """What the results of a plug depend on besides its name.

    Args:
        name: name with its arguments, such as `delayed:2:ffw-asp:runs/0` or
            `default=idm,truck=predictor:ffw-asp:runs/0`.
        groups: groups that the parts of the name may be registered in.

    Returns:
        For each registered part of the name, in order, the hash of the package that registers it;
        for each part that is a path, the hash of its content.

    Raises:
        AspEnvError: a file cannot be read.
    """
    found: list[str] = []
    for part in _SEPARATORS.split(name):
        packages = {registry.module_of(group, part) for group in groups} - {None}
        found += sorted(package_hash(each) for each in packages if each is not None)
        path = Path(part.partition("@")[0])
        if not packages and path.name and path.exists():
            found.append(content_hash(path))
    return found


@cache
def content_hash(path: Path) -> str:
    """SHA-256 of a file, or of the files in a run folder that its predictions depend on.

    Raises:
        AspEnvError: a file cannot be read.
    """
    if path.is_file():
        return _hash_of([path])
    return _hash_of(
        each
        for each in path.iterdir()
        if each.is_file()
        and each.suffix not in _NOT_WEIGHTS
        and not each.name.startswith((".", "events.out"))
    )


def _hash_of(files: Iterable[Path]) -> str:
    total = hashlib.sha256()
    for path in sorted(files):
        try:
            content = path.read_bytes()
        except OSError as error:
            raise AspEnvError(f"{path}: cannot be read: {error.strerror}") from error
        total.update(f"{path.name}\0{len(content)}\0".encode())
        total.update(content)
    return total.hexdigest()
