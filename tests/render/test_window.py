"""Tests of windows and the player: keys, closing, and the content of the screen."""

import copy
import dataclasses
import pickle
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pygame
import pytest

from asp_env.errors import AspEnvError, MissingExtraError
from asp_env.render.film import STILL_S
from asp_env.render.window import SPEEDS, PlayerState, Window, play
from tests.render.films import make_film
from tests.render.screens import open_screen

FILM, OTHER = make_film(), make_film(title="another")
SIZE = (320, 240)
IMAGE = np.full((240, 320, 3), (200, 100, 50), dtype=np.uint8)


@pytest.fixture(autouse=True)
def _fresh_display() -> Iterator[None]:
    """Removes the events of a test before the next one."""
    yield
    pygame.display.quit()


def press(*names: str) -> None:
    """Posts the events of pressed keys."""
    pygame.display.init()
    for name in names:
        pygame.event.post(pygame.Event(pygame.KEYDOWN, key=pygame.key.key_code(name)))


def close_by_user(window: Window) -> None:
    """Posts the event of a window that is closed by its user."""
    pygame.event.post(pygame.Event(pygame.WINDOWCLOSE, window=window._window))


def test_time_passes_and_films_follow_each_other() -> None:
    """A film lasts a second and stands still; the next one follows; the last one pauses."""
    state = PlayerState(films=(FILM, OTHER)).advanced(0.5)
    assert (state.time_s, state.index) == (0.5, 0)
    assert state.pressed("up").advanced(0.2).time_s == pytest.approx(0.9)
    state = state.advanced(0.5 + STILL_S + 0.01)
    assert (state.time_s, state.index, state.film) == (0.0, 1, OTHER)
    state = state.advanced(1.0 + STILL_S + 0.01)
    assert (state.time_s, state.index, state.paused) == (1.0, 1, True)
    assert state.advanced(3.0) is state
    restarted = state.pressed("space")
    assert (restarted.time_s, restarted.paused) == (0.0, False)


def test_keys() -> None:
    state = PlayerState(films=(FILM, OTHER)).advanced(0.5)
    assert state.pressed("space").advanced(1.0).time_s == 0.5
    assert state.pressed("right").time_s == pytest.approx(0.6)
    assert state.pressed("right").pressed("right").time_s == pytest.approx(0.8)
    assert state.pressed("left").time_s == pytest.approx(0.4)
    assert state.pressed("left").pressed("left").time_s == pytest.approx(0.2)
    assert state.pressed("left").paused
    assert dataclasses.replace(state, time_s=0.0).pressed("left").time_s == 0.0
    assert dataclasses.replace(state, time_s=1.5).pressed("right").time_s == 1.0
    fast, slow = state, state
    for _ in range(10):
        fast, slow = fast.pressed("up"), slow.pressed("down")
    assert (fast.speed, slow.speed) == (SPEEDS[-1], SPEEDS[0])
    assert state.pressed("m").whole_map
    assert not state.pressed("m").pressed("m").whole_map
    assert [state.pressed("n").index, state.pressed("n").pressed("n").index] == [1, 1]
    assert [state.pressed("p").index, state.pressed("n").pressed("p").index] == [0, 0]
    assert state.pressed("q").finished
    assert state.pressed("escape").finished
    assert state.pressed("x") is state


def test_the_player_reacts_to_keys(monkeypatch: pytest.MonkeyPatch) -> None:
    """`n` shows the next film, `up` doubles the speed, `q` ends the player."""
    titles, keys, show = [], iter(("n", "up", "q")), Window.show

    def press_at_each(window: Window, image: np.ndarray, title: str | None = None) -> None:
        titles.append(title)
        press(next(keys))
        show(window, image, title)

    monkeypatch.setattr(Window, "show", press_at_each)
    play(PlayerState(films=(FILM, OTHER)), size_px=SIZE, extent_m=60.0)
    second = f"{OTHER.title} (2 of 2), speed"
    assert titles == [f"{FILM.title} (1 of 2), speed 1", f"{second} 1", f"{second} 2"]


