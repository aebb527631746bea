"""Tests of videos: their content, that browsers play them, and that no partial files remain."""

import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
import pytest
from jaxtyping import UInt8
from selenium import webdriver
from selenium.webdriver.common.by import By
from selenium.webdriver.support.ui import WebDriverWait

from asp_env.errors import AspEnvError, MissingExtraError
from asp_env.render.film import check_video_possible, frames_of, write_video
from tests.render.films import make_film

WIDTH, HEIGHT, FPS, COUNT = 160, 120, 10.0, 25
CODECS = {".mp4": "h264", ".webm": "vp9"}
COLOURS = [(220, 40, 60), (40, 180, 90), (50, 90, 220)]


def images(count: int = COUNT) -> Iterator[UInt8[np.ndarray, "height width 3"]]:
    """Three horizontal stripes of colour, and a white square that moves right."""
    for number in range(count):
        image = np.zeros((HEIGHT, WIDTH, 3), dtype=np.uint8)
        for third, colour in enumerate(COLOURS):
            image[40 * third : 40 * third + 40] = colour
        image[10:30, 4 * number : 4 * number + 20] = 255
        yield image


def decoded(path: Path) -> tuple[list[Any], dict[str, Any]]:
    """The frames and the properties of a file."""
    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        context = stream.codec_context
        properties = {
            "codec": context.name,
            "pixels": context.pix_fmt,
            "size": (context.width, context.height),
            "rate": stream.average_rate,
            "colours": (context.color_primaries, context.color_trc, context.colorspace),
        }
        return list(container.decode(stream)), properties


@pytest.mark.parametrize("ending", CODECS)
def test_files_hold_the_images(tmp_path: Path, ending: str) -> None:
    """Number, size, times and colours of the frames and the position of the square are right."""
    path = tmp_path / f"film{ending}"
    assert write_video(path, images(), fps=FPS) == COUNT
    frames, properties = decoded(path)
    assert properties == {
        "codec": CODECS[ending],
        "pixels": "yuv420p",
        "size": (WIDTH, HEIGHT),
        "rate": 10,
        "colours": (1, 1, 1),  # BT.709
    }
    times = [float(frame.pts * frame.time_base) for frame in frames]
    np.testing.assert_allclose(times, np.arange(COUNT) / FPS, atol=1e-6)
    for number in (0, 12, 24):
        image = frames[number].to_ndarray(format="rgb24").astype(int)
        for third, colour in enumerate(COLOURS):
            assert np.abs(image[40 * third + 35, 130] - colour).max() < 12
        white = np.flatnonzero(image[20].min(axis=-1) > 200)
        assert abs(white.mean() - (4 * number + 9.5)) < 1
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("ending", CODECS)
def test_equal_images_give_equal_bytes(tmp_path: Path, ending: str) -> None:
    """Six videos are equal; each replaces the one before, with other content in memory."""
    path = tmp_path / f"film{ending}"
    size = (WIDTH, HEIGHT)
    frames = list(frames_of([make_film()], size_px=size, extent_m=60.0, fps=5.0, speed=0.2))
    contents, memory = set(), []
    for number in range(6):
        memory.append(np.random.default_rng(number).bytes(100_000 + 997 * number))
        write_video(path, frames, fps=5.0)
        contents.add(path.read_bytes())
    assert len(contents) == 1


def test_an_mp4_can_play_before_it_is_read_to_its_end(tmp_path: Path) -> None:
    """The index precedes the frames."""
    path = tmp_path / "film.mp4"
    write_video(path, images(), fps=FPS)
    content = path.read_bytes()
    assert 0 < content.index(b"moov") < content.index(b"mdat")


