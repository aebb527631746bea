"""A view of your own: ChauffeurNet with the states of traffic signals in three more channels."""

import sys
from dataclasses import dataclass, field
from typing import Any, ClassVar, no_type_check

import numpy as np
from numba import njit

from asp_env import ReplayEnv
from asp_env.views import ChauffeurNet, RenderInput, fill_segment, place_targets, raster_memory

STOP_LINE_WIDTH_M = 0.8
"""Width of drawn stop lines. Chosen by hand: four pixels at full resolution."""


@dataclass(frozen=True)
class SignalView:
    """The channels of ChauffeurNet, and the stop lines whose signal is red, amber or green now."""

    traffic: ChauffeurNet = field(default_factory=ChauffeurNet)
    name: ClassVar[str] = "chauffeurnet-signals"  # also the name of the entry point
    channels: ClassVar = (*ChauffeurNet.channels, "signal_red", "signal_amber", "signal_green")

    @property
    def history(self) -> int:
        return self.traffic.history  # an option of `config()`, which --history-s changes

    @property
    def shape(self) -> tuple[int, int, int]:
        return (len(self.channels), *self.traffic.shape[1:])

    @classmethod
    def make(cls, pixels: tuple[int, int] | None = None) -> "SignalView":
        return cls(ChauffeurNet.make(pixels))

    def config(self) -> dict[str, Any]:
        return {**self.traffic.config(), "name": self.name}

    @classmethod
    def from_config(cls, config: dict[str, Any]) -> "SignalView":
        return cls(ChauffeurNet.from_config({**config, "name": "chauffeurnet"}))

    def render(self, scene: RenderInput, out: np.ndarray | None = None) -> np.ndarray:
        """One raster of 0 and 255 per target, (targets, 15, height, width) uint8."""
        out = raster_memory((len(scene.targets), *self.shape), out)
        added, viewport = out[:, len(ChauffeurNet.channels) :], self.traffic.viewport
        out[:, : len(ChauffeurNet.channels)], added[:] = self.traffic.render(scene), 0
        if scene.signals is not None:
            placed = place_targets(scene, viewport, history=self.history, view_name=self.name)
            situation, matrix = placed.targets[:, 0], placed.pixels_from_world[:, None]
            lines = scene.signals.stop_lines[situation] @ matrix[..., :2].swapaxes(-1, -2)
            now = scene.signals.states[situation, :, -1] * (placed.map_of_target >= 0)[:, None]
            half_width = viewport.half_line_px(STOP_LINE_WIDTH_M)
            draw_stop_lines(lines + matrix[..., None, :, 2], now, half_width, added)
        return out

    def render_packed(self, scene: RenderInput) -> np.ndarray:
        return np.packbits(self.render(scene), axis=-1)  # optional, saves memory


@njit(cache=True)
@no_type_check
def draw_stop_lines(lines, states, half_width, out):
    """Draws the lines (targets, signals, 2, 2) of red, amber, green signals into channel 0 to 2."""
    for t, s in np.argwhere(states):  # the signals that are not UNKNOWN
        (column_0, row_0), (column_1, row_1) = lines[t, s]
        fill_segment(out[t, states[t, s] - 1], column_0, row_0, column_1, row_1, half_width, 255)


def main() -> tuple[int, ...]:
    """Renders a scene of the sample, which has no signals; returns the shape of the rasters."""
    env = ReplayEnv(observations=("state",))
    env.reset(seed=0)
    return SignalView().render(env.scene()).shape


if __name__ == "__main__":
    sys.stdout.write(f"rasters {main()}\n")
