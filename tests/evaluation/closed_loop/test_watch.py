"""`asp-env watch`: videos, windows, the list, and errors."""

import dataclasses
import shutil
from pathlib import Path

import av
import numpy as np
import pygame
import pytest

from asp_env.cli import main
from asp_env.data.rollout import Rollout
from asp_env.data.source import open_data
from asp_env.errors import DataError
from asp_env.evaluation.closed_loop.watch import load_rollouts, make_films
from tests.crossing_files import write_crossing
from tests.evaluation.runs import make_rollout

SMALL = ("--size", "96", "64", "--fps", "5")


@pytest.fixture(scope="module")
def drives(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder like that of `asp-env drive`: two methods with two rollouts of 20 ticks each."""
    data = write_crossing(tmp_path_factory.mktemp("crossing"))
    recording = open_data(data)[0]
    out = tmp_path_factory.mktemp("drives")
    for method, lag in (("expert", 0.0), ("sampling + constant-velocity", 0.3)):
        folder = out / "rollouts" / method
        folder.mkdir(parents=True)
        for track in (0, 1):
            rollout = make_rollout(recording, track=track, start_tick=15, length=20, lag=lag)
            named = dataclasses.replace(rollout.scenario, source=str(data))
            dataclasses.replace(rollout, scenario=named).save(folder / f"00-{track + 1}-15.npz")
    return out


def one(drives: Path) -> Path:
    """One of the rollouts."""
    return drives / "rollouts" / "expert" / "00-1-15.npz"


def frames(path: Path) -> list[np.ndarray]:
    """The frames of a video."""
    with av.open(str(path)) as container:
        return [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]


def error(capsys: pytest.CaptureFixture[str], *args: object) -> str:
    """The error of the command, which is one line."""
    assert main(["watch", *map(str, args)]) == 2
    text = capsys.readouterr().err
    assert text.count("\n") == 1
    return text.strip()


def test_a_video_of_one_rollout(drives, tmp_path, capsys):
    """Four seconds at 5 frames per second, and the last frame for another second; it repeats."""
    path = tmp_path / "film.mp4"
    assert main(["watch", str(one(drives)), "--video", str(path), *SMALL]) == 0
    assert capsys.readouterr().out.splitlines()[-1] == f"wrote {path}: 5.2 s"
    images = frames(path)
    assert len(images) == 20 + 1 + 5
    assert {image.shape for image in images} == {(64, 96, 3)}
    (film,) = make_films(load_rollouts(one(drives)), None)
    drawn = film.frame(2.0, size_px=(96, 64), extent_m=110.0)
    assert np.abs(images[10].astype(int) - drawn).mean() < 8
    assert main(["watch", str(one(drives)), "--video", str(tmp_path / "b.mp4"), *SMALL]) == 0
    assert (tmp_path / "b.mp4").read_bytes() == path.read_bytes()


def test_a_video_of_a_folder(drives, tmp_path):
    """All four rollouts, one after the other, at twice the speed; `--map` shows another area."""
    for name, more in (("follow", ()), ("map", ("--map",))):
        path = tmp_path / f"{name}.webm"
        args = [str(drives), "--video", str(path), "--speed", "2", *SMALL, *more]
        assert main(["watch", *args]) == 0
    follow, whole = (frames(tmp_path / f"{name}.webm") for name in ("follow", "map"))
    assert len(follow) == len(whole) == 4 * (10 + 1 + 5)
    assert np.abs(follow[0].astype(int) - whole[0]).mean() > 2


def test_titles_name_the_method(drives):
    titles = [film.title for film in make_films(load_rollouts(drives), None)]
    assert titles[::2] == [
        "expert: 00-1-15 (left)",
        "sampling + constant-velocity: 00-1-15 (left)",
    ]


def test_the_list(drives, capsys):
    """A line for each rollout: length, tags and events."""
    assert main(["watch", str(drives), "--list"]) == 0
    words = " ".join(capsys.readouterr().out.split())
    assert words.count("4.0 left collision, off-road") == 4
    assert main(["watch", str(one(drives)), "--list"]) == 0


def test_a_window_plays_and_closes(drives):
    """On a dummy display, until the key q."""
    pygame.display.init()
    pygame.event.post(pygame.Event(pygame.KEYDOWN, key=pygame.K_q))
    assert main(["watch", str(drives), "--size", "320", "240"]) == 0


def test_data_that_have_been_moved_need_an_option(drives, tmp_path, capsys):
    """An error without `--data`, a video with it; other data are an error too."""
    rollout = Rollout.load(one(drives))
    lost = dataclasses.replace(rollout.scenario, source=str(tmp_path / "gone"))
    path, video = tmp_path / "00.npz", tmp_path / "film.mp4"
    dataclasses.replace(rollout, scenario=lost).save(path)
    line = error(capsys, path, "--video", video, *SMALL)
    assert "00.npz: was driven on DATA that cannot be opened" in line
    assert line.endswith("; name it with --data")
    line = error(capsys, path, "--video", video, "--data", "sample:roundabout", *SMALL)
    assert "was driven on other DATA than 'sample:roundabout'" in line
    other = dataclasses.replace(lost, recording_name="77")
    dataclasses.replace(rollout, scenario=other).save(path)
    line = error(capsys, path, "--video", video, "--data", rollout.scenario.source, *SMALL)
    assert "has no recording '77'" in line
    assert not video.exists()
    dataclasses.replace(rollout, scenario=lost).save(path)
    right = ["--data", rollout.scenario.source]
    assert main(["watch", str(path), "--video", str(video), *right, *SMALL]) == 0


def test_files_that_are_no_rollouts_are_errors(drives, tmp_path, capsys):
    """A missing file, another file, a truncated one among good ones, a folder without any."""
    assert "none.npz does not exist; expected a rollout" in error(capsys, tmp_path / "none.npz")
    (tmp_path / "words.txt").write_text("words")
    assert "not a readable rollout" in error(capsys, tmp_path / "words.txt")
    assert "no rollouts (.npz) below it" in error(capsys, tmp_path)
    shutil.copytree(drives, tmp_path / "copy")
    damaged = one(tmp_path / "copy")
    damaged.write_bytes(damaged.read_bytes()[:5000])
    assert str(damaged) in error(capsys, tmp_path / "copy", "--list")
    rollout = Rollout.load(one(drives))
    states = rollout.states.copy()
    states[3, 0, 0] = np.nan
    dataclasses.replace(rollout, states=states).save(damaged)
    with pytest.raises(DataError, match=r"00-1-15\.npz: states: expected numbers up to 10,000,000"):
        make_films(load_rollouts(damaged), None)


@pytest.mark.parametrize(
    ("args", "what"),
    [
        (("--video", "film.avi"), "ends in .mp4 or .webm"),
        (("--size", "0", "720"), "--size 0 720: expected"),
        (("--size", "720", "99999"), "--size 720 99999: expected"),
        (("--size", "97", "64", "--video", "film.mp4"), "even numbers"),
        (("--fps", "0", "--video", "film.mp4"), "expected 1 to 240"),
        (("--speed", "0"), "--speed 0: expected"),
        (("--speed", "nan"), "--speed nan: expected"),
        (("--follow", "-3"), "--follow -3: expected"),
        (("--size", "720"), "see asp-env watch --help"),
    ],
    ids=lambda value: "-".join(value) if isinstance(value, tuple) else None,
)
def test_wrong_options_are_errors_of_one_line(drives, tmp_path, monkeypatch, capsys, args, what):
    """Nothing is written."""
    monkeypatch.chdir(tmp_path)
    assert what in error(capsys, one(drives), *args)
    assert list(tmp_path.iterdir()) == []


def test_a_video_that_cannot_be_written_is_an_error(drives, tmp_path, capsys):
    """A file that exists, and a path below a file."""
    (tmp_path / "film.mp4").write_text("words")
    line = error(capsys, one(drives), "--video", tmp_path / "film.mp4", *SMALL)
    assert "exists already" in line
    line = error(capsys, one(drives), "--video", tmp_path / "film.mp4" / "b.mp4", *SMALL)
    assert "cannot be written" in line
    assert [path.name for path in tmp_path.iterdir()] == ["film.mp4"]


def test_a_missing_screen_is_an_error(drives, monkeypatch, capsys):
    for name in ("SDL_VIDEODRIVER", "DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    pygame.display.quit()
    line = error(capsys, one(drives))
    assert "no screen to open a window on" in line
