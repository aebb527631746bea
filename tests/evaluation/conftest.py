"""Small data sets on disk."""

from pathlib import Path

import pytest

from asp_env.data.source import Recordings, open_data
from tests.crossing_files import ON_ROAD, write_crossing


@pytest.fixture(scope="session")
def crossings(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with three recordings of 20 s at one location."""
    folder = tmp_path_factory.mktemp("crossings")
    return write_crossing(folder, drives=(ON_ROAD, ON_ROAD[:4], ON_ROAD[1:]))


@pytest.fixture(scope="session")
def recordings(crossings: Path) -> Recordings:
    """The recordings of `crossings`."""
    return open_data(crossings)
