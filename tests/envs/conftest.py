"""Data for the environments."""

from pathlib import Path

import pytest

from tests.crossing_files import write_crossing


@pytest.fixture(scope="session")
def crossing(tmp_path_factory: pytest.TempPathFactory) -> str:
    """A folder with one recording of six scenarios; the ego of the last is a motorcycle."""
    folder: Path = tmp_path_factory.mktemp("crossing")
    return str(write_crossing(folder))
