"""A small data set on disk for the environments."""

from pathlib import Path

import pytest

from tests.crossing_files import write_crossing


@pytest.fixture(scope="session")
def crossing(tmp_path_factory: pytest.TempPathFactory) -> str:
    """DATA: a crossing with six scenarios, the last of which is 35 ticks of a motorcycle."""
    folder: Path = tmp_path_factory.mktemp("crossing")
    return str(write_crossing(folder))
