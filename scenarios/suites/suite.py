"""The suites and the source `suite:NAME`, which makes their traffic and checks it."""

import json
import os
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from importlib import metadata
from pathlib import Path

from asp_env.data.cache import get_or_create
from asp_env.data.source import open_data
from asp_env.errors import AspEnvError, MissingExtraError, unknown_name
from asp_env.stored import check_fields, parse_json
from scenarios.sumo.dataset import synthesize

PLACES = 72
"""Locations of a suite of SUMO, with one recording each; for highway-env, recordings."""

MINUTES = 2.0
"""Length of each recording. Balances the time that the making takes against the number of places
over which intervals are resampled. Chosen by hand."""

SEEDS = {"intersection-v1": 613_001, "roundabout-v1": 613_002, "highway-v1": 613_003}
"""Seeds of the suites, reserved for them."""

SCENARIOS = "scenarios.json"
"""The frozen list in the folder of a suite, as far as its traffic is the frozen one."""

MADE = "suite.json"
"""States how the traffic of a folder was made."""

HASH_DIGITS = 12
"""Digits of a content hash in names and messages."""

MOST_JOBS = 8
"""Largest number of processes that make a suite."""

PACKAGES = ("asp-env", "eclipse-sumo", "highway-env", "numpy", "pandas", "pyproj")
"""Packages on which the traffic may depend. Their versions are stated."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Suite:
    """A named set of recordings from a fixed seed."""

    name: str
    write: Callable[[Path], None]
    """Writes the recordings into a folder."""

    @property
    def frozen(self) -> Path:
        """The frozen list of scenarios, which names the content of each recording."""
        return Path(__file__).parent / f"{self.name}.json"


@dataclass(frozen=True, slots=True, kw_only=True)
class _Made:
    """The content of `suite.json`."""

    data_hash: str
    versions: Mapping[str, str]


def _write_sumo(folder: Path, *, name: str, site: str) -> None:
    synthesize(
        folder,
        site=site,
        recordings=PLACES,
        minutes=MINUTES,
        seed=SEEDS[name],
        locations=PLACES,
        traffic="dense",
        jobs=_jobs(),
        progress=True,
    )


def _write_highway(folder: Path) -> None:
    try:
        from scenarios.highway import dataset
    except ModuleNotFoundError as error:
        raise MissingExtraError(str(error.name), "highway", "suite:highway-v1") from error
    dataset.synthesize(
        folder,
        site=("intersection", "roundabout"),
        recordings=PLACES,
        minutes=MINUTES,
        seed=SEEDS["highway-v1"],
        jobs=_jobs(),
        progress=True,
    )


def _jobs() -> int:
    return min(MOST_JOBS, len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else 1)


SUITES = {
    suite.name: suite
    for suite in (
        *(
            Suite(name=name, write=partial(_write_sumo, name=name, site=site))
            for name, site in (("intersection-v1", "intersection"), ("roundabout-v1", "roundabout"))
        ),
        Suite(name="highway-v1", write=_write_highway),
    )
}


def open_source(argument: str) -> Path:
    """The folder of the source `suite:ARGUMENT`, made on first use in the cache folder.

    If the traffic that was made is not the frozen one, there is a warning each time, and the folder
    lacks the frozen list of scenarios.

    Args:
        argument: name of a suite.

    Raises:
        AspEnvError: there is no such suite, the cache folder cannot be written, or a package is
            missing.
    """
    if argument not in SUITES:
        raise unknown_name("suite", argument, SUITES)
    suite = SUITES[argument]
    frozen_hash = str(frozen_facts(suite)["data_hash"])
    name = f"{argument}-{frozen_hash[:HASH_DIGITS]}"
    folder = get_or_create("suites", name, partial(make_suite, suite))
    if not (folder / SCENARIOS).is_file():
        warnings.warn(_difference(suite, folder), stacklevel=2)
    return folder


def make_suite(suite: Suite, folder: Path) -> None:
    """Writes the recordings of a suite, `suite.json`, and the frozen list if it is of them.

    Args:
        suite: the suite.
        folder: an empty folder.
    """
    suite.write(folder)
    made = {"data_hash": open_data(folder).data_hash(), "versions": package_versions()}
    (folder / MADE).write_text(json.dumps(made, indent=2) + "\n")
    if suite.frozen.is_file() and frozen_facts(suite)["data_hash"] == made["data_hash"]:
        (folder / SCENARIOS).write_bytes(suite.frozen.read_bytes())


def package_versions() -> dict[str, str]:
    """Versions of `PACKAGES`, as far as they are installed."""
    versions = {}
    for package in PACKAGES:
        try:
            versions[package] = metadata.version(package)
        except metadata.PackageNotFoundError:
            continue
    return versions


def frozen_facts(suite: Suite) -> Mapping[str, object]:
    """Content hash and package versions of the frozen traffic: the entry `suite` of its list."""
    return json.loads(suite.frozen.read_text())["suite"]


def _difference(suite: Suite, folder: Path) -> str:
    """States how the traffic in a folder differs from the frozen one."""
    try:
        made = parse_json((folder / MADE).read_bytes())
        check_fields(_Made, made)
        made = _Made(**made)
    except (OSError, AttributeError, TypeError, ValueError) as error:
        raise AspEnvError(f"{folder / MADE}: cannot be read; delete {folder}") from error
    frozen = frozen_facts(suite)
    here, there = made.data_hash[:HASH_DIGITS], str(frozen["data_hash"])[:HASH_DIGITS]
    return (
        f"suite:{suite.name}: the traffic made here has the content hash {here} "
        f"({_text(made.versions)}), the frozen traffic {there} ({_text(frozen['versions'])}): "
        "rows are not comparable with those of others. Install the versions of the frozen traffic "
        f"and delete {folder}"
    )


def _text(versions: object) -> str:
    assert isinstance(versions, dict)
    return ", ".join(f"{package} {version}" for package, version in versions.items())
