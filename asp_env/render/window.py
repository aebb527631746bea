"""A window on the screen, and the player that shows films in it, with pygame-ce."""

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

NO_SCREEN_DRIVER = "offscreen"
"""The video driver that SDL selects where there is no screen."""
SCREEN_VARIABLES = ("DISPLAY", "WAYLAND_DISPLAY")
KEYS = "space: pause   left, right: step   up, down: speed   m: map   n, p: next   q: quit"
SPEEDS = (0.125, 0.25, 0.5, 1.0, 2.0, 4.0, 8.0)
WINDOW_FPS = 30.0


class Window:
    """A window that opens with its first image and stays closed after the user has closed it.

    A copy or a pickle of a window is a window that is not open.
    """

    def __init__(self, title: str, size_px: tuple[int, int]) -> None:
        """Creates a window that is not open yet.

        Args:
            title: Title of the window.
            size_px: Initial width and height.

        Raises:
            MissingExtraError: The package that opens windows is not installed.
        """
        if find_spec("pygame") is None:
            raise MissingExtraError("pygame-ce", "render", "a window")
        self.closed = False
        """Whether the user has closed it."""
        self._title, self._first_size_px = title, size_px
        self._window: Any = None
        self._clock: Any = None

    def __reduce__(self) -> tuple[Any, ...]:
        return Window, (self._title, self._first_size_px)

    @property
    def size_px(self) -> tuple[int, int]:
        """Present width and height, which the user may change."""
        if self._window is None:
            return self._first_size_px
        width, height = self._window.size
        return max(int(width), 1), max(int(height), 1)

    def show(self, image: UInt8[np.ndarray, "height width 3"], title: str | None = None) -> None:
        """Shows an RGB image, unless the user has closed the window.

        Args:
            image: The image.
            title: A new title of the window.

        Raises:
            AspEnvError: There is no screen.
        """
        if self.closed:
            return
        pygame = _pygame()
        if self._window is None:
            self._window, self._clock = _open(self._title, self._first_size_px), pygame.time.Clock()
        if title is not None and title != self._window.title:
            self._window.title = title
        size = (image.shape[1], image.shape[0])
        surface = pygame.image.frombuffer(np.ascontiguousarray(image), size, "RGB")
        self._window.get_surface().blit(surface, (0, 0))
        self._window.flip()
        self.poll()

    def poll(self) -> None:
        """Closes the window if the user has requested it; other events stay in the queue."""
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
        """Names of the keys pressed since the last call, such as `space` and `left`."""
        if self._window is None:
            return []
        pygame = _pygame()
        return [pygame.key.name(event.key) for event in pygame.event.get(pygame.KEYDOWN)]

    def wait_s(self, fps: float) -> float:
        """Waits until the next frame is due and returns the time since the last call, s."""
        return 0.0 if self._clock is None else self._clock.tick(fps) / 1000

    def close(self) -> None:
        """Closes the window, if it is open; the next image opens it again."""
        if self._window is not None:
            self._window.destroy()
            self._window = self._clock = None


def _open(title: str, size_px: tuple[int, int]) -> Any:
    pygame = _pygame()
    if not hasattr(pygame, "Window"):  # the package pygame, without -ce
        raise MissingExtraError("pygame-ce", "render", "a window")
    chosen_driver = os.environ.get("SDL_VIDEODRIVER")
    no_screen = AspEnvError("there is no screen to open a window on; a video needs none")
    if sys.platform == "linux" and not (
        chosen_driver or any(map(os.environ.get, SCREEN_VARIABLES))
    ):
        raise no_screen  # SDL would also print a message on stderr
    try:
        pygame.display.init()
        if pygame.display.get_driver() == NO_SCREEN_DRIVER != chosen_driver:
            pygame.display.quit()
            raise no_screen
        return pygame.Window(title, size_px, resizable=True)
    except pygame.error as error:
        raise AspEnvError(f"no window can be opened: {error}") from error