def test_a_window_closed_by_its_user_stays_closed() -> None:
    """Later images are not shown and raise no error; other windows remain open."""
    window, other = Window("one", SIZE), Window("other", SIZE)
    for each in (window, other):
        each.show(IMAGE)
    close_by_user(window)
    other.poll()
    assert not other.closed
    window.poll()
    assert window.closed
    window.show(IMAGE)
    assert window.pressed_keys() == []
    window.close()
    other.show(IMAGE)
    assert not other.closed
    other.close()
    other.close()


def test_showing_images_does_not_consume_keys() -> None:
    window = Window("one", SIZE)
    window.show(IMAGE)
    press("a", "left")
    window.show(IMAGE)
    assert window.pressed_keys() == ["a", "left"]
    window.close()


def test_windows_can_be_reopened_and_copied() -> None:
    """The next image opens a closed window; copies and pickles are not open."""
    window = Window("one", SIZE)
    window.show(IMAGE)
    window.close()
    window.show(IMAGE)
    copies = [copy.deepcopy(window), pickle.loads(pickle.dumps(window))]
    assert [each._window for each in copies] == [None, None]
    for each in (*copies, window):
        each.show(IMAGE, "a title")
        assert each.size_px == SIZE
        each.close()


def test_without_pygame_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    """The package pygame, without -ce, does not suffice."""
    with monkeypatch.context() as patch:
        patch.setattr("asp_env.render.window.find_spec", lambda _: None)
        with pytest.raises(MissingExtraError, match=r"'pygame-ce'.*asp-env\[render\]"):
            Window("one", SIZE)
    monkeypatch.delattr(pygame, "Window")
    with pytest.raises(MissingExtraError, match="'pygame-ce'"):
        Window("one", SIZE).show(IMAGE)


def test_without_a_screen_the_error_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    """Neither X nor Wayland is available, or the screen does not respond."""
    for name in ("SDL_VIDEODRIVER", "DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    pygame.display.quit()
    with pytest.raises(AspEnvError, match="no screen to open a window on") as caught:
        Window("one", SIZE).show(IMAGE)
    assert "\n" not in str(caught.value)
    monkeypatch.setenv("DISPLAY", ":987654")
    with pytest.raises(AspEnvError, match="no screen to open a window on"):
        Window("one", SIZE).show(IMAGE)
    monkeypatch.setenv("SDL_VIDEODRIVER", "x11")
    with pytest.raises(AspEnvError, match="no window can be opened"):
        Window("one", SIZE).show(IMAGE)


def test_a_screen_shows_the_player(tmp_path: Path) -> None:
    """Under X, a player paused at 0.4 s shows the frame of the film and the hint."""
    script = """
import pygame
from asp_env.render.window import PlayerState, Window, play
from tests.render.films import make_film

original_show = Window.show
def show(window, image, title=None):
    original_show(window, image, title)
    print("shown", flush=True)
    input()
    pygame.event.post(pygame.Event(pygame.KEYDOWN, key=pygame.K_q))
Window.show = show
state = PlayerState(films=(make_film(),), time_s=0.4, paused=True)
play(state, size_px=(720, 480), extent_m=48.0)
"""
    with open_screen(tmp_path) as screen:
        player = subprocess.Popen(
            [sys.executable, "-c", script],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, env=screen.environment, text=True,
            cwd=Path(__file__).parents[2],
        )  # fmt: skip
        assert player.stdout is not None
        assert "shown\n" in iter(player.stdout.readline, "")
        content = screen.look()
        player.communicate("go on\n" * 3, timeout=60)
        assert player.returncode == 0
    frame = FILM.frame(0.4, size_px=(720, 480), extent_m=48.0)
    top, left = np.argwhere(content.any(axis=-1)).min(axis=0)
    same = (content[top : top + 480, left : left + 720] == frame).all(axis=-1)
    assert same[:380].all()  # above the hint
    assert not same[380:].all()
