"""Folders of highway-env's traffic, made once in a run of the tests."""

import atexit
import shutil
import tempfile
from functools import cache
from pathlib import Path

from asp_env.data.scenarios.scenario import ScenarioSet, find_scenarios
from asp_env.data.source import Recordings, open_data
from scenarios.highway.dataset import synthesize
from scenarios.highway.sites import SITES
from tests.sim.worlds import DT_S, HISTORY

SITE_NAMES = tuple(SITES)


@cache
def _shelf() -> Path:
    shelf = tempfile.mkdtemp(prefix="highway-")
    atexit.register(shutil.rmtree, shelf, ignore_errors=True)
    return Path(shelf)


@cache
def highway_folder(site: str) -> Path:
    """Two recordings of two rounds; in the first, vehicles give way, crash, and are lost."""
    out = _shelf() / site
    synthesize(out, site=site, recordings=2, minutes=2 / 3, seed=2)
    return out


def highway_data(site: str) -> str:
    """DATA of the same folder."""
    return f"highway:{highway_folder(site)}"


@cache
def highway_recordings(site: str) -> Recordings:
    """What is in it."""
    return open_data(highway_data(site))


@cache
def highway_scenarios(site: str) -> ScenarioSet:
    """All that can be driven there."""
    return find_scenarios(
        highway_recordings(site), source=highway_data(site), dt_s=DT_S, history=HISTORY
    )
