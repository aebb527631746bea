"""A window on the screen that shows pictures, by pygame-ce.

MERGED: Films in a window, under the user's keys.
"""

import dataclasses
import os
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from typing import Any

import numpy as np
from jaxtyping import UInt8

from asp_env.errors import AspEnvError, MissingExtraError
from asp_env.render.film import STILL_S, Film

UNSEEN = "offscreen"
"""What SDL falls back to where there is no screen."""
SCREENS = ("DISPLAY", "WAYLAND_DISPLAY")


class Window:
    """One of any number of windows; the first picture opens it, and its user closes it for good.

    A copy or a pickle of it is a window that is not open yet.
    """

    def __init__(self, title: str, size_px: tuple[int, int]) -> None:
        """Opens nothing yet.

        Raises:
            MissingExtraError: the package that opens windows is not installed.
        """
        if find_spec("pygame") is None:
            raise MissingExtraError("pygame-ce", "render", "a window")
        self.closed = False
        """Whether the user has closed it."""
        self._title, self._first_size_px = title, size_px
        self._window: Any = None
        self._clock: Any = None

    def __reduce__(self) -> tuple[Any, ...]:
        """Nothing of what is on the screen."""
        return Window, (self._title, self._first_size_px)

    @property
    def size_px(self) -> tuple[int, int]:
        """Width and height of the picture that fits, which the user may change."""
        if self._window is None:
            return self._first_size_px
        width, height = self._window.size
        return max(int(width), 1), max(int(height), 1)

    def show(self, image: UInt8[np.ndarray, "height width 3"], title: str | None = None) -> None:
        """Shows an RGB picture; does nothing once the user has closed the window.

        Raises:
            AspEnvError: there is no screen.
        """
        if self.closed:
            return
        pygame = _pygame()
        if self._window is None:
            self._window, self._clock = _open(self._title, self._first_size_px), pygame.time.Clock()
        if title is not None and title != self._window.title:
            self._window.title = title
        size = (image.shape[1], image.shape[0])
        picture = pygame.image.frombuffer(np.ascontiguousarray(image), size, "RGB")
        self._window.get_surface().blit(picture, (0, 0))
        self._window.flip()
        self.look()

    def look(self) -> None:
        """Sees whether the user closes it. Keys and the mouse are left to whoever asks."""
        if self._window is None:
            return
        pygame = _pygame()
        pygame.event.pump()
        for event in pygame.event.get((pygame.QUIT, pygame.WINDOWCLOSE)):
            if event.type == pygame.QUIT or event.window is self._window:
                self.closed = True
            else:
                pygame.event.post(event)
        if self.closed:
            self.close()

    def pressed_keys(self) -> list[str]:
        """The names of the keys pressed since the last time, such as `space` and `left`."""
        if self._window is None:
            return []
        pygame = _pygame()
        return [pygame.key.name(event.key) for event in pygame.event.get(pygame.KEYDOWN)]

    def wait_s(self, fps: float) -> float:
        """Waits until it is time for the next picture; how long it was since the last wait."""
        return 0.0 if self._clock is None else self._clock.tick(fps) / 1000

    def close(self) -> None:
        """Closes the window, if it is open; the next picture opens it again."""
        if self._window is not None:
            self._window.destroy()
            self._window = self._clock = None


def _open(title: str, size_px: tuple[int, int]) -> Any:
    pygame = _pygame()
    if not hasattr(pygame, "Window"):  # the other package of this name
        raise MissingExtraError("pygame-ce", "render", "a window")
    told = os.environ.get("SDL_VIDEODRIVER")
    no_screen = AspEnvError("there is no screen to open a window on; a video needs none")
    if sys.platform == "linux" and not (told or any(map(os.environ.get, SCREENS))):
        raise no_screen  # SDL would find it out too, with words of its own on stderr
    try:
        pygame.display.init()
        if pygame.display.get_driver() == UNSEEN != told:
            pygame.display.quit()
            raise no_screen
        return pygame.Window(title, size_px, resizable=True)
    except pygame.error as error:
        raise AspEnvError(f"no window can be opened: {error}") from error


def _pygame() -> Any:
    os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")
    import pygame

    return pygame


