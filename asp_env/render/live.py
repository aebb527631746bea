"""What an environment shows of its episode while it runs."""

import numpy as np
from jaxtyping import Shaped, UInt8

from asp_env.data.predictor import Forecast
from asp_env.data.recording import Background
from asp_env.data.scene import Scene
from asp_env.errors import AspEnvError
from asp_env.render.frames import draw_frame
from asp_env.render.window import Window

MODES = ("human", "rgb_array")
SIZE_PX = (720, 720)


class Live:
    """Pictures when they are asked for, or a window that keeps up with the episode."""

    def __init__(self, mode: str | None, *, title: str, dt_s: float) -> None:
        """Opens no window before there is something to show.

        Args:
            mode: `human`, `rgb_array`, or None, which shows nothing.
            title: of the window.
            dt_s: length of a tick; the window shows so many a second as time passes.

        Raises:
            AspEnvError: no such mode.
            MissingExtraError: the package that opens windows is not installed.
        """
        if mode is not None and mode not in MODES:
            raise AspEnvError(f"render mode {mode!r}: expected {', '.join(MODES)} or None")
        self._fps = 1 / dt_s
        self._window = Window(title, SIZE_PX) if mode == "human" else None
        self._forecast: Forecast | None = None
        self._plan: Shaped[np.ndarray, "steps n"] | None = None
        self._told_tick = 0

    def forget(self) -> None:
        """Shows no more of what was told."""
        self._forecast = self._plan = None

    def set_overlay(
        self,
        scene: Scene,
        forecast: Forecast | None,
        plan: Shaped[np.ndarray, "..."] | None,
    ) -> None:
        """Takes what is forecast and planned; what is still to come of it is shown from now on.

        Raises:
            AspEnvError: it is not of this scene, or not finite.
        """
        if forecast is not None:
            at = (forecast.targets[:, 0], forecast.targets[:, 1])
            inside = (at[0] == 0) & (at[1] < scene.ids.shape[1])
            if not (inside.all() and (scene.ids[at] == forecast.ids).all()):
                raise AspEnvError("forecast: expected one of this environment's scene()")
            if not np.isfinite(forecast.states).all():
                raise AspEnvError("forecast: expected finite states")
        if plan is not None and not (
            plan.ndim == 2 and plan.shape[1] >= 2 and np.isfinite(plan[:, :2]).all()
        ):
            raise AspEnvError(f"plan of shape {plan.shape}: expected finite (steps, 2 or more)")
        self._forecast, self._plan, self._told_tick = forecast, plan, int(scene.tick[0])

    def update(self, scene: Scene, background: Background | None) -> None:
        """After a tick, in mode `human`: the window shows it for as long as it takes."""
        if self._window is not None and not self._window.closed:
            self.render(scene, background)
            self._window.wait_s(self._fps)

    def render(
        self, scene: Scene, background: Background | None
    ) -> UInt8[np.ndarray, "height width 3"] | None:
        """The picture; in mode `human` the window shows it instead.

        Raises:
            AspEnvError: there is no screen.
            DataError: the background picture cannot be read.
        """
        if self._window is not None and self._window.closed:
            return None
        size_px = SIZE_PX if self._window is None else self._window.size_px
        gone = max(int(scene.tick[0]) - self._told_tick, 0)
        plan = None if self._plan is None else self._plan[gone:]
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