@pytest.mark.parametrize("ending", CODECS)
def test_browsers_play_videos(tmp_path: Path, browser: webdriver.Chrome, ending: str) -> None:
    """The browser reports size and duration, plays to the end, and shows the colours."""
    write_video(tmp_path / f"film{ending}", images(), fps=FPS)
    page = tmp_path / "page.html"
    page.write_text(
        f"<!doctype html><body style='margin:0'><video muted src='film{ending}'></video>"
    )
    browser.get(page.as_uri())
    video = "const v = document.querySelector('video');"
    WebDriverWait(browser, 20).until(
        lambda b: b.execute_script(f"{video} return v.readyState >= 3 || v.error !== null")
    )
    properties = browser.execute_script(
        f"{video} return [v.error, v.videoWidth, v.videoHeight, v.duration]"
    )
    assert properties[:3] == [None, WIDTH, HEIGHT]
    assert properties[3] == pytest.approx(COUNT / FPS, abs=0.05)
    ended = "v.onended = () => arguments[0](true); v.play().catch(e => arguments[0](String(e)));"
    assert browser.execute_async_script(f"{video} {ended}") is True
    screenshot = browser.find_element(By.TAG_NAME, "video").screenshot_as_png
    image = cv2.imdecode(np.frombuffer(screenshot, dtype=np.uint8), cv2.IMREAD_COLOR)
    assert image is not None
    for third, colour in enumerate(COLOURS):
        assert np.abs(image[40 * third + 35, 130, ::-1].astype(int) - colour).max() < 12
    assert browser.execute_script(f"{video} return v.error") is None


@pytest.mark.parametrize(
    ("name", "size", "fps", "message"),
    [
        ("film.avi", (160, 120), 10.0, r"ends in \.mp4 or \.webm"),
        ("film", (160, 120), 10.0, r"ends in \.mp4 or \.webm"),
        ("film.mp4", (0, 0), 10.0, "even numbers from 16"),
        ("film.mp4", (161, 120), 10.0, "even numbers from 16"),
        ("film.mp4", (160, 8192), 10.0, "even numbers from 16"),
        ("film.mp4", (160, 120), 0.0, "expected 1 to 240"),
        ("film.mp4", (160, 120), float("nan"), "expected 1 to 240"),
    ],
)
def test_bad_arguments_are_refused(
    name: str, size: tuple[int, int], fps: float, message: str
) -> None:
    """The message is one line that names the expected values."""
    with pytest.raises(AspEnvError, match=message) as caught:
        check_video_possible(Path(name), size, fps)
    assert "\n" not in str(caught.value)


def test_without_av_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("asp_env.render.film.find_spec", lambda _: None)
    with pytest.raises(MissingExtraError, match=r"'av'.*asp-env\[render\]"):
        check_video_possible(Path("film.mp4"), (160, 120), 10.0)


def test_failures_leave_no_files(tmp_path: Path) -> None:

    def broken() -> Iterator[UInt8[np.ndarray, "height width 3"]]:
        yield from images(3)
        raise KeyboardInterrupt

    def mixed() -> Iterator[UInt8[np.ndarray, "height width 3"]]:
        yield from images(3)
        yield np.zeros((HEIGHT, WIDTH + 2, 3), dtype=np.uint8)

    path = tmp_path / "deep" / "film.mp4"
    with pytest.raises(AspEnvError, match="there are no frames"):
        write_video(path, iter(()), fps=FPS)
    with pytest.raises(AspEnvError, match=r"frame 3: .* the first was"):
        write_video(path, mixed(), fps=FPS)
    with pytest.raises(KeyboardInterrupt):
        write_video(path, broken(), fps=FPS)
    assert list(tmp_path.iterdir()) == []
    (tmp_path / "file").write_text("words")
    with pytest.raises(AspEnvError, match="cannot be written"):
        write_video(tmp_path / "file" / "film.mp4", images(), fps=FPS)
    with pytest.raises(AspEnvError, match="cannot be written"):
        write_video(tmp_path / f"{'x' * 250}.mp4", images(), fps=FPS)
    assert os.listdir(tmp_path) == ["file"]