def _pygame() -> Any:
    os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")
    import pygame

    return pygame


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PlayerState:
    """The state of the player."""

    films: Sequence[Film]
    index: int = 0
    """The index of the present film."""
    time_s: float = 0.0
    """Exceeds the duration of the film while its last frame stands still."""
    speed: float = 1.0
    paused: bool = False
    whole_map: bool = False
    finished: bool = False

    @property
    def film(self) -> Film:
        """The present film."""
        return self.films[self.index]

    def advanced(self, passed_s: float) -> "PlayerState":
        """The state after some time; each film is followed by the next, and the last one pauses."""
        if self.paused:
            return self
        time_s = self.time_s + passed_s * self.speed
        if time_s > self.film.duration_s + STILL_S * self.speed:
            if self.index + 1 < len(self.films):
                return dataclasses.replace(self, index=self.index + 1, time_s=0.0)
            return dataclasses.replace(self, time_s=self.film.duration_s, paused=True)
        return dataclasses.replace(self, time_s=time_s)

    def pressed(self, key: str) -> "PlayerState":
        """The state after a key; keys without a meaning change nothing."""
        if key in ("q", "escape"):
            return dataclasses.replace(self, finished=True)
        if key == "space":
            restart = self.paused and self.time_s >= self.film.duration_s
            time_s = 0.0 if restart else self.time_s
            return dataclasses.replace(self, paused=not self.paused, time_s=time_s)
        if key == "m":
            return dataclasses.replace(self, whole_map=not self.whole_map)
        if key in ("left", "right"):
            return self._stepped(-1 if key == "left" else 1)
        if key in ("n", "p"):
            index = min(max(self.index + (1 if key == "n" else -1), 0), len(self.films) - 1)
            return dataclasses.replace(self, index=index, time_s=0.0)
        if key in ("up", "down"):
            nearest = min(range(len(SPEEDS)), key=lambda i: abs(SPEEDS[i] - self.speed))
            choice = min(max(nearest + (1 if key == "up" else -1), 0), len(SPEEDS) - 1)
            return dataclasses.replace(self, speed=SPEEDS[choice])
        return self

    def _stepped(self, ticks: int) -> "PlayerState":
        """The state at the tick before or after the present time, paused."""
        dt_s = self.film.rollout.dt_s
        position = min(self.time_s, self.film.duration_s) / dt_s
        on_tick = abs(position - round(position)) < 1e-6
        tick = round(position) if on_tick else int(position) + (ticks < 0)
        time_s = min(max((tick + ticks) * dt_s, 0.0), self.film.duration_s)
        return dataclasses.replace(self, time_s=time_s, paused=True)


def play(state: PlayerState, *, size_px: tuple[int, int], extent_m: float) -> None:
    """Shows films one after the other until the user quits or closes the window.

    Args:
        state: The films and the initial state of the player.
        size_px: Initial width and height of the window.
        extent_m: Width of the area around the ego, where the whole map is not shown.

    Raises:
        AspEnvError: There is no screen.
        MissingExtraError: The package that opens windows is not installed.
    """
    window, shown = Window("asp-env", size_px), None
    try:
        while not (state.finished or window.closed):
            due = (state, window.size_px)
            if due != shown:
                window.show(_frame(state, window.size_px, extent_m), _title(state))
                shown = due
            else:
                window.poll()
            for key in window.pressed_keys():
                state = state.pressed(key)
            state = state.advanced(window.wait_s(WINDOW_FPS))
    finally:
        window.close()


def _frame(state: PlayerState, size_px: tuple[int, int], extent_m: float) -> np.ndarray:
    film = state.film
    return film.frame(
        min(state.time_s, film.duration_s),
        size_px=size_px,
        extent_m=None if state.whole_map else extent_m,
        hint=KEYS if state.paused else "",
    )


def _title(state: PlayerState) -> str:
    number = f" ({state.index + 1} of {len(state.films)})" if len(state.films) > 1 else ""
    return f"{state.film.title}{number}, speed {state.speed:g}"
