"""`asp-env --version`."""

import platform
import re
import subprocess
import sys
from importlib import metadata
from pathlib import Path

import pytest

from asp_env.cli import main
from asp_env.installation import version

ROOT = Path(version.__file__).parents[2]


def test_version_is_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    """Package, Python and platform; the commit of a checkout has twelve digits."""
    assert main(["--version"]) == 0
    line = capsys.readouterr().out
    assert line.startswith(f"asp-env {metadata.version('asp-env')}")
    assert platform.python_version() in line
    assert platform.platform() in line
    assert line.count("\n") == 1
    if (ROOT / ".git").exists() and version.known_commit():
        assert re.search(r"\(commit [0-9a-f]{12}(-dirty)?\)", line)


def test_a_checkout_that_is_not_installed_has_a_version_and_says_what_to_do() -> None:
    """Without metadata the version is that of `pyproject.toml`, and no command is registered."""
    code = (
        "import importlib.metadata as m, sys\n"
        "def absent(*_): raise m.PackageNotFoundError\n"
        "m.version = m.distribution = absent\n"
        "m.entry_points = lambda **_: []\n"
        "from asp_env.cli import main\n"
        "print(main(['--version']), main(['inspect', 'x']))"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True
    )
    line, statuses = done.stdout.splitlines()
    assert line.startswith("asp-env 0.")
    assert statuses == "0 2"
    assert "is not installed: pip install -e FOLDER" in done.stderr


def test_the_commit_of_an_installation_from_a_repository(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Pip writes it to `direct_url.json`; an installation from an index has none."""
    monkeypatch.setattr(version, "_ROOT", tmp_path)
    folder = tmp_path / "asp_env-0.1.0.dist-info"
    folder.mkdir()
    (folder / "METADATA").write_text("Name: asp-env\nVersion: 0.1.0\n")
    monkeypatch.setattr(metadata, "distribution", lambda _: metadata.PathDistribution(folder))
    assert version.known_commit() is None
    (folder / "direct_url.json").write_text(
        '{"url": "https://example.org/x.git", "vcs_info": {"vcs": "git", "commit_id": "'
        + "0123456789abcdef" * 2 + '"}}'
    )  # fmt: skip
    assert version.known_commit() == "0123456789ab"
