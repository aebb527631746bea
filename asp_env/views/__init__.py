"""What a scene looks like to a network: one function for training and for the loop.

A view is made from its configuration, which a checkpoint stores, and draws any `Scene`.
"""

from importlib import import_module
from typing import Any, Protocol, runtime_checkable

import numpy as np

from asp_env.data.scene import Scene
from asp_env.errors import unknown_name
from asp_env.views.view import View

VIEWS = {"chauffeurnet": "asp_env.views.chauffeurnet:ChauffeurNet"}
"""The views by name; their modules are imported where they are used."""


@runtime_checkable
class PictureView(Protocol):
    """A view that draws pictures of named channels."""

    @property
    def name(self) -> str:
        """By which `make_view` knows it."""
        ...

    @property
    def channels(self) -> tuple[str, ...]:
        """What each channel shows."""
        ...

    @property
    def shape(self) -> tuple[int, int, int]:
        """Of one picture: channels, height, width."""
        ...

    @property
    def history(self) -> int:
        """Past ticks that a scene must have."""
        ...

    def config(self) -> dict[str, Any]:
        """Everything that decides the picture, ready for JSON."""
        ...

    def draw(self, scene: Scene, out: np.ndarray | None = None) -> np.ndarray:
        """One uint8 picture (targets, *shape) per target, into `out` if given."""
        ...


def make_view(name: str, *, height_px: int, width_px: int) -> PictureView:
    """The view of that name in its usual extent, with another number of pixels.

    Raises:
        AspEnvError: the name is unknown (known ones are listed), or the pixels are not square.
    """
    return _view_class(name)(View.scaled(height_px, width_px))


def view_from_config(config: dict[str, Any]) -> PictureView:
    """The view whose `config()` this is.

    Raises:
        AspEnvError: its name is unknown (known ones are listed), or a field is wrong.
    """
    return _view_class(str(config.get("name"))).from_config(config)


def _view_class(name: str) -> Any:
    if name not in VIEWS:
        raise unknown_name("view", name, VIEWS)
    module, _, attribute = VIEWS[name].partition(":")
    return getattr(import_module(module), attribute)
