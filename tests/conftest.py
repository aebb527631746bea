"""Every run of the tests is the same run, and touches nobody's cache."""

import os
from collections.abc import Iterator

import pytest
from hypothesis import settings

# Several test processes share the cores, and sums over threads differ in their last bits.
os.environ.setdefault("OMP_NUM_THREADS", "1")

settings.register_profile("same-every-time", derandomize=True, deadline=None, max_examples=30)
settings.load_profile("same-every-time")


@pytest.fixture(autouse=True, scope="session")
def _own_cache(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """What is derived from recordings is kept in a folder of this run alone."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("ASP_ENV_CACHE", str(tmp_path_factory.mktemp("cache")))
        yield
