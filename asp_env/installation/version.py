"""The line of `asp-env --version`: package, commit, Python and platform."""

import json
import platform
import subprocess
import tomllib
from importlib import metadata
from pathlib import Path

PACKAGE = "asp-env"
_ROOT = Path(__file__).resolve().parents[2]
_GIT_TIMEOUT_S = 5.0
_COMMIT_CHARACTERS = 12


def version_line() -> str:
    """Version, commit if it is known, Python and platform, such as for a bug report."""
    commit = known_commit()
    known = f" (commit {commit})" if commit else ""
    implementation = platform.python_implementation().replace("CPython", "Python")
    return (
        f"{PACKAGE} {package_version()}{known}, {implementation} {platform.python_version()}, "
        f"{platform.platform()}"
    )


def package_version() -> str:
    """The version of this package, also of a source checkout that is not installed."""
    try:
        return metadata.version(PACKAGE)
    except metadata.PackageNotFoundError:
        project = tomllib.loads((_ROOT / "pyproject.toml").read_text())
        return project["project"]["version"]


def known_commit() -> str | None:
    """The commit that the code is of, with `-dirty` if tracked files differ from it.

    It is that of the source checkout that the package is imported from, or that of a repository
    from which pip installed the package; None if neither is known.
    """
    if (_ROOT / ".git").exists() and (_ROOT / "pyproject.toml").exists():
        return _commit_of_checkout()
    try:
        origin = metadata.distribution(PACKAGE).read_text("direct_url.json")
    except metadata.PackageNotFoundError:
        return None
    commit = json.loads(origin or "{}").get("vcs_info", {}).get("commit_id")
    return None if commit is None else str(commit)[:_COMMIT_CHARACTERS]


def _commit_of_checkout() -> str | None:
    describe = ("describe", "--always", "--dirty", f"--abbrev={_COMMIT_CHARACTERS}", "--exclude=*")
    try:
        done = subprocess.run(
            ["git", "-C", str(_ROOT), *describe],
            capture_output=True, text=True, check=True, timeout=_GIT_TIMEOUT_S,
        )  # fmt: skip
    except (OSError, subprocess.SubprocessError):  # no git, or not a repository of this user
        return None
    return done.stdout.strip() or None
