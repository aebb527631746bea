"""Windows and the player: what keys do, closing, and what is really on a screen."""

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
from asp_env.render.window import SPEEDS, Playing, Window, play
from tests.render.films import make_film
from tests.render.screens import open_screen

FILM, OTHER = make_film(), make_film(title="another")
SIZE = (320, 240)
IMAGE = np.full((240, 320, 3), (200, 100, 50), dtype=np.uint8)


@pytest.fixture(autouse=True)
def _fresh_display() -> Iterator[None]:
    """No events of a test reach the next one."""
    yield
    pygame.display.quit()


def press(*names: str) -> None:
    """As if a user had pressed keys."""
    pygame.display.init()
    for name in names:
        pygame.event.post(pygame.Event(pygame.KEYDOWN, key=pygame.key.key_code(name)))


def close_by_user(window: Window) -> None:
    """As if a user had closed it."""
    pygame.event.post(pygame.Event(pygame.WINDOWCLOSE, window=window._window))


def test_time_passes_and_films_follow_each_other() -> None:
    """One second and its still, then the next film; behind the last one all stands still."""
    playing = Playing(films=(FILM, OTHER)).advanced(0.5)
    assert (playing.time_s, playing.film) == (0.5, 0)
    assert playing.pressed("up").advanced(0.2).time_s == pytest.approx(0.9)
    playing = playing.advanced(0.5 + STILL_S + 0.01)
    assert (playing.time_s, playing.film, playing.now) == (0.0, 1, OTHER)
    playing = playing.advanced(1.0 + STILL_S + 0.01)
    assert (playing.time_s, playing.film, playing.paused) == (1.0, 1, True)
    assert playing.advanced(3.0) is playing
    again = playing.pressed("space")
    assert (again.time_s, again.paused) == (0.0, False)


def test_keys() -> None:
    """Pause, step to the tick before and after, speed within its bounds, map, film, the end."""
    playing = Playing(films=(FILM, OTHER)).advanced(0.5)
    assert playing.pressed("space").advanced(1.0).time_s == 0.5
    assert playing.pressed("right").time_s == pytest.approx(0.6)
    assert playing.pressed("right").pressed("right").time_s == pytest.approx(0.8)
    assert playing.pressed("left").time_s == pytest.approx(0.4)
    assert playing.pressed("left").pressed("left").time_s == pytest.approx(0.2)
    assert playing.pressed("left").paused
    assert dataclasses.replace(playing, time_s=0.0).pressed("left").time_s == 0.0
    assert dataclasses.replace(playing, time_s=1.5).pressed("right").time_s == 1.0
    fast, slow = playing, playing
    for _ in range(10):
        fast, slow = fast.pressed("up"), slow.pressed("down")
    assert (fast.speed, slow.speed) == (SPEEDS[-1], SPEEDS[0])
    assert playing.pressed("m").whole_map
    assert not playing.pressed("m").pressed("m").whole_map
    assert [playing.pressed("n").film, playing.pressed("n").pressed("n").film] == [1, 1]
    assert [playing.pressed("p").film, playing.pressed("n").pressed("p").film] == [0, 0]
    assert playing.pressed("q").over
    assert playing.pressed("escape").over
    assert playing.pressed("x") is playing


def test_the_player_obeys_its_keys(monkeypatch: pytest.MonkeyPatch) -> None:
    """The next picture is of the next film, the one after it at twice the speed; q ends it."""
    titles, keys, show = [], iter(("n", "up", "q")), Window.show

    def press_at_each(window: Window, image: np.ndarray, title: str | None = None) -> None:
        titles.append(title)
        press(next(keys))
        show(window, image, title)

    monkeypatch.setattr(Window, "show", press_at_each)
    play(Playing(films=(FILM, OTHER)), size_px=SIZE, extent_m=60.0)
    second = f"{OTHER.title} (2 of 2), speed"
    assert titles == [f"{FILM.title} (1 of 2), speed 1", f"{second} 1", f"{second} 2"]


def test_a_window_closed_by_its_user_stays_closed() -> None:
    """Further pictures are not shown and hurt nobody; another window is not touched."""
    window, other = Window("one", SIZE), Window("other", SIZE)
    for each in (window, other):
        each.show(IMAGE)
    close_by_user(window)
    other.look()
    assert not other.closed
    window.look()
    assert window.closed
    window.show(IMAGE)
    assert window.pressed_keys() == []
    window.close()
    other.show(IMAGE)
    assert not other.closed
    other.close()
    other.close()


def test_keys_are_left_to_whoever_asks() -> None:
    """Showing pictures does not swallow what a user's own loop reads."""
    window = Window("one", SIZE)
    window.show(IMAGE)
    press("a", "left")
    window.show(IMAGE)
    assert window.pressed_keys() == ["a", "left"]
    window.close()


def test_a_window_can_be_opened_again_and_copied() -> None:
    """After `close` the next picture opens it; copies begin closed, and pickles too."""
    window = Window("one", SIZE)
    window.show(IMAGE)
    window.close()
    window.show(IMAGE)
    twins = [copy.deepcopy(window), pickle.loads(pickle.dumps(window))]
    assert [twin._window for twin in twins] == [None, None]
    for each in (*twins, window):
        each.show(IMAGE, "a title")
        assert each.size_px == SIZE
        each.close()


def test_without_pygame_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    """One line that says what to install; the other package of that name counts as none."""
    with monkeypatch.context() as patch:
        patch.setattr("asp_env.render.window.find_spec", lambda _: None)
        with pytest.raises(MissingExtraError, match=r"'pygame-ce'.*asp-env\[render\]"):
            Window("one", SIZE)
    monkeypatch.delattr(pygame, "Window")
    with pytest.raises(MissingExtraError, match="'pygame-ce'"):
        Window("one", SIZE).show(IMAGE)


def test_without_a_screen_there_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    """Neither X nor Wayland, or a screen that does not answer."""
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
    """Under X: paused at 0.4 s, the film's picture with its hint, until the process is told."""
    script = """
import pygame
from asp_env.render import player
from tests.render.films import make_film

told = player.Window.show
def show(window, image, title=None):
    told(window, image, title)
    print("shown", flush=True)
    input()
    pygame.event.post(pygame.Event(pygame.KEYDOWN, key=pygame.K_q))
player.Window.show = show
playing = player.Playing(films=(make_film(),), time_s=0.4, paused=True)
player.play(playing, size_px=(720, 480), extent_m=48.0)
"""
    with open_screen(tmp_path) as screen:
        done = subprocess.Popen(
            [sys.executable, "-c", script],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, env=screen.environment, text=True,
            cwd=Path(__file__).parents[2],
        )  # fmt: skip
        assert done.stdout is not None
        assert "shown\n" in iter(done.stdout.readline, "")
        seen = screen.look()
        done.communicate("go on\n" * 3, timeout=60)
        assert done.returncode == 0
    picture = FILM.frame(0.4, size_px=(720, 480), extent_m=48.0)
    top, left = np.argwhere(seen.any(axis=-1)).min(axis=0)
    same = (seen[top : top + 480, left : left + 720] == picture).all(axis=-1)
    assert same[:380].all()  # above the hint
    assert not same[380:].all()
