"""Scenarios of given vehicles and ticks, and scenario files."""

import json
import shutil
from importlib import resources
from pathlib import Path

import numpy as np
import pytest

from asp_env.data.classes import AgentClass
from asp_env.data.scenarios.scenario import Scenario, ScenarioSet, find_scenarios
from asp_env.data.scenarios.selection import (
    choose_scenarios,
    load_scenarios,
    save_scenarios,
    scenario_of,
)
from asp_env.data.source import Recordings, open_data
from asp_env.errors import AspEnvError, DataError
from tests.builders import Drive, make_recording

TICKS = {"dt_s": 0.2, "history": 15}

RECORDING = make_recording(
    drives=(
        Drive(kind=AgentClass.CAR, start=(0, 0, 0, 5)),
        Drive(kind=AgentClass.PEDESTRIAN, start=(0, 5, 0, 1)),
        Drive(kind=AgentClass.TRAILER, start=(-9, 0, 0, 5)),
        Drive(kind=AgentClass.CAR, start=(0, 9, 0, 0)),
        Drive(kind=AgentClass.TRUCK, start=(0, 20, 0, 5), appears_s=10.1, leaves_s=13.3),
        Drive(kind=AgentClass.CAR, start=(0, 30, 0, 5), appears_s=10.1, leaves_s=14.9),
    ),
    frame_rate_hz=10.0,
    duration_s=30.0,
)


def scenario(ego_id: int, start_tick: int | None = None, length: int | None = None) -> Scenario:
    """A scenario of the recording above."""
    return scenario_of(
        [RECORDING], source="made up", recording=0, ego_id=ego_id, start_tick=start_tick,
        length=length, seed=7, **TICKS,
    )  # fmt: skip


@pytest.mark.parametrize(
    ("ego_id", "start", "length", "expected"),
    [
        (1, None, None, (15, 75)),
        (1, 20, None, (20, 75)),
        (1, 149, None, (149, 1)),
        (1, 100, 3, (100, 3)),
        (1, 15, 135, (15, 135)),
        (6, None, None, (66, 8)),  # present from 10.1 s to 14.9 s: ticks 51 to 74
    ],
)
def test_start_and_length(
    ego_id: int, start: int | None, length: int | None, expected: tuple[int, int]
) -> None:
    """By default from the first tick with a history to the end of the track, at most 15 s."""
    found = scenario(ego_id, start, length)
    assert (found.ego_id, found.start_tick, found.length) == (ego_id, *expected)
    assert (found.seed, found.source, found.recording_name) == (7, "made up", "00")
    assert found.tags == ("straight",)


def test_given_scenarios_equal_found_ones() -> None:
    for each in find_scenarios([make_recording()], source="", **TICKS):
        given = scenario_of(
            [make_recording()], source="", recording=0, ego_id=each.ego_id, seed=each.seed,
            start_tick=each.start_tick, length=each.length, **TICKS,
        )  # fmt: skip
        assert given == each


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (
            (9,),
            "ego 9: recording 00 has no such track; expected one of its 6, .* ids 1 to 6",
        ),
        ((2,), "ego 2: is of class pedestrian, which cannot be driven; expected one of car, van"),
        ((3,), "ego 3: is of class trailer"),
        ((4,), "ego 4: is parked"),
        ((5,), "ego 5 of recording 00: is present from tick 51 to 66 only; 15 ticks of history"),
        ((1, 14), "start tick 14: ego 1 of recording 00 can start at ticks 15 to 149"),
        ((1, 150), "start tick 150: .* it is present from 0 to 150"),
        ((1, 149, 2), "length 2: ego 1 of recording 00 can drive 1 to 1 ticks from 149 on"),
        ((1, 20, 0), "length 0"),
    ],
)
def test_impossible_scenarios_are_rejected(arguments: tuple[int, ...], message: str) -> None:
    with pytest.raises(AspEnvError, match=message):
        scenario(*arguments)


def test_unknown_recording() -> None:
    """Out of range; negative indices are not allowed either."""
    for number in (1, -1):
        with pytest.raises(AspEnvError, match=f"recording {number}: expected 0 to 0"):
            scenario_of([RECORDING], source="", recording=number, ego_id=1, **TICKS)


@pytest.fixture(scope="module")
def recordings() -> Recordings:
    """The sample intersection."""
    return open_data("sample:intersection")


@pytest.fixture(scope="module")
def scenarios(recordings: Recordings) -> ScenarioSet:
    """All of its scenarios."""
    return choose_scenarios(recordings, "", **TICKS)


def test_files_round_trip(recordings: Recordings, scenarios: ScenarioSet, tmp_path: Path) -> None:
    """Scenarios, their order, seeds, tags and columns are equal, and so are the bytes."""
    some = scenarios.filtered("left|stopping").sorted_by("density")
    save_scenarios(tmp_path / "some.json", some, recordings)
    loaded = choose_scenarios(recordings, str(tmp_path / "some.json"), **TICKS)
    assert [*loaded] == [*some]
    np.testing.assert_array_equal(loaded.values, some.values)
    save_scenarios(tmp_path / "again.json", loaded, recordings)
    assert (tmp_path / "again.json").read_bytes() == (tmp_path / "some.json").read_bytes()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["again.json", "some.json"]


