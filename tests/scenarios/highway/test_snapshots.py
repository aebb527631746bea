"""Internal states of vehicles after storing and in snapshots."""

import pickle
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from scenarios.highway.rounds import (
    HIDDEN_EVERY_FRAMES,
    HiddenHistory,
    hidden_path,
    load_history,
    read_vehicles,
    restore,
)
from scenarios.highway.sites import empty_road, network
from tests.conformance.world_cases import WORLD_CASES
from tests.highway_folders import SITE_NAMES, highway_data, highway_recordings
from tests.scenarios.highway.elsewhere import drive, go_on, open_world

TAKEN, LAST = (1, 3, 8, 15), 20


def histories(site: str) -> list[HiddenHistory]:
    """The hidden histories of both recordings of a site."""
    recordings = highway_recordings(site)
    return [load_history(hidden_path(recordings.tracks_path(number))) for number in (0, 1)]


@pytest.mark.parametrize("site", SITE_NAMES)
def test_restored_vehicles_are_the_same(site):
    """At all 400 stored times of four rounds, restored vehicles give the stored internal states."""
    for history in histories(site):
        assert len(history.steps) == 200
        for time in range(len(history.steps)):
            rows, steps = history.at(time * HIDDEN_EVERY_FRAMES)
            road = empty_road(history.site, steps=steps)
            road.vehicles = restore(rows, road, history.site.vehicle)
            assert read_vehicles(road).tobytes() == rows.tobytes()
            assert road.steps == steps


def changing_lanes(site: str, rows: np.ndarray) -> int:
    """Number of vehicles whose target lane is another lane of their road."""
    found, lanes = 0, network(site).indices
    for row in rows:
        place = np.array([row["x"], row["y"]])
        here = network(site).get_closest_lane_index(place, float(row["heading"]))
        there = lanes[int(row["target_lane"])]
        found += here[:2] == there[:2] and here != there
    return found


def test_every_field_occurs_with_other_values():
    """Each field has a value in those rounds that differs from the default."""
    rows = {site: np.concatenate([each.rows for each in histories(site)]) for site in SITE_NAMES}
    every = np.concatenate(list(rows.values()))
    assert changing_lanes("roundabout", rows["roundabout"]) > 3
    assert rows["intersection"]["yielding"].sum() > 10
    assert (rows["intersection"]["target_speed"] == 0).sum() > 10
    for site in SITE_NAMES:
        assert rows[site]["crashed"].sum() > 10
        assert rows[site]["pushed"].sum() > 5
    assert (every["impact"][every["pushed"]] != 0).any(axis=0).all()
    assert {0, 1, 2, 3} <= set(every["route_length"].tolist())
    assert every["route_length"].max() == 11
    assert (every["delta"] == 4.0).any(), "a vehicle that was the ego"
    assert len(np.unique(every["delta"])) > 50
    assert len(np.unique(every["timer"])) > 50
    assert not every["steered"].any(), "no vehicle is controlled in recordings"


def test_episodes_continue_bit_for_bit_in_another_process(tmp_path: Path):
    """Snapshots of both sites are pickled amid lane changes, yielding, crashes and control."""
    requests, expected, kept = [], [], {}
    for site in SITE_NAMES:
        scenarios = WORLD_CASES[f"highway {site}"].scenarios()
        simulation = open_world(highway_recordings(site), len(scenarios))
        simulation.reset(scenarios, [np.random.default_rng(0) for _ in scenarios])
        snapshots = []
        for tick in range(LAST):
            if tick in TAKEN:
                snapshots.append((tick, simulation.world.snapshot()))
            drive(simulation, tick)
        untouched = simulation.world.episodes.states.tobytes()
        requests.append((highway_data(site), snapshots, LAST))
        hashes = {go_on(simulation, snapshot, tick, LAST) for tick, snapshot in snapshots}
        assert simulation.world.episodes.states.tobytes() == untouched
        assert len(hashes) == 1
        expected += [*hashes] * len(snapshots)
        kept[site] = np.concatenate([each.rows for _, (_, runs) in snapshots for each in runs])
    assert changing_lanes("roundabout", kept["roundabout"])
    assert kept["intersection"]["yielding"].any()
    for rows in kept.values():
        assert rows["crashed"].any()
        assert rows["steered"].any()
    (tmp_path / "asked").write_bytes(pickle.dumps(requests))
    done = subprocess.run(
        [sys.executable, "-m", "tests.scenarios.highway.elsewhere", str(tmp_path / "asked")],
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stdout.split() == expected
