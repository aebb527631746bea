"""Folders of highway-env's traffic: the command, the source, the same bytes, and damage."""

import dataclasses
import pickle
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from asp_env import registry
from asp_env.cli import main
from asp_env.data.scenarios.scenario import find_scenarios
from asp_env.data.source import open_data
from asp_env.errors import AspEnvError, DataError
from asp_env.sim.world import world_class
from scenarios.highway import dataset
from scenarios.highway.rounds import hidden_path, load_history
from tests.highway_folders import SITE_NAMES, highway_data, highway_folder, highway_recordings
from tests.scenarios.highway.environments import make
from tests.scenarios.test_synthesize import contents, stand_in
from tests.sim.worlds import DT_S, HISTORY, replay, scenario, simulate

every_site = pytest.mark.parametrize("site", SITE_NAMES)


def command(out: Path, **options: Any) -> list[str]:
    """Generates 20 s of the roundabout with seed 7, with changes by options."""
    chosen = {"site": "highway:roundabout", "recordings": 1, "minutes": 0.3, "seed": 7, **options}
    return ["synthesize", str(out), *(str(x) for k, v in chosen.items() for x in (f"--{k}", v))]


@pytest.fixture(scope="module")
def short(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One round at the roundabout."""
    out = tmp_path_factory.mktemp("short") / "out"
    assert main(command(out)) == 0
    return out


@every_site
def test_it_reads_back_without_a_fault(site, capsys):
    """Four rounds: `inspect` counts them, all agents are on the road, nothing is repaired."""
    assert main(["inspect", str(highway_folder(site))]) == 0
    observed = capsys.readouterr().out
    assert "Repairs: none" in observed
    assert "Faults: none" in observed
    for recording in highway_recordings(site):
        assert recording.num_frames == 600
        assert recording.frame_rate_hz == 15.0
        assert np.array_equal(recording.track_ids, np.arange(len(recording)))
        assert (recording.sizes == [5.0, 2.0]).all()


@every_site
def test_the_written_velocity_leads_to_the_next_position(site):
    """The written velocity points along the course, not along the heading, in each step.

    Vehicles that are pushed after a collision move further, in less than one step of twenty.
    """
    tracks = pd.read_csv(highway_folder(site) / "data" / "00_tracks.csv")
    following = tracks.trackId.diff().shift(-1) == 0
    moved = np.stack([tracks[name].diff().shift(-1) * 15.0 for name in ("xCenter", "yCenter")])
    velocity = np.stack([tracks.xVelocity, tracks.yVelocity])
    away = np.abs(moved - velocity).max(axis=0)[following]
    assert (away < 2e-3).mean() > 0.95
    slides = np.abs(tracks.latVelocity[following]) > 0.5
    assert slides.sum() > 50
    assert (away[slides] < 2e-3).mean() > 0.9


def test_the_source_opens_what_the_command_writes(short, tmp_path, capsys):
    """A tenth of a minute becomes a whole round; progress is written to stderr."""
    capsys.readouterr()
    out = tmp_path / "out"
    assert main(command(out, minutes=0.1)) == 0
    assert capsys.readouterr().out == ""
    assert contents(out) == contents(short)
    (recording,) = open_data(f"highway:{out}")
    assert recording.num_frames == 300
    assert len(contents(out)) == 5


def test_same_seed_same_bytes_in_another_process(short, tmp_path):
    """Another process writes the same files; another seed writes other files."""
    again, other = tmp_path / "again", tmp_path / "other"
    script = "import sys; from asp_env.cli import main; sys.exit(main(sys.argv[1:]))"
    subprocess.run([sys.executable, "-c", script, *command(again)], check=True, capture_output=True)
    assert contents(again) == contents(short)
    assert main(command(other, seed=8)) == 0
    reference = contents(short)
    assert contents(other).keys() == reference.keys()
    same = {name for name, value in contents(other).items() if value == reference[name]}
    assert same == {"maps/lanelets/00_roundabout/location0.osm", "data/00_recordingMeta.csv"}


@pytest.mark.parametrize(
    ("options", "what"),
    [
        ({"site": "highway:motorway"}, "known are highway:intersection, highway:roundabout"),
        ({"locations": 3}, "has a single location"),
        ({"recordings": 0}, "--recordings 0: expected 1 to 10,000"),
        ({"seed": -1}, "--seed -1: expected at least 0"),
        ({"minutes": "nan"}, "--minutes nan: expected more than 0, and at most 60"),
        ({"minutes": 61}, "--minutes 61: expected more than 0, and at most 60"),
    ],
)
def test_invalid_options_are_refused(tmp_path, options, what, capsys):
    """The error has one line, the status is 2, and nothing is written."""
    assert main(command(tmp_path / "out", **options)) == 2
    observed = capsys.readouterr()
    assert what in observed.err
    assert observed.err.count("\n") == 1
    assert not list(tmp_path.iterdir())


def test_a_folder_that_is_not_empty_is_refused(short, capsys):
    """The existing content is unchanged."""
    before = contents(short)
    assert main(command(short)) == 2
    assert "is not an empty folder" in capsys.readouterr().err
    assert contents(short) == before


def _npz(path: Path, **changes: Any) -> None:
    with np.load(path) as found:
        kept = dict(found)
    np.savez(path, **(kept | changes))


def _truncate(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:2000])


def _flip(path: Path) -> None:
    data = bytearray(path.read_bytes())
    data[len(data) // 2 : len(data) // 2 + 40] = bytes(40)
    path.write_bytes(data)


def _array(path: Path) -> None:
    with path.open("wb") as file:
        np.save(file, np.zeros(3))


def _rows(path: Path) -> np.ndarray:
    return load_history(path).rows


def _changed(path: Path, **fields: Any) -> None:
    rows = _rows(path).copy()
    for name, value in fields.items():
        rows[name][0] = value
    _npz(path, rows=rows)


DAMAGE: dict[str, tuple[Callable[[Path], object], str]] = {
    "missing": (Path.unlink, "is missing"),
    "truncated": (_truncate, "is damaged"),
    "empty": (lambda path: path.write_bytes(b""), "is damaged"),
    "flipped": (_flip, "is damaged"),
    "pickle": (lambda path: path.write_bytes(pickle.dumps({"rows": []})), "is damaged"),
    "objects": (lambda path: _npz(path, rows=np.array([{}, None])), "is damaged"),
    "array": (_array, "is damaged"),
    "a lane that is not there": (lambda path: _changed(path, target_lane=999), "is damaged"),
    "a road that is not there": (
        lambda path: _changed(path, route=(999, 0), route_length=1),
        "is damaged",
    ),
    "a long route": (lambda path: _changed(path, route_length=17), "is damaged"),
    "a position that is no number": (lambda path: _changed(path, x=np.nan), "is damaged"),
    "an exponent": (lambda path: _changed(path, delta=1e5), "is damaged"),
    "a speed of light": (lambda path: _changed(path, speed=3e8), "is damaged"),
    "another site": (lambda path: _npz(path, site=np.array("motorway")), "of another version"),
    "other fields": (lambda path: _npz(path, rows=np.zeros(415)), "of another version"),
    "floats": (lambda path: _npz(path, starts=np.zeros(101)), "of another version"),
    "a number": (lambda path: _npz(path, starts=np.array(3)), "of another version"),
    "less": (lambda path: _npz(path, rows=_rows(path)[:-1]), "of another version"),
}


@pytest.mark.parametrize("kind", DAMAGE)
def test_damage_is_reported_in_one_line(short, tmp_path, kind):
    """The line names the file, the fault and what was expected."""
    path = tmp_path / "00_hidden.npz"
    shutil.copy(short / "hidden" / path.name, path)
    harm, what = DAMAGE[kind]
    harm(path)
    with pytest.raises(DataError, match=rf"00_hidden\.npz.*{what}.*asp-env synthesize") as observed:
        load_history(path)
    assert "\n" not in str(observed.value)


@pytest.mark.parametrize("harm", [_truncate, lambda path: _npz(path, rows=_rows(path)[::-1])])
def test_an_environment_reports_damage(short, tmp_path, harm):
    """No episode begins with an unreadable file, or with one whose vehicles are mixed up."""
    shutil.copytree(short, tmp_path / "copy")
    harm(tmp_path / "copy" / "hidden" / "00_hidden.npz")
    env = make(f"highway:{tmp_path / 'copy'}")
    with pytest.raises(DataError, match=r"00_hidden\.npz (is damaged|does not describe)"):
        env.reset(seed=0)


def test_the_history_of_another_recording_is_refused(tmp_path):
    """The hidden histories of two recordings are exchanged."""
    shutil.copytree(highway_folder("roundabout"), tmp_path / "copy")
    hidden = tmp_path / "copy" / "hidden"
    (hidden / "00_hidden.npz").rename(hidden / "aside")
    (hidden / "01_hidden.npz").rename(hidden / "00_hidden.npz")
    (hidden / "aside").rename(hidden / "01_hidden.npz")
    env = make(f"highway:{tmp_path / 'copy'}")
    with pytest.raises(
        DataError, match=r"^\S+00_hidden.npz does not describe the vehicles in [^\n]+$"
    ):
        env.reset(options={"scenario": 0})


def test_foreign_data_are_refused(short, tmp_path):
    """Unknown names, folders without `hidden` and recordings in memory give one line each."""
    for name in ("nowhere", "", str(tmp_path / "nothing"), str(short / "data" / "00_tracks.csv")):
        with pytest.raises(AspEnvError, match=r"^unknown highway site or folder [^\n]*roundabout$"):
            open_data(f"highway:{name}")
    shutil.copytree(short, tmp_path / "copy")
    shutil.rmtree(tmp_path / "copy" / "hidden")
    with pytest.raises(AspEnvError, match=r"^highway:[^\n]*hidden is missing[^\n]*replayed[^\n]*$"):
        open_data(f"highway:{tmp_path / 'copy'}")
    with pytest.raises(AspEnvError, match=r"^recordings in memory: expected those of `highway:…`$"):
        world_class("highway:")(list(open_data(short)), num_episodes=1, dt_s=DT_S, history=HISTORY)


def test_the_source_is_made_once(tmp_path, monkeypatch):
    """The second call finds the folder that the first one made; its name contains the version."""
    assert registry.find("sources", "highway") is dataset.open_source
    monkeypatch.setenv("ASP_ENV_CACHE", str(tmp_path))
    monkeypatch.setattr(dataset, "synthesize", stand_in("first"))
    folder = dataset.open_source("roundabout")
    monkeypatch.setattr(dataset, "synthesize", stand_in("second"))
    assert dataset.open_source("roundabout") == folder
    assert (folder / "marker").read_text() == "first"
    assert folder == tmp_path / "highway" / f"roundabout-{dataset.SOURCE_VERSION}"


def test_with_noise_episodes_hold_the_true_states(short, tmp_path):
    """Measured tracks are off by centimetres; episodes hold the true states at all ticks.

    Without control they continue as the true tracks; progress is measured on the noisy log.
    """
    out = tmp_path / "noisy"
    assert main([*command(out), "--noise"]) == 0
    truth, clean = out / "truth" / "00_trueTracks.csv", short / "data" / "00_tracks.csv"
    assert truth.read_bytes() == clean.read_bytes()
    hidden = "hidden/00_hidden.npz"
    assert (out / hidden).read_bytes() == (short / hidden).read_bytes()
    true, measured = pd.read_csv(truth), pd.read_csv(out / "data" / "00_tracks.csv")
    error = np.hypot(measured.xCenter - true.xCenter, measured.yCenter - true.yCenter)
    assert 0.005 < error.mean() < 0.1
    runs = []
    for folder in (short, out):
        recordings = open_data(f"highway:{folder}")
        found = list(find_scenarios(recordings, source="", dt_s=DT_S, history=HISTORY))
        simulation = simulate(recordings, found, "own", world_class("highway:"))
        replay(simulation, max(each.length for each in found))
        runs.append(simulation.world)
    one, other = runs[0].episodes, runs[1].episodes
    assert one.states.tobytes() == other.states.tobytes()
    assert one.valid.tobytes() == other.valid.tobytes()
    away = np.hypot(*(one.log_states - other.log_states)[one.log_valid][:, :2].T)
    assert 0.005 < away.mean() < 0.1
    assert runs[1].events().route_m == pytest.approx(runs[1].events().goal_m, abs=0.3)


def test_a_recording_can_be_replayed_as_any_other():
    """Without the scheme, the folder is a recording in which no agent reacts."""
    folder = str(highway_folder("intersection"))
    assert world_class(folder).traffic == "log"
    simulation = simulate(open_data(folder), scenario(18, start=150, length=10))
    replay(simulation, 10)
    episodes = simulation.world.episodes
    assert episodes.states.tobytes() == episodes.log_states.tobytes()
    path = open_data(highway_data("intersection")).tracks_path(1)
    assert hidden_path(path) == highway_folder("intersection") / "hidden" / "01_hidden.npz"


def test_a_recording_may_end_when_the_last_vehicle_has_left():
    """Its frames then end before its last round, and the history has times without rows."""
    recordings = highway_recordings("roundabout")
    history = load_history(hidden_path(recordings.tracks_path(0)))
    assert history.fits(recordings[0])
    longer = dataclasses.replace(
        history,
        steps=np.append(history.steps, [0, 0]),
        starts=np.append(history.starts, [history.starts[-1]] * 2),
    )
    assert longer.fits(recordings[0])
    shorter = dataclasses.replace(
        history,
        steps=history.steps[:-1],
        starts=history.starts[:-1],
        rows=history.rows[: history.starts[-2]],
    )
    assert not shorter.fits(recordings[0])
