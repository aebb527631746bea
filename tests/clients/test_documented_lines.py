"""The lines of `docs/clients.md` run, where their packages are installed."""

import importlib.util
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

PAGE = Path(__file__).parents[2] / "docs" / "clients.md"

PACKAGES = {
    "Gymnasium": ("gymnasium",),
    "stable-baselines3": ("stable_baselines3",),
    "sb3-contrib": ("sb3_contrib",),
    "RL Baselines3 Zoo": ("rl_zoo3",),
    "CleanRL": ("torch",),
    "TorchRL": ("torchrl",),
    "RLlib": ("ray.rllib",),
    "skrl": ("skrl",),
    "Tianshou": ("tianshou",),
    "PettingZoo": ("pettingzoo",),
    "SuperSuit": ("supersuit", "stable_baselines3"),
    "Minari": ("minari", "h5py"),
    "d3rlpy": ("d3rlpy", "minari"),
    "Hydra": ("hydra",),
    "Optuna": ("optuna", "stable_baselines3"),
}
"""The modules that the lines of each section import."""


def _blocks(section: str) -> list[tuple[str, str]]:
    """Language and text of each block of a section."""
    text = PAGE.read_text().split(f"\n## {section}\n")[1].split("\n## ")[0]
    return re.findall(r"```(python|sh)\n(.*?)```", text, re.DOTALL)


def _is_installed(module: str) -> bool:
    """Looks for a module without importing it; parents of a dotted name are imported."""
    try:
        return importlib.util.find_spec(module) is not None
    except ModuleNotFoundError:
        return False


def test_the_sections_are_those_of_the_page():
    headings = re.findall(r"^## (.*)$", PAGE.read_text(), re.MULTILINE)
    assert headings == list(PACKAGES)
    rows = re.findall(r"^\| \[(.*?)\]\(#", PAGE.read_text(), re.MULTILINE)
    assert rows == headings


@pytest.mark.parametrize("section", PACKAGES)
def test_the_lines_run(section, tmp_path):
    """Each block in a process of its own, in the same folder, one after another."""
    for module in PACKAGES[section]:
        if not _is_installed(module):
            pytest.skip(f"{module} is not installed")
    bin_folder = str(Path(sys.executable).parent)
    environment = {
        **os.environ, "OMP_NUM_THREADS": "1", "PATH": f"{bin_folder}:{os.environ['PATH']}"
    }  # fmt: skip
    blocks = _blocks(section)
    assert blocks
    for language, text in blocks:
        command = [sys.executable, "-c", text] if language == "python" else ["bash", "-ec", text]
        done = subprocess.run(
            command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False
        )
        assert done.returncode == 0, done.stderr[-3000:]
