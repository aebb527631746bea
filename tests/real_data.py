"""Real recordings, which are not part of the project."""

import os
from pathlib import Path

import pytest

_BESIDE = Path(__file__).resolve().parents[2] / "shared" / "data"


def real_data(name: str) -> Path:
    """The folder of a data set such as `karlsruhe`; skips the test if it is absent."""
    folder = Path(os.environ.get("ASP_ENV_TEST_DATA") or _BESIDE) / name
    if not folder.is_dir():
        pytest.skip(f"no real recordings at {folder}: set ASP_ENV_TEST_DATA to their folder")
    return folder
