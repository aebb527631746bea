"""Folders of synthetic traffic that several tests read."""

from pathlib import Path

import pytest

from scenarios.sumo import synthesize

SITES = ("intersection", "roundabout")


@pytest.fixture(scope="session", params=SITES)
def site(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two recordings of two minutes, one for each kind of location of a site."""
    out = tmp_path_factory.mktemp("synthetic") / request.param
    synthesize(out, site=request.param, recordings=2, minutes=2.0, seed=4, locations=2)
    return out


@pytest.fixture(scope="session")
def short(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Six seconds at an intersection, with seed 7."""
    out = tmp_path_factory.mktemp("short") / "out"
    synthesize(out, site="intersection", recordings=1, minutes=0.1, seed=7)
    return out
