"""What a scene looks like to a network: one function for training and for the loop.

A view is made from its configuration, which a checkpoint stores, and draws any `Scene`.
"""

from collections.abc import Mapping
from importlib import import_module
from types import MappingProxyType
from typing import Any, NamedTuple, Protocol, runtime_checkable

import numpy as np

from asp_env.errors import AspEnvError, unknown_name
from asp_env.views.view import Drawable

_NOTHING: Mapping[str, Any] = MappingProxyType({})


class Plug(NamedTuple):
    """Where a view lives, and which of its options its name stands for."""

    path: str
    """`module:class`; the module is imported where the view is used."""
    options: Mapping[str, Any] = _NOTHING


VIEWS: Mapping[str, Plug] = MappingProxyType(
    {
        "chauffeurnet": Plug("asp_env.views.chauffeurnet:ChauffeurNet"),
        "chauffeurnet-no-trail": Plug(
            "asp_env.views.chauffeurnet:ChauffeurNet", {"ego_trail": False}
        ),
        "mtp": Plug("asp_env.views.mtp:MTP"),
        "vectors": Plug("asp_env.views.vectors:VectorView"),
        "vectors-no-trail": Plug("asp_env.views.vectors:VectorView", {"own_past": False}),
    }
)
"""The views by name. Those without the trail do not show a target its own past: an ablation."""


@runtime_checkable
class SceneView(Protocol):
    """What a network looks at: made by `make(pixels, **options)`, or from its configuration."""

    @property
    def name(self) -> str:
        """By which `make_view` knows it."""
        ...

    @property
    def shape(self) -> Any:
        """What one target's drawing measures: of a picture (channels, height, width)."""
        ...

    @property
    def history(self) -> int:
        """Past ticks that a scene must have."""
        ...

    def config(self) -> dict[str, Any]:
        """Everything that decides the drawing, ready for JSON; `name` among it."""
        ...

    def draw(self, scene: Drawable) -> Any:
        """One drawing per target, in the order of the scene's targets."""
        ...


@runtime_checkable
class PictureView(SceneView, Protocol):
    """A view that draws pictures of named channels."""

    @property
    def channels(self) -> tuple[str, ...]:
        """What each channel shows."""
        ...

    @property
    def shape(self) -> tuple[int, int, int]:
        """Of one picture: channels, height, width."""
        ...

    def draw(self, scene: Drawable, out: np.ndarray | None = None) -> np.ndarray:
        """One uint8 picture (targets, *shape) per target, into `out` if given."""
        ...


@runtime_checkable
class BinaryView(PictureView, Protocol):
    """A view whose pictures hold 0 and 255 alone, and can be had as bits."""

    def draw_packed(self, scene: Drawable) -> np.ndarray:
        """The pictures of `draw` as `packing.pack_bits` packs them."""
        ...


def make_view(name: str, *, pixels: tuple[int, int] | None = None) -> SceneView:
    """The view of that name in its usual extent.

    Args:
        name: one of `VIEWS`.
        pixels: height and width of its pictures; by default the view's own. Views that draw no
            pictures take none.

    Raises:
        AspEnvError: the name is unknown (known ones are listed), or the pixels are not square.
    """
    if name not in VIEWS:
        raise unknown_name("view", name, VIEWS)
    return _view_class(name).make(pixels, **VIEWS[name].options)


def make_picture_view(name: str, *, pixels: tuple[int, int] | None = None) -> PictureView:
    """The view of that name, which must draw pictures.

    Raises:
        AspEnvError: as `make_view`, or it draws none.
    """
    view = make_view(name, pixels=pixels)
    if not isinstance(view, PictureView):
        raise AspEnvError(f"view {name!r} draws no pictures: choose chauffeurnet or mtp")
    return view


def view_from_config(config: Mapping[str, Any]) -> SceneView:
    """The view whose `config()` this is.

    Raises:
        AspEnvError: its name is unknown (known ones are listed), or a field is wrong.
    """
    name = str(config.get("name"))
    if name not in VIEWS:
        raise unknown_name("view", name, VIEWS)
    return _view_class(name).from_config(dict(config))


def _view_class(name: str) -> Any:
    module, _, attribute = VIEWS[name].path.partition(":")
    return getattr(import_module(module), attribute)