def test_recordings_are_identified_by_content(
    scenarios: ScenarioSet, recordings: Recordings, tmp_path: Path
) -> None:
    """In another folder, under another name, among other recordings."""
    save_scenarios(tmp_path / "set.json", scenarios, recordings)
    folder = tmp_path / "data"
    samples = Path(str(resources.files("asp_env"))) / "samples"
    for site in ("intersection", "roundabout"):
        shutil.copytree(samples / site, folder / site)
    for path in (folder / "intersection").rglob("00_*"):
        path.rename(path.with_name(path.name.replace("00_", "07_")))
    both = open_data(folder)
    loaded = choose_scenarios(both, str(tmp_path / "set.json"), **TICKS)
    assert {each.recording_name for each in loaded} == {"07"}
    np.testing.assert_array_equal(loaded.ego_id, scenarios.ego_id)
    with pytest.raises(DataError, match=r"recording 00 has other content .*roundabout"):
        choose_scenarios(open_data("sample:roundabout"), str(tmp_path / "set.json"), **TICKS)


def test_allowed_ticks(scenarios: ScenarioSet, recordings: Recordings, tmp_path: Path) -> None:
    """A filter searches the allowed ticks; a file that needs other ticks is rejected."""
    save_scenarios(tmp_path / "set.json", scenarios, recordings)
    ticks = [np.arange(600) < 300]
    found = choose_scenarios(recordings, "straight", allowed=ticks, **TICKS)
    assert 0 < len(found) < len(scenarios)
    with pytest.raises(AspEnvError, match=r"of its 46 scenarios lie outside the evaluated part"):
        choose_scenarios(recordings, str(tmp_path / "set.json"), allowed=ticks, **TICKS)
    everywhere = [np.ones(700, dtype=bool)]
    path = str(tmp_path / "set.json")
    assert [*choose_scenarios(recordings, path, allowed=everywhere, **TICKS)] == [*scenarios]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"format": 9}, "scenarios of format 9, expected 1"),
        ({"dt_s": 0.1}, "made for ticks of 0.1 s with 15 of history, expected 0.2 s and 15"),
        ({"history": 5}, "with 5 of history"),
        ({"recordings": [["00", "another"]]}, "recording 00 has other content"),
        ({"recordings": [["99", "another"]]}, "recording 99 is not among these"),
        ({"recordings": []}, "names a recording that it does not list"),
        ({"recordings": None}, "is not a scenario file"),
        ({"scenarios": [[0, 7, 15]]}, "is not a scenario file"),
        ({"scenarios": [["a", 7, 15, 20, 0]]}, "is not a scenario file"),
        ({"scenarios": [[0, 999, 15, 20, 0]]}, "scenario 00-999-15 does not fit its recording"),
        ({"scenarios": [[0, 7, 0, 20, 0]]}, "scenario 00-7-0 does not fit its recording"),
        ({"scenarios": [[0, 7, 15, 9999, 0]]}, "does not fit its recording"),
        ({"scenarios": [[0, 7, 15, 0, 0]]}, "does not fit its recording"),
        ({"scenarios": [[0, 7, 15, 20, -1]]}, "has a negative seed, expected 0 or more"),
        ({"scenarios": [[0, 1e99, 15, 20, 0]]}, "is not a scenario file"),
    ],
)
def test_damaged_files_are_rejected(
    change: dict, message: str, scenarios: ScenarioSet, recordings: Recordings, tmp_path: Path
) -> None:
    path = tmp_path / "set.json"
    save_scenarios(path, scenarios, recordings)
    path.write_text(json.dumps(json.loads(path.read_text()) | change))
    with pytest.raises(DataError, match=f"set.json: .*{message}"):
        load_scenarios(path, recordings, **TICKS)


def test_one_scenario_of_a_file(
    scenarios: ScenarioSet, recordings: Recordings, tmp_path: Path
) -> None:
    """It has the seed that it has in the file."""
    path = tmp_path / "set.json"
    save_scenarios(path, scenarios, recordings)
    one = scenarios[len(scenarios) - 1]
    (found,) = choose_scenarios(recordings, f"{path}#{one.name}", **TICKS)
    assert found == load_scenarios(path, recordings, **TICKS)[len(scenarios) - 1]
    assert (found.name, found.seed) == (one.name, one.seed)
    with pytest.raises(AspEnvError, match=r"unknown scenario 'x': .* such as "):
        choose_scenarios(recordings, f"{path}#x", **TICKS)


@pytest.mark.parametrize("text", ["", "[1, 2]", "{", "3", '"a"', "\x00", "[" * 100_000])
def test_other_and_missing_files_are_rejected(
    text: str, recordings: Recordings, tmp_path: Path
) -> None:
    path = tmp_path / "set.json"
    with pytest.raises(DataError, match=r"set.json: cannot be read: No such file"):
        load_scenarios(path, recordings, **TICKS)
    path.write_text(text)
    with pytest.raises(DataError, match=r"set.json: is not a scenario file"):
        load_scenarios(path, recordings, **TICKS)


def test_files_must_end_in_json(
    scenarios: ScenarioSet, recordings: Recordings, tmp_path: Path
) -> None:
    with pytest.raises(DataError, match=r"expected a name that ends in \.json"):
        save_scenarios(tmp_path / "set.txt", scenarios, recordings)
    assert not list(tmp_path.iterdir())