KEYS = "space: pause   left, right: step   up, down: speed   m: map   n, p: next   q: quit"
SPEEDS = (0.125, 0.25, 0.5, 1.0, 2.0, 4.0, 8.0)
WINDOW_FPS = 30.0


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Playing:
    """Where a player stands."""

    films: Sequence[Film]
    film: int = 0
    time_s: float = 0.0
    """Beyond the film's end while its last picture stands still."""
    speed: float = 1.0
    paused: bool = False
    whole_map: bool = False
    over: bool = False

    @property
    def now(self) -> Film:
        """The film that is shown."""
        return self.films[self.film]

    def advanced(self, passed_s: float) -> "Playing":
        """After some time; behind a film comes the next, behind the last nothing more."""
        if self.paused:
            return self
        time_s = self.time_s + passed_s * self.speed
        if time_s > self.now.duration_s + STILL_S * self.speed:
            if self.film + 1 < len(self.films):
                return dataclasses.replace(self, film=self.film + 1, time_s=0.0)
            return dataclasses.replace(self, time_s=self.now.duration_s, paused=True)
        return dataclasses.replace(self, time_s=time_s)

    def pressed(self, key: str) -> "Playing":
        """After a key; those that mean nothing change nothing."""
        if key in ("q", "escape"):
            return dataclasses.replace(self, over=True)
        if key == "space":
            again = self.paused and self.time_s >= self.now.duration_s
            time_s = 0.0 if again else self.time_s
            return dataclasses.replace(self, paused=not self.paused, time_s=time_s)
        if key == "m":
            return dataclasses.replace(self, whole_map=not self.whole_map)
        if key in ("left", "right"):
            return self._stepped(-1 if key == "left" else 1)
        if key in ("n", "p"):
            film = min(max(self.film + (1 if key == "n" else -1), 0), len(self.films) - 1)
            return dataclasses.replace(self, film=film, time_s=0.0)
        if key in ("up", "down"):
            at = min(range(len(SPEEDS)), key=lambda i: abs(SPEEDS[i] - self.speed))
            at = min(max(at + (1 if key == "up" else -1), 0), len(SPEEDS) - 1)
            return dataclasses.replace(self, speed=SPEEDS[at])
        return self

    def _stepped(self, ticks: int) -> "Playing":
        """At the tick before or after this time, paused."""
        dt_s = self.now.rollout.dt_s
        at = min(self.time_s, self.now.duration_s) / dt_s
        whole = round(at) if abs(at - round(at)) < 1e-6 else int(at) + (ticks < 0)
        time_s = min(max((whole + ticks) * dt_s, 0.0), self.now.duration_s)
        return dataclasses.replace(self, time_s=time_s, paused=True)


def play(playing: Playing, *, size_px: tuple[int, int], extent_m: float) -> None:
    """Shows films one after the other until the user has seen enough.

    Args:
        playing: what, and from where on.
        size_px: width and height of the window at first.
        extent_m: width of what is shown about the ego, where it is not the whole map.

    Raises:
        AspEnvError: there is no screen.
        MissingExtraError: the package that opens windows is not installed.
    """
    window, shown = Window("asp-env", size_px), None
    try:
        while not (playing.over or window.closed):
            wanted = (playing, window.size_px)
            if wanted != shown:
                window.show(_picture(playing, window.size_px, extent_m), _title(playing))
                shown = wanted
            else:
                window.look()
            for key in window.pressed_keys():
                playing = playing.pressed(key)
            playing = playing.advanced(window.wait_s(WINDOW_FPS))
    finally:
        window.close()


def _picture(playing: Playing, size_px: tuple[int, int], extent_m: float) -> np.ndarray:
    film = playing.now
    return film.frame(
        min(playing.time_s, film.duration_s),
        size_px=size_px,
        extent_m=None if playing.whole_map else extent_m,
        hint=KEYS if playing.paused else "",
    )


def _title(playing: Playing) -> str:
    number = f" ({playing.film + 1} of {len(playing.films)})" if len(playing.films) > 1 else ""
    return f"{playing.now.title}{number}, speed {playing.speed:g}"
