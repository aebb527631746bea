"""Reproducible tests with a cache folder of their own."""

import gc
import os
import shutil
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import Phase, settings
from selenium import webdriver

from tests import checked_calls

# Several test processes share the cores, and sums by several threads differ in their last bits.
os.environ.setdefault("OMP_NUM_THREADS", "1")
# Compiled modules are kept, since hundreds of processes import this package.
sys.dont_write_bytecode = False
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
# Windows are invisible; tests that need a screen start their own.
os.environ["SDL_VIDEODRIVER"] = "dummy"

checked_calls.install()

settings.register_profile("same-every-time", derandomize=True, deadline=None, max_examples=30)
settings.register_profile(
    "without-shrinking",  # for mutants, of which one failure is enough
    settings.get_profile("same-every-time"),
    phases=[Phase.explicit, Phase.generate],
)
settings.load_profile("same-every-time")


def pytest_collection_finish() -> None:
    """Spares garbage collections the millions of objects of the modules and of the tests."""
    gc.collect()
    gc.freeze()


def pytest_runtest_logstart() -> None:
    """Begins a test."""
    checked_calls.begin_test()


@pytest.fixture(autouse=True, scope="session")
def _own_cache(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """A cache folder for this test run alone."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("ASP_ENV_CACHE", str(tmp_path_factory.mktemp("cache")))
        yield


@pytest.fixture
def browser(tmp_path: Path) -> Iterator[webdriver.Chrome]:
    """A headless Chromium that logs its console and its requests."""
    chromium, chromedriver = shutil.which("chromium"), shutil.which("chromedriver")
    if chromium is None or chromedriver is None:
        pytest.skip("chromium and chromedriver are not installed")
    options = webdriver.ChromeOptions()
    options.binary_location = chromium
    for switch in (
        "headless=new", "no-sandbox", "disable-gpu", "disable-quic", "no-first-run",
        "disable-background-networking", "disable-component-update", "disable-sync",
        "disable-dev-shm-usage", "window-size=1400,1000", f"user-data-dir={tmp_path / 'profile'}",
    ):  # fmt: skip
        options.add_argument(f"--{switch}")
    options.set_capability("goog:loggingPrefs", {"browser": "ALL", "performance": "ALL"})
    driver = webdriver.Chrome(options, webdriver.ChromeService(chromedriver))
    try:
        yield driver
    finally:
        driver.quit()
