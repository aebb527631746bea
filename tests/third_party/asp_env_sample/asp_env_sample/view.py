"""A view: the box of the ego alone, from ChauffeurNet's raster."""

from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np

from asp_env.views import ChauffeurNet, RenderInput, raster_memory


@dataclass(frozen=True)
class EgoBox:
    """One channel of another view."""

    whole: ChauffeurNet = field(default_factory=ChauffeurNet)
    name: ClassVar[str] = "sample-ego-box"
    channels: ClassVar[tuple[str, ...]] = ("ego_box",)

    @property
    def history(self) -> int:
        """Number of past ticks that a scene must have."""
        return self.whole.history

    @property
    def shape(self) -> tuple[int, int, int]:
        """One channel, height and width."""
        return (1, *self.whole.shape[1:])

    @classmethod
    def make(cls, pixels: tuple[int, int] | None = None) -> "EgoBox":
        """The view in this size."""
        return cls(ChauffeurNet.make(pixels))

    @classmethod
    def from_config(cls, config: dict[str, Any]) -> "EgoBox":
        """The view that `config` describes."""
        return cls(ChauffeurNet.from_config({**config, "name": ChauffeurNet.name}))

    def config(self) -> dict[str, Any]:
        """The options of the view."""
        return {**self.whole.config(), "name": self.name}

    def render(self, scene: RenderInput, out: np.ndarray | None = None) -> np.ndarray:
        """One raster of 0 and 255 per target."""
        out = raster_memory((len(scene.targets), *self.shape), out)
        out[:, 0] = self.whole.render(scene)[:, ChauffeurNet.channels.index("ego_box")]
        return out
