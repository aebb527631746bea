"""Folders as users have them: hidden files, archives, names in any case, classes of other data."""

import re
import shutil
from pathlib import Path

import numpy as np
import pytest

import asp_env
from asp_env.cli import main
from asp_env.data.classes import AgentClass
from asp_env.data.readers.layout import natural_key
from asp_env.data.readers.tables import number_texts
from asp_env.data.scenarios.selection import choose_scenarios, load_scenarios, save_scenarios
from asp_env.data.source import open_data, open_readable
from asp_env.errors import DataError, LeftOutWarning, RepairWarning
from asp_env.sim.episodes import initialize
from tests.data.interaction_files import PLACE, rows, some_cars
from tests.data.interaction_files import write_folder as write_interaction
from tests.data.levelx_files import write_folder, write_recording

FORK = bytes([0, 5, 22, 7, 0, 2, 0, 0]) + b"Mac OS X        " + bytes(50)


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """An empty cache."""
    monkeypatch.setenv("ASP_ENV_CACHE", str(tmp_path / "cache"))


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A valid recording."""
    return write_folder(tmp_path / "folder")


@pytest.mark.parametrize("prefix", ["._", "~$", "."])
def test_hidden_and_temporary_files_are_ignored(folder: Path, prefix: str) -> None:
    """Beside every file, the map's too, and in a folder of an archive made by macOS."""
    expected = open_data(folder)[0]
    for path in [path for path in folder.rglob("*") if path.is_file()]:
        path.with_name(prefix + path.name).write_bytes(FORK)
    (folder / ".DS_Store").write_bytes(FORK)
    for name in ("__MACOSX", "$RECYCLE.BIN", "#recycle", "lost+found"):
        shutil.copytree(folder / "data", folder / name / "data")
    found = open_data(folder)
    assert found.names == ("00",)
    np.testing.assert_array_equal(found[0].states, expected.states)


def test_names_of_files_and_columns_may_be_in_any_case(folder: Path) -> None:
    """XX_TRACKS.CSV with TRACKID, LOCATION1.OSM: the same states."""
    expected = open_data(folder)[0]
    for path in [path for path in folder.rglob("*") if path.is_file()]:
        if path.suffix == ".csv":
            head, _, rest = path.read_text().partition("\n")
            path.write_text(f"{head.upper()}\n{rest}")
        path.rename(path.with_name(path.name.upper()))
    np.testing.assert_array_equal(open_data(folder)[0].states, expected.states)


@pytest.mark.parametrize("number", ["²", "٣", "①"])
def test_digits_that_are_no_digits_are_letters(folder: Path, number: str) -> None:
    for path in list((folder / "data").iterdir()):
        path.rename(path.with_name(path.name.replace("00", number, 1)))
    assert open_data(folder).names == (number,)
    assert len(open_data(folder)[0]) == 3
    assert natural_key("9") < natural_key("10") < natural_key(number)


def test_archives_are_named_in_the_error(folder: Path, tmp_path: Path) -> None:
    """As DATA, in a folder without recordings, and beside a table that is missing."""
    (tmp_path / "inD.zip").write_bytes(b"PK")
    with pytest.raises(DataError, match="is an archive, unpack it first"):
        open_data(tmp_path / "inD.zip")
    lone = tmp_path / "lone"
    lone.mkdir()
    (lone / "inD.tar.gz").write_bytes(b"")
    with pytest.raises(DataError, match=r"unpack inD.tar.gz first"):
        open_data(lone)
    (folder / "data" / "00_tracks.csv").rename(folder / "data" / "00_tracks.csv.zip")
    with pytest.raises(DataError, match=r"unpack 00_tracks.csv.zip first"):
        open_data(folder)[0]


@pytest.mark.parametrize("layout", ["levelx", "interaction"])
def test_unknown_classes_become_other_and_are_counted(
    folder: Path, tmp_path: Path, layout: str
) -> None:
    """Tracks, not rows, are counted."""
    if layout == "levelx":
        path = folder / "data" / "00_tracksMeta.csv"
        lines = path.read_text().splitlines()
        lines[1] = lines[1].rpartition(",")[0] + ",ufo"
        path.write_text("\n".join(lines) + "\n")
    else:
        folder = write_interaction(tmp_path / "other")
        table = some_cars()
        table.loc[table["track_id"] == 1, "agent_type"] = "ufo"
        table.to_csv(next(folder.rglob("vehicle_tracks_000.csv")), index=False)
    recording = open_data(folder)[0]
    assert "1 tracks of the unknown class 'ufo' are read as 'other'" in recording.repairs
    assert recording.classes.tolist().count(int(AgentClass.OTHER)) == 1


