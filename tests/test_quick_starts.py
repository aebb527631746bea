"""The files and commands of the quick starts and of the study run as printed, one after another.

A block with a title is a file that the page asks for; blocks of `bash` are commands, others of
`python` are run. All run in this process, in an empty folder, so that the packages are imported
once. Instead of the data of a user, `inD` is a folder in the layout of inD with three short
recordings of the tests' crossing, which the guide uses as well, and runs are shortened.
Installations are replaced by their metadata.
"""

import re
import runpy
import shlex
import tomllib
from collections.abc import Iterator
from pathlib import Path

import pytest

from asp_env import registry
from asp_env.cli import main
from tests.crossing_files import ON_ROAD, write_crossing

DOCS = Path(__file__).parents[1] / "docs"
PAGES = ["start/predictor.md", "start/driving.md", "start/many_agents.md", "guides/own_study.md"]
BLOCK = re.compile(r'```(\w+)(?: title="(.*?)")?\n(.*?)```', re.DOTALL)
SHORTER = {
    "drive": ["--max-scenarios", "2"],
    "evaluate": ["--max-states", "20"],
    "train": ["--epochs", "1", "--max-snippets", "64"],
}
"""Options that are added to commands; of an option that is given twice, the last one counts."""


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """The current folder; plugs that are installed in it are known until the end of the test."""
    monkeypatch.chdir(tmp_path)
    registry._plugs.cache_clear()
    yield tmp_path
    registry._plugs.cache_clear()


@pytest.mark.parametrize("page", PAGES)
def test_the_quick_start_runs(
    page: str, folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Every command exits with 0, and the results that the page names exist."""
    write_crossing(folder / "inD", drives=(ON_ROAD, ON_ROAD[1:], ON_ROAD[:-1]), seconds=20.0)
    text = (DOCS / page).read_text()
    if page.startswith("guides/"):
        text = text.replace("sample:intersection", "inD")
    for language, title, code in BLOCK.findall(text):
        if title:
            path = folder / title
            path.parent.mkdir(exist_ok=True)
            path.write_text(re.sub(r"\.learn\([\d_]+\)", ".learn(64)", code))
        elif language == "bash":
            for line in code.splitlines():
                _run(line, monkeypatch)
        elif language == "python":
            exec(code, {})
    assert "last-action" not in text or "last-action" in capsys.readouterr().out
    for name in re.findall(r"`(\w+/report\.html)`", text):
        assert (folder / name).exists()


def _run(line: str, monkeypatch: pytest.MonkeyPatch) -> None:
    command, *options = shlex.split(line)
    if command == "asp-env":
        options += SHORTER.get(options[0], [])
        assert main(options) == 0, line
    elif command == "python":
        runpy.run_path(options[0], run_name="__main__")
    elif command == "pip" and "--editable" in options:
        _install(Path(options[-1]), monkeypatch)
    else:
        assert command in ("python3", ".", "pip"), line


def _install(package: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Makes a package importable and its entry points known, as an editable installation does."""
    project = tomllib.loads((package / "pyproject.toml").read_text())["project"]
    metadata = package / f"{project['name'].replace('-', '_')}-{project['version']}.dist-info"
    metadata.mkdir()
    (metadata / "METADATA").write_text(
        f"Metadata-Version: 2.1\nName: {project['name']}\nVersion: {project['version']}\n"
    )
    (metadata / "entry_points.txt").write_text(
        "".join(
            f"[{group}]\n" + "".join(f"{name} = {value}\n" for name, value in points.items())
            for group, points in project["entry-points"].items()
        )
    )
    monkeypatch.syspath_prepend(str(package))
    registry._plugs.cache_clear()
