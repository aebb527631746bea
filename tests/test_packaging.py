"""What is installed: the wheel works by itself, and every package of the tests is pinned."""

import os
import re
import shutil
import subprocess
import sys
import zipfile
from collections.abc import Iterator
from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path

import numpy as np
import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).parents[1]
PACKAGES = ("asp_env", "predictors", "scenarios", "policies")

MOST_BYTES = 5_000_000
"""Largest size of the wheel."""

DATA = re.compile(r"asp_env/samples/|predictors/pretrained/")

MOST_CODE_BYTES = 2_000_000
"""Largest size of the wheel without sample recordings and pretrained weights."""

ROLLOUT = """
import gymnasium as gym, numpy as np, asp_env
env = gym.make("asp_env/Replay-v0", data="sample:intersection")
env.reset(seed=0)
rewards = [env.step(np.zeros(2, dtype=np.float32))[1] for _ in range(5)]
print(asp_env.__file__, *rewards)
"""


def pins() -> dict[str, str]:
    """The version of each package in `constraints.txt`."""
    lines = (ROOT / "constraints.txt").read_text().splitlines()
    pairs = [line.partition("==") for line in lines if line and not line.startswith("#")]
    return {canonicalize_name(name): version for name, _, version in pairs}


def needed(name: str, extras: frozenset[str]) -> Iterator[tuple[str, frozenset[str]]]:
    """The packages, with extras, that a package with some extras needs on this machine."""
    for text in distribution(name).requires or ():
        requirement = Requirement(text)
        environments = [{"extra": extra} for extra in (extras or {""})]
        marker = requirement.marker
        if marker is None or any(marker.evaluate(each) for each in environments):
            yield canonicalize_name(requirement.name), frozenset(requirement.extras)


def test_every_package_is_pinned() -> None:
    """Those that the development extra needs, directly or not."""
    queue, seen = [("asp-env", frozenset({"dev"}))], set[tuple[str, frozenset[str]]]()
    while queue:
        item = queue.pop()
        if item in seen:
            continue
        seen.add(item)
        try:
            queue += needed(*item)
        except PackageNotFoundError:
            pytest.fail(f"{item[0]} is not installed: pip install -c constraints.txt -e '.[dev]'")
    known = pins()
    assert {name for name, _ in seen} - {"asp-env"} - set(known) == set()


def test_pins_are_exact() -> None:
    """Each line names one version, and each package occurs once."""
    lines = [line for line in (ROOT / "constraints.txt").read_text().splitlines() if line]
    names = [line.partition("==")[0] for line in lines if not line.startswith("#")]
    assert all(re.fullmatch(r"[\w.-]+==[\w.+!]+", x) for x in lines if not x.startswith("#"))
    assert len({canonicalize_name(name) for name in names}) == len(names)


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The wheel, built from the source distribution of a copy of the project."""
    folder = tmp_path_factory.mktemp("dist")
    copy = folder / "source"
    for name in PACKAGES:
        ignored = shutil.ignore_patterns("__pycache__")
        shutil.copytree(ROOT / name, copy / name, ignore=ignored)
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, copy)
    subprocess.run(
        [sys.executable, "-m", "build", "--no-isolation", "--outdir", str(folder), str(copy)],
        capture_output=True, check=True,
    )  # fmt: skip
    assert len(list(folder.glob("*.tar.gz"))) == 1
    (path,) = folder.glob("*.whl")
    return path


def test_the_wheel_is_small(wheel: Path) -> None:
    """The whole of it, and its code."""
    assert wheel.stat().st_size < MOST_BYTES
    with zipfile.ZipFile(wheel) as archive:
        sizes = {each.filename: each.compress_size for each in archive.infolist()}
    assert sum(size for name, size in sizes.items() if not DATA.match(name)) < MOST_CODE_BYTES
    top = {name.partition("/")[0] for name in sizes}
    assert {name for name in top if not name.endswith(".dist-info")} == set(PACKAGES)
    assert "asp_env/py.typed" in sizes


def test_the_wheel_works_in_an_environment_of_its_own(wheel: Path, tmp_path: Path) -> None:
    """The command and a rollout, away from the project; only the dependencies are shared."""
    python = tmp_path / "venv" / "bin" / "python"
    subprocess.run(
        [sys.executable, "-m", "venv", "--without-pip", str(tmp_path / "venv")], check=True
    )
    (site,) = (tmp_path / "venv").glob("lib/python*/site-packages")
    shared = Path(np.__file__).parents[1]  # its own .pth files, as of the project, are not read
    (site / "shared.pth").write_text(f"{shared}\n")
    installed = subprocess.run(
        [
            *(sys.executable, "-m", "pip", "--python", str(python), "install", "--no-deps"),
            *("--no-index", "--disable-pip-version-check", "--quiet", str(wheel)),
        ],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    if "No module named pip" in installed.stderr:
        pytest.skip("pip is not installed")
    assert installed.returncode == 0, installed.stderr
    for path in ROOT.glob("asp_env/**/*.nb[ic]"):  # compiled functions; they fit the same source
        target = site / path.relative_to(ROOT)
        target.parent.mkdir(exist_ok=True)
        shutil.copy(path, target)
    environment = {**os.environ, "ASP_ENV_CACHE": str(tmp_path / "cache")}
    environment.pop("PYTHONPATH", None)

    def output(*command: str) -> str:
        return subprocess.run(
            command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=True
        ).stdout

    assert "synthesize" in output(str(python.with_name("asp-env")), "--help")
    path, *rewards = output(str(python), "-c", ROLLOUT).split()
    assert Path(path).is_relative_to(site)
    assert len(rewards) == 5
    assert np.isfinite([float(reward) for reward in rewards]).all()
