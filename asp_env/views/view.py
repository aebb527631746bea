"""The protocols of views: what a view reads of a scene and what it gives a network.

A view is made from its configuration, which a checkpoint stores, and renders any `Scene`. Training,
evaluation and the closed loop therefore present scenes to a network in the same way.
"""

from typing import Any, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float, Int

from asp_env.data.road_map import RoadMap
from asp_env.data.signals import SceneSignals


@runtime_checkable
class RenderInput(Protocol):
    """The fields of a scene that views read. Every `Scene` has them, with the same meaning.

    Sizes, classes and ids of agents that are valid at no tick are arbitrary.
    """

    @property
    def states(self) -> Float[np.ndarray, "b a ticks 4"]:
        """[x m, y m, heading rad, speed m/s]; the last tick is the present."""
        ...

    @property
    def valid(self) -> Bool[np.ndarray, "b a ticks"]:
        """Whether each agent is present at each tick."""
        ...

    @property
    def sizes(self) -> Float[np.ndarray, "b a 2"]:
        """Length and width, metres."""
        ...

    @property
    def classes(self) -> Int[np.ndarray, "b a"]:
        """`AgentClass` of each agent."""
        ...

    @property
    def ids(self) -> Int[np.ndarray, "b a"]:
        """Identifier of each agent."""
        ...

    @property
    def targets(self) -> Int[np.ndarray, "t 2"]:
        """(situation, slot) of the agents around which the scene is rendered."""
        ...

    @property
    def maps(self) -> tuple[RoadMap, ...]:
        """The road maps of the situations."""
        ...

    @property
    def map_index(self) -> Int[np.ndarray, " b"]:
        """Index into `maps` of each situation."""
        ...

    @property
    def signals(self) -> SceneSignals | None:
        """Traffic signals up to now; None if no recording of the scene has any."""
        ...

    @property
    def history(self) -> int:
        """Number of past ticks."""
        ...


@runtime_checkable
class SceneView(Protocol):
    """A view, made by its class method `make(pixels, **options)` or from its configuration."""

    @property
    def name(self) -> str:
        """The name under which `make_view` makes the view."""
        ...

    @property
    def shape(self) -> Any:
        """Shape of the arrays of one target; of a raster (channels, height, width)."""
        ...

    @property
    def history(self) -> int:
        """Number of past ticks that a scene must have."""
        ...

    def config(self) -> dict[str, Any]:
        """The name and all options of the view, ready for JSON."""
        ...

    def render(self, scene: RenderInput) -> Any:
        """Renders the scene around each of its targets, in their order."""
        ...


@runtime_checkable
class RasterView(SceneView, Protocol):
    """A view that renders rasters of named channels."""

    @property
    def channels(self) -> tuple[str, ...]:
        """The name of each channel."""
        ...

    @property
    def shape(self) -> tuple[int, int, int]:
        """Channels, height and width of one raster."""
        ...

    def render(self, scene: RenderInput, out: np.ndarray | None = None) -> np.ndarray:
        """Renders one uint8 raster per target, (targets, *shape), into `out` if given."""
        ...


@runtime_checkable
class BinaryView(RasterView, Protocol):
    """A view whose rasters contain only 0 and 255 and can be rendered as packed bits."""

    def render_packed(self, scene: RenderInput) -> np.ndarray:
        """The rasters of `render`, packed along rows as by `np.packbits`."""
        ...
