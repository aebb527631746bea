"""Rendering of an environment's episode while it runs."""

from typing import Any

import numpy as np
from jaxtyping import Float, Shaped, UInt8

from asp_env.arguments import shown
from asp_env.data.predictor import Forecast
from asp_env.data.recording import Background
from asp_env.data.scene import Scene
from asp_env.errors import AspEnvError
from asp_env.render.frames import draw_frame
from asp_env.render.window import Window

MODES = ("human", "rgb_array")
SIZE_PX = (720, 720)


def render_fps(dt_s: float) -> int:
    """Frames per second of a video in real time, as a whole number, which Gymnasium requires.

    Args:
        dt_s: length of a tick in seconds.
    """
    return max(1, round(1 / dt_s))


class LiveRenderer:
    """Frames on request, or a window that shows every tick of the episode."""

    def __init__(self, mode: str | None, *, title: str, dt_s: float) -> None:
        """The window opens with the first frame.

        Args:
            mode: `human`, `rgb_array`, or None, which renders nothing.
            title: Title of the window.
            dt_s: Length of a tick, and the time for which the window shows it.

        Raises:
            AspEnvError: The mode is unknown.
            MissingExtraError: The package that opens windows is not installed.
        """
        if mode is not None and mode not in MODES:
            raise AspEnvError(f"render mode {mode!r}: expected {', '.join(MODES)} or None")
        self._fps = 1 / dt_s
        self._window = Window(title, SIZE_PX) if mode == "human" else None
        self._forecast: Forecast | None = None
        self._plan: Shaped[np.ndarray, "steps n"] | None = None
        self._overlay_tick = 0

    def clear_overlay(self) -> None:
        """Removes the forecast and the plan."""
        self._forecast = self._plan = None

    def set_overlay(
        self,
        scene: Scene,
        forecast: Forecast | None,
        plan: Shaped[np.ndarray, "..."] | None,
    ) -> None:
        """Replaces the forecast and the plan whose remaining steps later frames show.

        Args:
            scene: The present scene.
            forecast: A forecast of the scene.
            plan: (steps, 2 or more) Planned positions of the ego, metres, in the first two columns.

        Raises:
            AspEnvError: The forecast is of another scene, the plan has another shape, or a position
                is not finite.
        """
        if forecast is not None:
            if not isinstance(forecast, Forecast):
                raise AspEnvError(f"forecast {shown(forecast)}: expected a Forecast")
            index = (forecast.targets[:, 0], forecast.targets[:, 1])
            inside = (index[0] == 0) & (index[1] < scene.ids.shape[1])
            if not (inside.all() and (scene.ids[index] == forecast.ids).all()):
                raise AspEnvError("forecast: expected one of this environment's scene()")
            if not np.isfinite(forecast.states).all():
                raise AspEnvError("forecast: expected finite states")
        if plan is not None:
            plan = _checked_plan(plan)
        self._forecast, self._plan, self._overlay_tick = forecast, plan, int(scene.tick[0])

    def update(self, scene: Scene, background: Background | None) -> None:
        """Shows a tick in the window, if there is one, and waits for the length of a tick."""
        if self._window is not None and not self._window.closed:
            self.render(scene, background)
            self._window.wait_s(self._fps)

    def render(
        self, scene: Scene, background: Background | None
    ) -> UInt8[np.ndarray, "height width 3"] | None:
        """Returns a frame of a scene, or shows it in the window and returns None.

        Raises:
            AspEnvError: There is no screen.
            DataError: The background image cannot be read.
        """
        if self._window is not None and self._window.closed:
            return None
        size_px = SIZE_PX if self._window is None else self._window.size_px
        elapsed = max(int(scene.tick[0]) - self._overlay_tick, 0)
        plan = None if self._plan is None else self._plan[elapsed:]
        image = draw_frame(
            scene, size_px=size_px, forecast=self._forecast, plan=plan, background=background
        )
        if self._window is None:
            return image
        self._window.show(image)
        return None

    def close(self) -> None:
        """Closes the window, if there is one."""
        if self._window is not None:
            self._window.close()


def _checked_plan(plan: Any) -> Float[np.ndarray, "steps n"]:
    """The plan as an array of its positions and what else it has."""
    try:
        points = np.asarray(plan, dtype=np.float64)
    except (TypeError, ValueError):
        raise AspEnvError(f"plan {shown(plan)}: expected numbers (steps, 2 or more)") from None
    if points.ndim != 2 or points.shape[1] < 2 or not np.isfinite(points[:, :2]).all():
        raise AspEnvError(f"plan of shape {points.shape}: expected finite (steps, 2 or more)")
    return points
