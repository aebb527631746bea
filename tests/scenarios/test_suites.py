"""Suites: frozen lists, the traffic they were made from, and traffic that differs."""

import hashlib
import json
import warnings
from dataclasses import replace
from functools import partial
from pathlib import Path

import pytest

from asp_env import registry
from asp_env.data.scenarios import load_scenarios
from asp_env.data.source import open_data
from asp_env.errors import AspEnvError
from scenarios.suites import SUITES, open_source, suite
from scenarios.suites.freeze import freeze
from scenarios.suites.suite import MINUTES, PLACES, SEEDS, Suite, frozen_facts, package_versions
from scenarios.sumo import synthesize


@pytest.mark.parametrize("name", SUITES)
def test_the_frozen_list_is_complete(name: str) -> None:
    """At least 60 places and 600 distinct scenarios; the hash is that of all recordings."""
    content = json.loads(SUITES[name].frozen.read_text())
    rows = {tuple(row) for row in content["scenarios"]}
    assert len(rows) == len(content["scenarios"]) >= 600
    assert len(content["recordings"]) == PLACES >= 60
    hashes = "".join(each for _, each in content["recordings"])
    assert hashlib.sha256(hashes.encode()).hexdigest() == content["suite"]["data_hash"]


def test_seeds_are_distinct() -> None:
    """Three seeds, one for each suite."""
    assert SEEDS.keys() == SUITES.keys()
    assert len({*SEEDS.values()}) == 3


@pytest.mark.parametrize("name", ["intersection-v1", "roundabout-v1"])
def test_the_traffic_is_the_frozen_one(name: str, tmp_path: Path) -> None:
    """The first recording has the content that the list names, with the versions that made it."""
    made, here = frozen_facts(SUITES[name])["versions"], package_versions()
    assert isinstance(made, dict)
    if any(made[each] != here.get(each) for each in ("eclipse-sumo", "numpy", "pyproj")):
        pytest.skip("other versions than those that made the suite")
    site = name.removesuffix("-v1")
    synthesize(
        tmp_path / "a", site=site, recordings=1, minutes=MINUTES, seed=SEEDS[name], traffic="dense"
    )
    first = json.loads(SUITES[name].frozen.read_text())["recordings"][0]
    assert [*zip(["00"], open_data(tmp_path / "a").hashes(), strict=True)] == [tuple(first)]


def small(folder: Path, seed: int) -> None:
    """Half a minute at a roundabout."""
    synthesize(folder, site="roundabout", recordings=1, minutes=0.5, seed=seed, traffic="dense")


@pytest.fixture
def tiny(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Suite:
    """A suite `tiny` of one place, with its frozen list."""
    monkeypatch.setenv("ASP_ENV_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(Suite, "frozen", property(lambda self: tmp_path / f"{self.name}.json"))
    made = Suite(name="tiny", write=partial(small, seed=3))
    monkeypatch.setitem(SUITES, "tiny", made)
    (tmp_path / "made").mkdir()
    suite.make_suite(made, tmp_path / "made")
    freeze(tmp_path / "made", made.frozen)
    return made


def test_the_frozen_traffic_comes_with_its_list(tiny: Suite) -> None:
    """The same traffic: no warning, and the list in its folder names its scenarios."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        folder = open_source("tiny")
        assert open_source("tiny") == folder
    assert (folder / "scenarios.json").read_bytes() == tiny.frozen.read_bytes()
    found = load_scenarios(folder / "scenarios.json", open_data("suite:tiny"), dt_s=0.2, history=15)
    assert len(found) >= 1
    assert found.has("interactive").all()


def test_other_traffic_is_not_comparable(tiny: Suite, monkeypatch: pytest.MonkeyPatch) -> None:
    """Traffic of another seed: each use warns, states both hashes, and has no list."""
    monkeypatch.setitem(SUITES, "tiny", replace(tiny, write=partial(small, seed=4)))
    for _ in range(2):
        with pytest.warns(UserWarning, match="rows are not comparable") as caught:
            folder = open_source("tiny")
        text = str(caught[0].message)
        assert text.count("eclipse-sumo") == 2
        assert str(frozen_facts(tiny)["data_hash"])[:12] in text
        assert not (folder / "scenarios.json").exists()


def test_an_unknown_suite_lists_those_known() -> None:
    """The source `suite:` is registered, and names the three suites."""
    assert registry.find("sources", "suite") is open_source
    with pytest.raises(AspEnvError, match="known are highway-v1, intersection-v1, roundabout-v1"):
        open_data("suite:motorway-v1")