def test_one_bad_recording_blocks_only_itself(
    folder: Path, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    """It is named in one warning; it is an error with `strict`, as with `--strict`."""
    for path in list((folder / "data").iterdir()):
        shutil.copy(path, path.with_name(path.name.replace("00", "07", 1)))
    (folder / "data" / "07_tracks.csv").unlink()
    with pytest.warns(LeftOutWarning, match=r"1 of 2 recordings .*\(07\).*07_tracks.csv") as caught:
        found = open_readable(folder)
    assert found.names == ("00",)
    assert len(caught) == 1
    with pytest.raises(DataError, match="07"):
        open_readable(folder, strict=True)
    options = ["evaluate", str(folder), "--part", "all", "--predictors", "constant-velocity"]
    assert main([*options, "--out", str(tmp_path / "out"), "--strict"]) == 2
    line = capsys.readouterr().err
    assert "07_tracks.csv" in line
    assert line.count("\n") == 1


def test_gym_make_leaves_a_bad_recording_out(folder: Path) -> None:
    (folder / "data" / "01_tracks.csv").write_text("recordingId\n")
    with pytest.warns(LeftOutWarning, match="01"):
        env = asp_env.ReplayEnv(str(folder), observations=("state",))
    assert env.recordings.names == ("00",)


def test_without_any_good_recording_the_fault_is_the_error(folder: Path) -> None:
    (folder / "data" / "00_tracks.csv").unlink()
    with pytest.raises(DataError, match=r"00_tracks.csv: no such file"):
        open_readable(folder)


def write_cases(folder: Path) -> Path:
    """Two cases of 4 s of a table of INTERACTION 1.2: cars 1 and 2, pedestrian P1 in case 1."""
    write_interaction(folder)
    shutil.rmtree(folder / "recorded_trackfiles")
    (folder / "train").mkdir()
    lines = ["case_id,track_id,frame_id,timestamp_ms,agent_type,x,y,vx,vy,psi_rad,length,width"]
    for case in (1, 2):
        for car in (1, 2):
            start = 5 + 20 * car
            lines += [
                f"{case}.0,{car},{i},{100 * i},car,{start + 0.8 * i:.3f},-21.75,8,0,0,4.5,1.8"
                for i in range(1, 41)
            ]
    lines += [f"1.0,P1,{i},{100 * i},pedestrian/bicycle,{i / 10},-20,1,0,,," for i in range(1, 41)]
    path = folder / "train" / f"{PLACE}_train.csv"
    path.write_text("\n".join(lines) + "\n")
    return path


def test_a_table_of_cases_without_rows_is_refused(tmp_path: Path) -> None:
    """It stands as one recording that cannot be read."""
    path = write_cases(tmp_path)
    path.write_text(path.read_text().splitlines(keepends=True)[0])
    with pytest.raises(DataError, match=rf"{path.name}: has a header but no rows"):
        open_readable(tmp_path)


def test_each_case_of_interaction_1_2_is_a_recording(tmp_path: Path) -> None:
    """40 frames at 10 Hz; the cars drive 8 m/s along +x; empty cells are unknown sizes."""
    write_cases(tmp_path / "cases")
    recordings = open_data(tmp_path / "cases")
    assert recordings.names == (f"{PLACE}_train/1", f"{PLACE}_train/2")
    first, second = recordings
    assert (len(first), len(second)) == (3, 2)
    assert (first.num_frames, first.frame_rate_hz, first.location) == (40, 10.0, PLACE)
    np.testing.assert_allclose(second.states[:, 3], 8.0, atol=1e-3)
    np.testing.assert_allclose(second.track(1)[:, 0] - second.track(0)[:, 0], 20.0, atol=1e-3)
    assert first.classes.tolist() == [AgentClass.CAR, AgentClass.CAR, AgentClass.BICYCLE]
    assert (first.sizes > 0).all()
    assert first.road_map is second.road_map
    assert len(set(recordings.hashes())) == 2


def test_cases_of_4_s_can_be_driven(tmp_path: Path) -> None:
    """40 rows are the ticks 0 to 19: 3 of history, then 16 to drive; 4 cars, 12.8 m each."""
    write_cases(tmp_path / "cases")
    recordings = open_data(tmp_path / "cases")
    with pytest.warns(UserWarning, match=r"last 2 s or more after 0\.6 s of history"):
        scenarios = choose_scenarios(recordings, "", dt_s=0.2, history=15)
    assert (len(scenarios), scenarios.history) == (4, 3)
    assert set(scenarios.start_tick) == {3}
    assert set(scenarios.length) == {16}
    path = tmp_path / "scenarios.json"
    save_scenarios(path, scenarios, recordings)
    assert len(load_scenarios(path, recordings, dt_s=0.2, history=15)) == 4
    init = initialize(recordings[0], scenarios[0], dt_s=0.2, history=15)
    assert init.first_frame == -24  # ticks before the recording are not valid


def test_repairs_are_warned_of_once_per_folder(tmp_path: Path) -> None:
    """Two recordings, of which one has a class that is not known."""
    folder = write_folder(tmp_path / "folder")
    write_recording(folder, number=1, classes=["hovercraft", "car", "pedestrian"])
    with pytest.warns(RepairWarning) as caught:
        open_readable(folder)
    (warning,) = caught
    assert re.fullmatch(
        r"data '.*': 1 repairs of 1 of 2 recordings and 0 of maps: recording 01: 1 tracks of the "
        r"unknown class 'hovercraft' .* \(asp-env inspect lists all repairs\)",
        str(warning.message),
    )


def test_ids_that_are_texts_are_numbered_above_those_that_are_numbers() -> None:
    """P1 is no number, 01 has that of 1, and 2^60 is too large: 8, 9 and 10."""
    ids = number_texts(np.array(["1", "7", "P1", "01", str(2**60), "P1", "7.0"], dtype=object))
    assert ids.numbers.tolist() == [1, 7, 8, 9, 10, 8, 11]
    assert ids.texts[8] == "P1"
    assert len(ids.repairs) == 1
    assert number_texts(np.array(["3", "5"], dtype=object)).repairs == ()


def test_a_bad_case_blocks_only_itself(tmp_path: Path) -> None:
    path = write_cases(tmp_path / "cases")
    lines = path.read_text().splitlines()
    path.write_text("\n".join([*lines, lines[90]]) + "\n")  # case 2 twice at one time
    recordings = open_data(tmp_path / "cases")
    assert len(recordings[0]) == 3
    with pytest.raises(DataError, match=r"line 202: case 2: a second row of track 1 at 1000 ms"):
        recordings[1]


@pytest.mark.parametrize("empty", ["vehicle", "pedestrian"])
def test_a_table_without_rows_has_no_tracks(tmp_path: Path, empty: str) -> None:
    data = write_interaction(tmp_path / "other")
    tracks = next(data.rglob("vehicle_tracks_000.csv"))
    header = tracks.read_text().splitlines()[0] + "\n"
    other = tracks.with_name("pedestrian_tracks_000.csv")
    if empty == "vehicle":
        rows(0, np.zeros((20, 4)), kind="pedestrian/bicycle").to_csv(other, index=False)
        tracks.write_text(header)
    else:
        other.write_text(header)
    assert len(open_data(data)[0]) == (1 if empty == "vehicle" else 3)


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        (
            "version https://git-lfs.github.com/spec/v1\noid sha256:0\n",
            "fetch it by `git lfs pull`",
        ),
        (
            "<!DOCTYPE html>\n<html><body>Login</body></html>\n",
            "is a web page instead of",
        ),
    ],
)
def test_what_downloads_leave_in_the_place_of_a_table(
    folder: Path, content: str, expected: str
) -> None:
    (folder / "data" / "00_tracks.csv").write_text(content)
    with pytest.raises(DataError, match=f"00_tracks.csv: .*{expected}"):
        open_data(folder)[0]


@pytest.mark.parametrize("name", ["00_*", "00_tracks.csv", "location1.osm"])
def test_links_to_files_that_do_not_exist(folder: Path, name: str) -> None:
    """All files of a recording, as in a clone of git-annex, its tracks, or its map."""
    for path in list(folder.rglob(name)):
        path.unlink()
        path.symlink_to(folder / ".git" / path.name)
    recordings = open_data(folder)
    assert recordings.names == ("00",)
    with pytest.raises(DataError, match="is a link to a file that does not exist; fetch that file"):
        recordings[0]
