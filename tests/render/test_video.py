"""Videos: what is in the file, that browsers play it, and that nothing is left half written."""

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


def pictures(count: int = COUNT) -> Iterator[UInt8[np.ndarray, "height width 3"]]:
    """A third of the picture in each of three colours, and a white square that moves right."""
    for number in range(count):
        image = np.zeros((HEIGHT, WIDTH, 3), dtype=np.uint8)
        for third, colour in enumerate(COLOURS):
            image[40 * third : 40 * third + 40] = colour
        image[10:30, 4 * number : 4 * number + 20] = 255
        yield image


def decoded(path: Path) -> tuple[list[Any], dict[str, Any]]:
    """The frames of a file, and what it says of itself."""
    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        context = stream.codec_context
        told = {
            "codec": context.name,
            "pixels": context.pix_fmt,
            "size": (context.width, context.height),
            "rate": stream.average_rate,
            "colours": (context.color_primaries, context.color_trc, context.colorspace),
        }
        return list(container.decode(stream)), told


@pytest.mark.parametrize("ending", CODECS)
def test_what_was_drawn_is_in_the_file(tmp_path: Path, ending: str) -> None:
    """As many frames of that size, 0.1 s apart, with the square where it was and the colours."""
    path = tmp_path / f"film{ending}"
    assert write_video(path, pictures(), fps=FPS) == COUNT
    frames, told = decoded(path)
    assert told == {
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
def test_equal_pictures_give_equal_bytes(tmp_path: Path, ending: str) -> None:
    """Six times the same, over what was there, with other things in memory each time."""
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
    """The index stands before the pictures."""
    path = tmp_path / "film.mp4"
    write_video(path, pictures(), fps=FPS)
    content = path.read_bytes()
    assert 0 < content.index(b"moov") < content.index(b"mdat")


@pytest.mark.parametrize("ending", CODECS)
def test_a_browser_plays_it(tmp_path: Path, browser: webdriver.Chrome, ending: str) -> None:
    """It knows size and length, gets through to the end, and shows the colours."""
    write_video(tmp_path / f"film{ending}", pictures(), fps=FPS)
    page = tmp_path / "page.html"
    page.write_text(
        f"<!doctype html><body style='margin:0'><video muted src='film{ending}'></video>"
    )
    browser.get(page.as_uri())
    video = "const v = document.querySelector('video');"
    WebDriverWait(browser, 20).until(
        lambda b: b.execute_script(f"{video} return v.readyState >= 3 || v.error !== null")
    )
    told = browser.execute_script(
        f"{video} return [v.error, v.videoWidth, v.videoHeight, v.duration]"
    )
    assert told[:3] == [None, WIDTH, HEIGHT]
    assert told[3] == pytest.approx(COUNT / FPS, abs=0.05)
    ended = "v.onended = () => arguments[0](true); v.play().catch(e => arguments[0](String(e)));"
    assert browser.execute_async_script(f"{video} {ended}") is True
    shown = browser.find_element(By.TAG_NAME, "video").screenshot_as_png
    image = cv2.imdecode(np.frombuffer(shown, dtype=np.uint8), cv2.IMREAD_COLOR)
    assert image is not None
    for third, colour in enumerate(COLOURS):
        assert np.abs(image[40 * third + 35, 130, ::-1].astype(int) - colour).max() < 12
    assert browser.execute_script(f"{video} return v.error") is None


@pytest.mark.parametrize(
    ("name", "size", "fps", "what"),
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
def test_what_cannot_become_a_video_is_refused(
    name: str, size: tuple[int, int], fps: float, what: str
) -> None:
    """One line that says what is expected."""
    with pytest.raises(AspEnvError, match=what) as caught:
        check_video_possible(Path(name), size, fps)
    assert "\n" not in str(caught.value)


def test_without_av_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    """One line that says what to install."""
    monkeypatch.setattr("asp_env.render.film.find_spec", lambda _: None)
    with pytest.raises(MissingExtraError, match=r"'av'.*asp-env\[render\]"):
        check_video_possible(Path("film.mp4"), (160, 120), 10.0)


def test_nothing_is_left_of_what_went_wrong(tmp_path: Path) -> None:
    """No pictures, a picture of another size, an error on the way, a folder that is a file."""

    def broken() -> Iterator[UInt8[np.ndarray, "height width 3"]]:
        yield from pictures(3)
        raise KeyboardInterrupt

    def mixed() -> Iterator[UInt8[np.ndarray, "height width 3"]]:
        yield from pictures(3)
        yield np.zeros((HEIGHT, WIDTH + 2, 3), dtype=np.uint8)

    path = tmp_path / "deep" / "film.mp4"
    with pytest.raises(AspEnvError, match="nothing to show"):
        write_video(path, iter(()), fps=FPS)
    with pytest.raises(AspEnvError, match=r"picture 3: .* the first was"):
        write_video(path, mixed(), fps=FPS)
    with pytest.raises(KeyboardInterrupt):
        write_video(path, broken(), fps=FPS)
    assert list(tmp_path.iterdir()) == []
    (tmp_path / "file").write_text("words")
    with pytest.raises(AspEnvError, match="cannot be written"):
        write_video(tmp_path / "file" / "film.mp4", pictures(), fps=FPS)
    with pytest.raises(AspEnvError, match="cannot be written"):
        write_video(tmp_path / f"{'x' * 250}.mp4", pictures(), fps=FPS)
    assert os.listdir(tmp_path) == ["file"]
