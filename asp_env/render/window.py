"""A window on the screen that shows pictures, by pygame-ce."""

import os
import sys
from importlib.util import find_spec
from typing import Any

import numpy as np
from jaxtyping import UInt8

from asp_env.errors import AspEnvError, MissingExtraError

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
