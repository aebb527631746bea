"""Small data sets on disk for whole runs."""

from pathlib import Path

import pytest

from asp_env.data.source import Recordings, open_data
from tests.crossing_files import ON_ROAD, write_crossing


@pytest.fixture(scope="session")
def crossings(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with three recordings of one place, of 20 s each."""
    folder = tmp_path_factory.mktemp("crossings")
    return write_crossing(folder, drives=(ON_ROAD, ON_ROAD[:4], ON_ROAD[1:]))


@pytest.fixture(scope="session")
def recordings(crossings: Path) -> Recordings:
    """The three recordings."""
    return open_data(crossings)
